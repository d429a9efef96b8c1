//! The wavelengths of a render.

use serde::{Deserialize, Serialize};

/// Most wavelengths of a render.
pub const MAX_WAVELENGTHS: usize = 4;

/// Shortest and longest wavelength of a render or of a material's spectrum, nanometres.
pub const WAVELENGTHS_NM: (f64, f64) = (200.0, 20_000.0);

/// Wavelengths of a laser, nanometres: none, or up to [`MAX_WAVELENGTHS`] distinct ones inside
/// [`WAVELENGTHS_NM`]. The first is the main one.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
#[serde(try_from = "Vec<f64>", into = "Vec<f64>")]
pub struct Wavelengths {
    nm: [f64; MAX_WAVELENGTHS],
    count: usize,
}

impl Wavelengths {
    /// No wavelengths: materials reflect as at the laser's own wavelength, whichever it is.
    pub const NONE: Self = Self {
        nm: [0.0; MAX_WAVELENGTHS],
        count: 0,
    };

    /// Creates wavelengths from nanometres.
    ///
    /// # Errors
    /// Returns the position of the invalid one, as `[2]` (empty if all are meant), and the expected
    /// value.
    pub fn of(nm: &[f64]) -> Result<Self, (String, String)> {
        let mut all = Self::NONE;
        if nm.len() > MAX_WAVELENGTHS {
            let what = format!("has {}, expected at most {MAX_WAVELENGTHS}", nm.len());
            return Err((String::new(), what));
        }
        let (least, most) = WAVELENGTHS_NM;
        for (k, &x) in nm.iter().enumerate() {
            let fail = |what: String| Err((format!("[{k}]"), what));
            if !(least..=most).contains(&x) {
                return fail(format!(
                    "is {x}, expected {least} to {most} nm, such as 905"
                ));
            }
            if all.nm().contains(&x) {
                return fail(format!("is {x}, which is there already; name each once"));
            }
            all.nm[k] = x;
            all.count += 1;
        }
        Ok(all)
    }

    /// Returns all wavelengths, nanometres.
    pub fn nm(&self) -> &[f64] {
        &self.nm[..self.count]
    }

    /// Returns the wavelengths after the main one.
    pub fn others(&self) -> &[f64] {
        self.nm().get(1..).unwrap_or_default()
    }

    /// Returns the main wavelength alone.
    pub fn main(&self) -> Self {
        Self {
            nm: self.nm,
            count: self.count.min(1),
        }
    }

    /// Returns whether there are no wavelengths.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }
}

impl PartialEq for Wavelengths {
    fn eq(&self, other: &Self) -> bool {
        self.nm() == other.nm()
    }
}

impl TryFrom<Vec<f64>> for Wavelengths {
    type Error = String;

    fn try_from(nm: Vec<f64>) -> Result<Self, String> {
        Self::of(&nm).map_err(|(at, what)| format!("wavelengths_nm{at} {what}"))
    }
}

impl From<Wavelengths> for Vec<f64> {
    fn from(all: Wavelengths) -> Self {
        all.nm().to_vec()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wavelengths_no_laser_has_too_many_and_the_same_twice_are_refused_by_their_place() {
        let of = |nm: &[f64]| Wavelengths::of(nm).map(drop).map_err(|(at, _)| at);
        assert_eq!(of(&[]), Ok(()));
        assert_eq!(of(&[905.0, 532.0, 1550.0, 450.0]), Ok(()));
        assert_eq!(of(&[905.0, 0.532]), Err("[1]".into()));
        assert_eq!(of(&[f64::NAN]), Err("[0]".into()));
        assert_eq!(of(&[905.0, 532.0, 905.0]), Err("[2]".into()));
        assert_eq!(of(&[400.0, 500.0, 600.0, 700.0, 800.0]), Err(String::new()));
    }

    #[test]
    fn they_are_written_as_a_list_and_read_back() {
        let all = Wavelengths::of(&[905.0, 532.5]).unwrap();
        let text = serde_json::to_string(&all).unwrap();
        assert_eq!(text, "[905.0,532.5]");
        assert_eq!(serde_json::from_str::<Wavelengths>(&text).unwrap(), all);
        assert_eq!(
            (all.others(), Wavelengths::NONE.others()),
            (&[532.5][..], &[][..])
        );
        let wrong = serde_json::from_str::<Wavelengths>("[905, 0.5]").unwrap_err();
        assert!(
            wrong.to_string().contains("wavelengths_nm[1] is 0.5"),
            "{wrong}"
        );
    }
}
