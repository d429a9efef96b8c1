//! The properties of a data set: its size, gate and codec profile. They are fixed at creation,
//! except that scenes may be added.

pub use picofarm_settings::{Gate, Wavelength};
use serde::{Deserialize, Serialize};

use crate::layout::quantity::Quantity;
use picofarm_store::StorageError;

/// The encoding of transients.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "name", rename_all = "kebab-case")]
pub enum Profile {
    /// Square-root code in u16: N = h·scale photons, q = round((2/Δ)·√N), decoded as N = (q·Δ/2)².
    /// The error stays below (Δ/2 + Δ²/16) standard deviations of the photon noise, σ = √max(N, 1).
    SqrtU16 {
        /// Δ: 0.2 or a power of two from 1/16 to 2.
        #[serde(serialize_with = "as_decimal")]
        delta: f32,
    },
    /// 32-bit floats.
    PlainF32 {
        /// Largest rounding error in standard deviations of the photon noise: a power of two from
        /// 1/16 to 1, or 0 for none.
        #[serde(
            default,
            skip_serializing_if = "is_zero",
            serialize_with = "as_decimal"
        )]
        round: f32,
    },
    /// Lossless whole photon counts in u16, as produced by a sensor with photon noise: N = h·scale,
    /// which must be whole; decoded as h = N/scale.
    CountsU16,
}

impl Default for Profile {
    fn default() -> Self {
        Self::SqrtU16 { delta: 0.2 }
    }
}

/// Returns the number with the digits of an f32: 0.2 instead of 0.20000000298023224.
pub(crate) fn decimal(x: f32) -> f64 {
    x.to_string().parse().expect("floats are written as floats")
}

fn as_decimal<S: serde::Serializer>(x: &f32, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(decimal(*x))
}

fn is_zero(x: &f32) -> bool {
    *x == 0.0
}

/// The properties of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DatasetSpec {
    /// Capacity in scenes. It may grow later, but never shrinks.
    pub scenes: u64,
    /// Image height in pixels.
    pub height: u32,
    /// Image width in pixels.
    pub width: u32,
    /// Number of illumination spots in each scene.
    pub spots: u32,
    /// Subsets of the spots with their own transients (`transient_4`, `transient_25`).
    #[serde(default, skip_serializing_if = "Subsets::is_empty")]
    pub subsets: Subsets,
    /// Whether each spot has its own transient (`transient_spots`).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub per_spot: bool,
    /// The laser's wavelength, nanometres. Without one, nobody said which it is.
    #[serde(default, skip_serializing_if = "Wavelength::is_none")]
    pub wavelengths_nm: Wavelength,
    /// Two-bounce paths came with the scenes (`two_bounce_path`).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub two_bounce: bool,
    /// The time gate of the histograms.
    pub gate: Gate,
    /// Codec of the transients.
    pub profile: Profile,
}

/// A set of subsets of the 10×10 grid of spots, named by their sizes; see
/// [`crate::Quantity::spots_of_100`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "Vec<u32>", into = "Vec<u32>")]
pub struct Subsets {
    four: bool,
    twenty_five: bool,
}

impl Subsets {
    /// The empty set.
    pub const NONE: Self = Self {
        four: false,
        twenty_five: false,
    };

    /// Returns the subsets of the given sizes.
    ///
    /// ```
    /// use picofarm_dataset::Subsets;
    ///
    /// assert!(Subsets::of(&[4, 25]).is_ok());
    /// assert_eq!(Subsets::of(&[9]).unwrap_err(), "9 is not one of 4, 25");
    /// ```
    ///
    /// # Errors
    /// A message that names an unknown size.
    pub fn of(sizes: &[u32]) -> Result<Self, String> {
        let mut subsets = Self::NONE;
        for size in sizes {
            match size {
                4 => subsets.four = true,
                25 => subsets.twenty_five = true,
                other => return Err(format!("{other} is not one of 4, 25")),
            }
        }
        Ok(subsets)
    }

    /// Returns whether the set is empty.
    pub fn is_empty(&self) -> bool {
        *self == Self::NONE
    }

