//! The size of an image in pixels.

use std::{fmt, str::FromStr};

use serde::{
    Deserialize, Deserializer, Serialize, Serializer,
    de::{Unexpected, Visitor},
};

/// The size of an image. Written as `256` (a square) or `"320x240"` (width and height).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Resolution {
    /// The width, pixels.
    pub width: u32,
    /// The height, pixels.
    pub height: u32,
}

const EXPECTED: &str = "a number of pixels such as 256, or width and height such as \"320x240\"";

impl Resolution {
    /// Returns a square image.
    ///
    /// # Examples
    /// ```
    /// use picofarm_settings::Resolution;
    ///
    /// assert_eq!(Resolution::square(64).to_string(), "64");
    /// assert_eq!("64x48".parse(), Ok(Resolution { width: 64, height: 48 }));
    /// ```
    pub fn square(side: u32) -> Self {
        Self {
            width: side,
            height: side,
        }
    }

    /// Returns the number of pixels.
    pub fn pixels(self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    /// Returns whether width and height are equal.
    pub fn is_square(self) -> bool {
        self.width == self.height
    }
}

impl fmt::Display for Resolution {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.is_square() {
            true => write!(f, "{}", self.width),
            false => write!(f, "{}x{}", self.width, self.height),
        }
    }
}

/// Parses the output of [`Display`](fmt::Display).
impl FromStr for Resolution {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let side = |text: &str| text.trim().parse::<u32>().ok();
        let parsed = match text.split_once('x') {
            Some((width, height)) => side(width).zip(side(height)),
            None => side(text).map(|n| (n, n)),
        };
        let (width, height) = parsed.ok_or_else(|| format!("expected {EXPECTED}"))?;
        Ok(Self { width, height })
    }
}

impl Serialize for Resolution {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.is_square() {
            true => serializer.serialize_u32(self.width),
            false => serializer.collect_str(self),
        }
    }
}

impl<'de> Deserialize<'de> for Resolution {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Written)
    }
}

struct Written;

impl Visitor<'_> for Written {
    type Value = Resolution;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(EXPECTED)
    }

    fn visit_u64<E: serde::de::Error>(self, side: u64) -> Result<Resolution, E> {
        let side =
            u32::try_from(side).map_err(|_| E::invalid_value(Unexpected::Unsigned(side), &self))?;
        Ok(Resolution::square(side))
    }

    fn visit_i64<E: serde::de::Error>(self, side: i64) -> Result<Resolution, E> {
        let side =
            u32::try_from(side).map_err(|_| E::invalid_value(Unexpected::Signed(side), &self))?;
        Ok(Resolution::square(side))
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Resolution, E> {
        text.parse()
            .map_err(|_| E::invalid_value(Unexpected::Str(text), &self))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_is_written_as_a_number_and_other_sizes_as_width_and_height() {
        for (text, width, height) in [("256", 256, 256), ("\"320x240\"", 320, 240)] {
            let read: Resolution = serde_json::from_str(text).unwrap();
            assert_eq!(read, Resolution { width, height });
            assert_eq!(serde_json::to_string(&read).unwrap(), text);
        }
        for wrong in ["-1", "\"320×240\"", "1.5", "\"x\"", "99999999999"] {
            let said = serde_json::from_str::<Resolution>(wrong).unwrap_err();
            assert!(said.to_string().contains("320x240"), "{said}");
        }
    }
}
