//! Positions of the laser's spots in the camera's view: on a grid, random, or given.

use std::{fmt, str::FromStr};

use serde::{
    Deserialize, Deserializer, Serialize, Serializer,
    de::{Error as _, MapAccess, Visitor},
    ser::SerializeMap as _,
};

/// Positions of the laser's spots in the camera's view. Written as `25`, `{ random = 16 }` or
/// `{ at = [[0.5, 0.5], [0.2, 0.7]] }`.
#[derive(Debug, Clone, PartialEq)]
pub enum Spots {
    /// A square grid of 1, 4, 16, 25 or 100 spots.
    Grid(u32),
    /// This many random spots, uniform over the image, independent of each other, and different in
    /// each scene (Shoot-Bounce-3D, appendix F.3).
    Random(u32),
    /// Spots at these positions in the image: x to the right and y down, both from 0 to 1.
    At(Vec<[f64; 2]>),
}

impl Spots {
    /// The available grids.
    pub const GRIDS: [u32; 5] = [1, 4, 16, 25, 100];
    /// Most spots of a scene.
    pub const MOST: u32 = 100;

    /// Returns the number of spots.
    pub fn count(&self) -> u32 {
        match self {
            Self::Grid(n) | Self::Random(n) => *n,
            Self::At(places) => u32::try_from(places.len()).unwrap_or(u32::MAX),
        }
    }

    /// Returns whether the spots are on a grid.
    pub fn is_grid(&self) -> bool {
        matches!(self, Self::Grid(_))
    }

    /// Checks the number and the positions.
    ///
    /// # Errors
    /// Returns a description of the fault and the valid values.
    pub fn check(&self) -> Result<(), String> {
        let most = Self::MOST;
        match self {
            Self::Grid(n) if !Self::GRIDS.contains(n) => Err(format!(
                "{n} is no number of spots; there are grids of 1, 4, 16, 25 and 100, \
                 and {{ random = N }} and {{ at = [[x, y], …] }} for others"
            )),
            Self::Random(n) if !(1..=most).contains(n) => {
                Err(format!("random = {n}: expected 1 to {most} spots"))
            }
            Self::At(places) if places.is_empty() || places.len() > most as usize => {
                let n = places.len();
                Err(format!("at lists {n} places; expected 1 to {most}"))
            }
            Self::At(places) => {
                let inside = |p: &&[f64; 2]| !p.iter().all(|x| (0.0..1.0).contains(x));
                match places.iter().find(inside) {
                    Some([x, y]) => Err(format!(
                        "at [{x}, {y}]: expected places in the image, x to the right and y down, from 0 up to 1"
                    )),
                    None => Ok(()),
                }
            }
            _ => Ok(()),
        }
    }
}

impl From<u32> for Spots {
    fn from(grid: u32) -> Self {
        Self::Grid(grid)
    }
}

/// Formats the spots as on a command line: `25`, `random:16`, `0.5,0.5/0.2,0.7`.
impl fmt::Display for Spots {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Grid(n) => write!(f, "{n}"),
            Self::Random(n) => write!(f, "random:{n}"),
            Self::At(places) => {
                let places: Vec<_> = places.iter().map(|[x, y]| format!("{x},{y}")).collect();
                f.write_str(&places.join("/"))
            }
        }
    }
}

/// Parses the output of [`Display`](fmt::Display).
impl FromStr for Spots {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        let expected = || "expected a grid of 1, 4, 16, 25 or 100, random:N, or places as X,Y/X,Y (0 to 1, right and down)";
        let spots = if let Some(n) = text.strip_prefix("random:") {
            Self::Random(n.parse().map_err(|_| expected())?)
        } else if text.contains(',') {
            let place = |text: &str| -> Option<[f64; 2]> {
                let (x, y) = text.split_once(',')?;
                Some([x.trim().parse().ok()?, y.trim().parse().ok()?])
            };
            let places: Option<Vec<_>> = text.split('/').map(place).collect();
            Self::At(places.ok_or_else(expected)?)
        } else {
            Self::Grid(text.parse().map_err(|_| expected())?)
        };
        spots.check()?;
        Ok(spots)
    }
}