    /// Returns the sizes of the subsets, ascending.
    pub fn sizes(self) -> Vec<u32> {
        let all = [(self.four, 4), (self.twenty_five, 25)];
        all.into_iter().filter(|s| s.0).map(|s| s.1).collect()
    }
}

impl TryFrom<Vec<u32>> for Subsets {
    type Error = String;

    fn try_from(sizes: Vec<u32>) -> Result<Self, String> {
        Self::of(&sizes)
    }
}

impl From<Subsets> for Vec<u32> {
    fn from(subsets: Subsets) -> Self {
        subsets.sizes()
    }
}

impl Profile {
    /// The square-root code with Δ = 0.5: a rms error of an eighth of the photon noise.
    pub const BALANCED: Self = Self::SqrtU16 { delta: 0.5 };
    /// The square-root code with Δ = 1: half the bytes, with an error still below the photon noise.
    pub const COARSE: Self = Self::SqrtU16 { delta: 1.0 };
    /// Floats rounded to a quarter of the photon noise.
    pub const PLAIN: Self = Self::PlainF32 { round: 0.25 };
    /// Floats without rounding.
    pub const LOSSLESS: Self = Self::PlainF32 { round: 0.0 };
    /// The names accepted by [`Self::parse`].
    pub const NAMES: [&str; 6] = [
        "sqrt-u16",
        "balanced",
        "coarse",
        "plain-f32",
        "lossless",
        "counts-u16",
    ];

    /// Returns the profile's name in job specifications.
    pub fn name(&self) -> &'static str {
        match self {
            Self::SqrtU16 { delta: 0.5 } => "balanced",
            Self::SqrtU16 { delta: 1.0 } => "coarse",
            Self::SqrtU16 { .. } => "sqrt-u16",
            Self::PlainF32 { round: 0.0 } => "lossless",
            Self::PlainF32 { .. } => "plain-f32",
            Self::CountsU16 => "counts-u16",
        }
    }

    /// Returns the profile with this name in job specifications.
    ///
    /// ```
    /// use picofarm_dataset::Profile;
    ///
    /// let coarse = Profile::parse("coarse")?;
    /// assert_eq!(coarse, Profile::SqrtU16 { delta: 1.0 });
    /// assert_eq!(coarse.to_string(), "coarse with delta 1");
    /// assert_eq!(Profile::default().to_string(), "sqrt-u16 with delta 0.2");
    /// # Ok::<(), String>(())
    /// ```
    ///
    /// # Errors
    /// A message that lists the valid names.
    pub fn parse(name: &str) -> Result<Self, String> {
        match name {
            "sqrt-u16" => Ok(Self::default()),
            "balanced" => Ok(Self::BALANCED),
            "coarse" => Ok(Self::COARSE),
            "plain-f32" => Ok(Self::PLAIN),
            "lossless" => Ok(Self::LOSSLESS),
            "counts-u16" => Ok(Self::CountsU16),
            other => {
                let names = Self::NAMES.map(|name| format!("{name:?}")).join(", ");
                Err(format!("{other:?} is not one of {names}"))
            }
        }
    }
}

impl std::fmt::Display for Profile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::SqrtU16 { delta } => write!(f, "{} with delta {delta}", self.name()),
            Self::PlainF32 { round: 0.0 } => write!(f, "lossless"),
            Self::PlainF32 { round } => write!(f, "plain-f32 rounded to {round} sigma"),
            Self::CountsU16 => write!(f, "counts-u16"),
        }
    }
}

