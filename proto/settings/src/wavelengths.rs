//! The wavelength that a render is made at.

use serde::{Deserialize, Serialize};

/// Shortest and longest wavelength of a render or of a material's spectrum, nanometres.
pub const WAVELENGTHS_NM: (f64, f64) = (200.0, 20_000.0);

/// The laser's wavelength, nanometres, within [`WAVELENGTHS_NM`]; or none. It is written as a list.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Vec<f64>", into = "Vec<f64>")]
pub struct Wavelength(Option<f64>);

impl Wavelength {
    /// None: materials reflect as at the laser's own wavelength, whichever that is.
    pub const NONE: Self = Self(None);

    /// The wavelength of a list of one or none.
    ///
    /// # Errors
    /// Which of them, as `[0]` (empty where all of them are meant), and what was expected.
    pub fn of(nm: &[f64]) -> Result<Self, (String, String)> {
        let (least, most) = WAVELENGTHS_NM;
        match *nm {
            [] => Ok(Self::NONE),
            [x] if (least..=most).contains(&x) => Ok(Self(Some(x))),
            [x] => Err((
                "[0]".into(),
                format!("is {x}, expected {least} to {most} nm, such as 905"),
            )),
            _ => Err((
                String::new(),
                format!(
                    "has {}, expected one; give each wavelength a render or a stage and data set of its own",
                    nm.len()
                ),
            )),
        }
    }

    /// Nanometres.
    pub fn nm(&self) -> Option<f64> {
        self.0
    }

    /// Whether there is none.
    pub fn is_none(&self) -> bool {
        self.0.is_none()
    }
}

impl TryFrom<Vec<f64>> for Wavelength {
    type Error = String;

    fn try_from(nm: Vec<f64>) -> Result<Self, String> {
        Self::of(&nm).map_err(|(at, what)| format!("wavelengths_nm{at} {what}"))
    }
}

impl From<Wavelength> for Vec<f64> {
    fn from(wavelength: Wavelength) -> Self {
        wavelength.0.into_iter().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wavelengths_that_no_laser_has_and_more_than_one_are_refused() {
        let of = |nm: &[f64]| Wavelength::of(nm).map(|w| w.nm());
        assert_eq!(of(&[]), Ok(None));
        assert_eq!(of(&[905.0]), Ok(Some(905.0)));
        assert_eq!(of(&[0.532]).unwrap_err().0, "[0]");
        assert_eq!(of(&[f64::NAN]).unwrap_err().0, "[0]");
        let (at, what) = of(&[905.0, 532.0]).unwrap_err();
        assert_eq!(at, "");
        assert!(what.starts_with("has 2, expected one; "), "{what}");
    }

    #[test]
    fn it_is_written_as_a_list_and_read_back() {
        let wavelength = Wavelength::of(&[532.5]).unwrap();
        let text = serde_json::to_string(&wavelength).unwrap();
        assert_eq!(text, "[532.5]");
        assert_eq!(
            serde_json::from_str::<Wavelength>(&text).unwrap(),
            wavelength
        );
        assert_eq!(serde_json::to_string(&Wavelength::NONE).unwrap(), "[]");
        for (text, expected) in [
            ("[0.5]", "wavelengths_nm[0] is 0.5"),
            ("[905, 532]", "wavelengths_nm has 2"),
        ] {
            let wrong = serde_json::from_str::<Wavelength>(text).unwrap_err();
            assert!(wrong.to_string().contains(expected), "{wrong}");
        }
    }
}