impl Serialize for Spots {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Grid(n) => serializer.serialize_u32(*n),
            Self::Random(n) => {
                let mut map = serializer.serialize_map(Some(1))?;
                map.serialize_entry("random", n)?;
                map.end()
            }
            Self::At(places) => {
                let mut map = serializer.serialize_map(Some(1))?;
                map.serialize_entry("at", places)?;
                map.end()
            }
        }
    }
}

impl<'de> Deserialize<'de> for Spots {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Written)
    }
}

/// Reads the three forms, and lists them in the error for any other.
struct Written;

impl<'de> Visitor<'de> for Written {
    type Value = Spots;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a grid of 1, 4, 16, 25 or 100 spots, { random = N } or { at = [[x, y], …] }")
    }

    fn visit_u64<E: serde::de::Error>(self, n: u64) -> Result<Spots, E> {
        // A number too large for `u32` is refused by the check like any other invalid number of
        // spots.
        Ok(Spots::Grid(u32::try_from(n).unwrap_or(u32::MAX)))
    }

    fn visit_i64<E: serde::de::Error>(self, n: i64) -> Result<Spots, E> {
        match u64::try_from(n) {
            Ok(n) => self.visit_u64(n),
            Err(_) => Err(E::invalid_value(serde::de::Unexpected::Signed(n), &self)),
        }
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Spots, A::Error> {
        let spots = match map.next_key::<String>()?.as_deref() {
            Some("random") => Spots::Random(map.next_value()?),
            Some("at") => Spots::At(map.next_value()?),
            Some(other) => return Err(A::Error::unknown_field(other, &["random", "at"])),
            None => return Err(A::Error::invalid_length(0, &self)),
        };
        match map.next_key::<String>()? {
            None => Ok(spots),
            Some(more) => Err(A::Error::custom(format!(
                "{more:?} beside another way to place spots; expected one of random and at"
            ))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Spots;

    fn all() -> [Spots; 3] {
        [
            Spots::Grid(25),
            Spots::Random(16),
            Spots::At(vec![[0.5, 0.25], [0.125, 0.75]]),
        ]
    }

    #[test]
    fn each_form_is_read_as_it_is_written() {
        let written = [
            "25",
            r#"{"random":16}"#,
            r#"{"at":[[0.5,0.25],[0.125,0.75]]}"#,
        ];
        let typed = ["25", "random:16", "0.5,0.25/0.125,0.75"];
        for ((spots, json), typed) in all().into_iter().zip(written).zip(typed) {
            assert_eq!(serde_json::to_string(&spots).unwrap(), json);
            assert_eq!(serde_json::from_str::<Spots>(json).unwrap(), spots);
            assert_eq!(spots.to_string(), typed);
            assert_eq!(typed.parse(), Ok(spots));
        }
    }

    #[test]
    fn what_cannot_be_meant_is_refused_with_the_forms_that_there_are() {
        for (json, part) in [
            ("\"many\"", "{ random = N }"),
            ("-4", "{ at = [[x, y], …] }"),
            ("{}", "{ random = N }"),
            (r#"{"grid":25}"#, "`random` or `at`"),
            (r#"{"random":4,"at":[[0,0]]}"#, "expected one of"),
            (r#"{"random":-4}"#, "u32"),
        ] {
            let error = serde_json::from_str::<Spots>(json).unwrap_err().to_string();
            assert!(error.contains(part), "{json}: {part:?} is not in {error}");
        }
        for (text, part) in [
            ("9", "1, 4, 16, 25 and 100"),
            ("many", "random:N"),
            ("random:0", "1 to 100"),
            ("random:101", "1 to 100"),
            ("random:x", "random:N"),
            ("0.5,1.0", "from 0 up to 1"),
            ("0.5,nan", "from 0 up to 1"),
            ("0.5,0.5/", "X,Y/X,Y"),
        ] {
            let error = text.parse::<Spots>().unwrap_err();
            assert!(error.contains(part), "{text}: {part:?} is not in {error}");
        }
        assert!(Spots::At(vec![[0.5; 2]; 101]).check().is_err());
    }
}