impl DatasetSpec {
    /// Checks that all numbers are in range, so that every array's shape and key exist.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] names the field.
    pub fn check(&self) -> Result<(), StorageError> {
        let sizes = [
            ("spec.scenes", self.scenes, 1 << 32),
            ("spec.height", u64::from(self.height), 1 << 14),
            ("spec.width", u64::from(self.width), 1 << 14),
            ("spec.spots", u64::from(self.spots), 1 << 14),
            ("spec.gate.bins", u64::from(self.gate.bins), 1 << 18),
        ];
        for (field, value, max) in sizes {
            if value == 0 || value > max {
                return Err(StorageError::invalid(
                    field,
                    format!("expected 1 to {max}, found {value}"),
                ));
            }
        }
        if !self.subsets.is_empty() && self.spots != 100 {
            return Err(StorageError::invalid(
                "spec.subsets",
                format!(
                    "{:?} are subsets of a grid of 100 spots, found {} spots",
                    self.subsets.sizes(),
                    self.spots
                ),
            ));
        }
        if !self.gate.start_m.is_finite() {
            return Err(StorageError::invalid(
                "spec.gate.start_m",
                format!(
                    "expected a finite length in metres, found {}",
                    self.gate.start_m
                ),
            ));
        }
        if !(self.gate.bin_width_m.is_finite() && self.gate.bin_width_m > 0.0) {
            return Err(StorageError::invalid(
                "spec.gate.bin_width_m",
                format!(
                    "expected a positive length in metres, found {}",
                    self.gate.bin_width_m
                ),
            ));
        }
        if let Profile::SqrtU16 { delta } = self.profile {
            let known = [0.0625, 0.125, 0.2, 0.25, 0.5, 1.0, 2.0];
            if !known.contains(&delta) {
                return Err(StorageError::invalid(
                    "spec.profile.delta",
                    format!("expected one of {known:?}, found {delta}"),
                ));
            }
        }
        if let Profile::PlainF32 { round } = self.profile {
            let known = [0.0, 0.0625, 0.125, 0.25, 0.5, 1.0];
            if !known.contains(&round) {
                return Err(StorageError::invalid(
                    "spec.profile.round",
                    format!("expected one of {known:?}, found {round}"),
                ));
            }
        }
        Ok(())
    }

    /// Returns the number of pixels of one image.
    pub fn pixels(&self) -> usize {
        self.height as usize * self.width as usize
    }

    /// Returns the number of values in one scene's transient.
    pub fn transient_len(&self) -> usize {
        self.pixels() * self.gate.bins as usize
    }

    /// Images of a quantity that is a transient: one for each spot of `transient_spots`, otherwise
    /// one.
    pub fn planes(&self, quantity: Quantity) -> usize {
        match quantity {
            Quantity::TransientSpots => self.spots as usize,
            _ => 1,
        }
    }

    /// Returns the quantities of its scenes, in the order of their objects in a manifest.
    pub fn quantities(&self) -> Vec<Quantity> {
        let has = |q: &Quantity| match q {
            Quantity::Transient4 => self.subsets.four,
            Quantity::Transient25 => self.subsets.twenty_five,
            Quantity::TransientSpots => self.per_spot,
            Quantity::TwoBouncePath => self.two_bounce,
            _ => true,
        };
        Quantity::ALL.into_iter().filter(has).collect()
    }

    /// Returns the first field, other than the number of scenes, that differs in `asked`: (field,
    /// stored, asked).
    pub(crate) fn difference(&self, asked: &Self) -> Option<(&'static str, String, String)> {
        let pairs = [
            ("height", self.height.to_string(), asked.height.to_string()),
            ("width", self.width.to_string(), asked.width.to_string()),
            ("spots", self.spots.to_string(), asked.spots.to_string()),
            (
                "subsets",
                format!("{:?}", self.subsets.sizes()),
                format!("{:?}", asked.subsets.sizes()),
            ),
            (
                "per_spot",
                self.per_spot.to_string(),
                asked.per_spot.to_string(),
            ),
            (
                "wavelengths_nm",
                format!("{:?}", Vec::from(self.wavelengths_nm)),
                format!("{:?}", Vec::from(asked.wavelengths_nm)),
            ),
            (
                "two_bounce",
                self.two_bounce.to_string(),
                asked.two_bounce.to_string(),
            ),
            (
                "gate.start_m",
                self.gate.start_m.to_string(),
                asked.gate.start_m.to_string(),
            ),
            (
                "gate.bin_width_m",
                self.gate.bin_width_m.to_string(),
                asked.gate.bin_width_m.to_string(),
            ),
            (
                "gate.bins",
                self.gate.bins.to_string(),
                asked.gate.bins.to_string(),
            ),
            (
                "profile",
                self.profile.to_string(),
                asked.profile.to_string(),
            ),
        ];
        pairs.into_iter().find(|(_, stored, asked)| stored != asked)
    }
}
