//! What the person who imports says: the format, and what overrides what the files say or what the format is known for.

use serde::{Deserialize, Serialize};

use super::ImportError;

/// Known ways to lay measured or rendered data out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// The paper's release: `lidar_{4,25,100}.exr`, `depth.exr`, `specular_mask.png`, `shadows_v1.npz` and
    /// `lights_camera_frame.npy` in a folder for each scene.
    Sb3d,
    /// PlatoNeRF's simulated captures: `transforms_train.json` and a `.npy` for each illumination spot.
    Platonerf,
    /// Bounce-flash lidar captures: `spot_*.mat` with a `dataCube` each, and `detector_scan*.mat`.
    BfLidar,
    /// `scene.json` and `.npy` files in a folder for each scene: our own minimal layout.
    Npy,
}

impl Format {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Sb3d, Self::Platonerf, Self::BfLidar, Self::Npy];

    /// Its name on the command line and in provenance.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sb3d => "sb3d",
            Self::Platonerf => "platonerf",
            Self::BfLidar => "bf-lidar",
            Self::Npy => "npy",
        }
    }

    /// The format called `name`.
    ///
    /// # Errors
    /// A message that lists the names there are.
    pub fn parse(name: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|f| f.name() == name);
        found.ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            format!("{name:?} is not one of {names}")
        })
    }
}

/// What 1 means in a mask of visibility.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Polarity {
    /// The spot lights the pixel.
    Lit,
    /// The pixel lies in shadow.
    Shadow,
}

/// What a depth image holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DepthKind {
    /// The z coordinate.
    Z,
    /// The distance along the ray.
    Range,
}

/// How captures of single spots become scenes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Captures {
    /// Each is a scene with one spot.
    #[default]
    Separate,
    /// All of a folder are summed into one scene with all spots.
    Sum,
}

/// Overrides; what is `None` is taken from the files, or from the format's definition, and checked.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImportOptions {
    /// ℓ_min, metres of path.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gate_start_m: Option<f64>,
    /// Bin width, metres of path.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bin_width_m: Option<f64>,
    /// Number of bins to keep.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bins: Option<u32>,
    /// Horizontal field of view, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fov_deg: Option<f64>,
    /// Metres in the unit of depth and positions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub length_unit_m: Option<f64>,
    /// What 1 means in the masks of visibility.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub visibility: Option<Polarity>,
    /// What the depth image holds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<DepthKind>,
    /// Which of the paper's spot counts to take.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spots: Option<u32>,
    /// Laser origin, metres, in the detector's frame as the files have it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub laser_m: Option<[f64; 3]>,
    /// Time of arrival at no distance, seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub t0_s: Option<f64>,
    /// How captures become scenes.
    pub captures: Captures,
    /// No mirror folds a beam: each goes straight from the laser to its spot.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub straight_beams: bool,
    /// Leave the cross-check of histograms against geometry out.
    pub unchecked: bool,
}

impl ImportOptions {
    /// Refuses options without a use for the format, and values that cannot be.
    pub(super) fn check(&self, format: Format) -> Result<(), ImportError> {
        use Format::{BfLidar, Npy, Platonerf, Sb3d};
        let given: [(&'static str, bool, &[Format]); 12] = [
            (
                "--gate-start-m",
                self.gate_start_m.is_some(),
                &[Sb3d, Platonerf, BfLidar],
            ),
            (
                "--bin-width-m",
                self.bin_width_m.is_some(),
                &[Sb3d, Platonerf, BfLidar],
            ),
            ("--bins", self.bins.is_some(), &[BfLidar]),
            ("--fov-deg", self.fov_deg.is_some(), &[Sb3d, Platonerf]),
            ("--length-unit-m", self.length_unit_m.is_some(), &[Sb3d]),
            ("--visibility", self.visibility.is_some(), &[Sb3d]),
            ("--depth", self.depth.is_some(), &[Sb3d]),
            ("--spots", self.spots.is_some(), &[Sb3d]),
            ("--laser-m", self.laser_m.is_some(), &[BfLidar]),
            ("--t0-s", self.t0_s.is_some(), &[BfLidar]),
            ("--straight-beams", self.straight_beams, &[Sb3d, Npy]),
            (
                "--captures",
                self.captures != Captures::Separate,
                &[Platonerf, BfLidar],
            ),
        ];
        for (option, given, formats) in given {
            if given && !formats.contains(&format) {
                return Err(ImportError::UselessOption {
                    option,
                    format: format.name(),
                });
            }
        }
        let positive = |x: f64| x.is_finite() && x > 0.0;
        let values = [
            ("--bin-width-m", self.bin_width_m, 1.0),
            ("--length-unit-m", self.length_unit_m, 1e4),
            ("--fov-deg", self.fov_deg, 179.0),
        ];
        for (option, value, max) in values {
            if let Some(x) = value.filter(|x| !positive(*x) || *x > max) {
                let expected = format!("a positive number of at most {max}");
                return Err(ImportError::refused(
                    option,
                    "value",
                    expected,
                    x.to_string(),
                    "give another one",
                ));
            }
        }
        let finite = self
            .gate_start_m
            .into_iter()
            .chain(self.t0_s)
            .chain(self.laser_m.into_iter().flatten());
        if let Some(x) = finite.into_iter().find(|x| !x.is_finite()) {
            return Err(ImportError::refused(
                "options",
                "numbers",
                "finite ones",
                x.to_string(),
                "give another one",
            ));
        }
        Ok(())
    }
}
