//! Options of an import: the format, and overrides of values in the files or conventions of the
//! format.

use serde::{Deserialize, Serialize};

use super::ImportError;

/// Supported layouts of measured or rendered data.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// The paper's release: `lidar_{4,25,100}.exr`, `depth.exr`, `specular_mask.png`,
    /// `shadows_v1.npz` and `lights_camera_frame.npy` in a folder per scene.
    Sb3d,
    /// PlatoNeRF's simulated captures: `transforms_train.json` and a `.npy` per illumination spot.
    Platonerf,
    /// Bounce-flash lidar captures: `spot_*.mat`, each with a `dataCube`, and `detector_scan*.mat`.
    BfLidar,
    /// `scene.json` and `.npy` files in a folder per scene: our own minimal layout.
    Npy,
}

impl Format {
    /// All formats.
    pub const ALL: [Self; 4] = [Self::Sb3d, Self::Platonerf, Self::BfLidar, Self::Npy];

    /// Returns its name on the command line and in provenance.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sb3d => "sb3d",
            Self::Platonerf => "platonerf",
            Self::BfLidar => "bf-lidar",
            Self::Npy => "npy",
        }
    }

    /// Returns the format called `name`.
    ///
    /// ```
    /// use picofarm_exchange::import::Format;
    ///
    /// assert_eq!(Format::parse("npy"), Ok(Format::Npy));
    /// assert!(Format::parse("zip").is_err());
    /// ```
    ///
    /// # Errors
    /// A message that lists the valid names.
    pub fn parse(name: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|f| f.name() == name);
        found.ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            format!("{name:?} is not one of {names}")
        })
    }
}

/// The meaning of 1 in a visibility mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Polarity {
    /// The spot lights the pixel.
    Lit,
    /// The pixel is in shadow.
    Shadow,
}

/// The content of a depth image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DepthKind {
    /// The z coordinate.
    Z,
    /// The distance along the ray.
    Range,
}

/// The assignment of single-spot captures to scenes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Captures {
    /// Each capture is a scene with one spot.
    #[default]
    Separate,
    /// All captures of a folder are summed into one scene with all spots.
    Sum,
    /// Like `Sum`, and the scene also has each capture.
    Both,
}

/// Overrides. A `None` value is taken from the files or from the format's conventions, and checked.
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
    /// The meaning of 1 in visibility masks.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub visibility: Option<Polarity>,
    /// The content of the depth image.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<DepthKind>,
    /// The paper's spot count to import.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spots: Option<u32>,
    /// Laser origin in metres, in the detector frame of the files.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub laser_m: Option<[f64; 3]>,
    /// Arrival time at zero distance, in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub t0_s: Option<f64>,
    /// The assignment of captures to scenes.
    pub captures: Captures,
    /// No mirrors reflect the beams: each goes straight from the laser to its spot.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub straight_beams: bool,
    /// Skip the cross-check of histograms against geometry.
    pub unchecked: bool,
}

impl ImportOptions {
    /// Returns an error for options that the format does not use, and for invalid values.
    pub(super) fn check(&self, format: Format) -> Result<(), ImportError> {
        use Format::{BfLidar, Npy, Platonerf, Sb3d};
        let given: [(&'static str, bool, &[Format]); 13] = [
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
            (
                "--captures both",
                self.captures == Captures::Both,
                &[BfLidar],
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
