//! The description of a capture: what histogram files do not say.

mod calibration;
mod gate;

use std::path::{Path, PathBuf};

use picofarm_files::Opener;
use serde::Deserialize;
use serde_json::{Map, Value};

use super::super::files::Files;
use super::super::{ImportError, ImportOptions};
use super::DESCRIPTION;
pub(super) use calibration::placed;

/// Speed of light, metres per picosecond.
pub(super) const LIGHT_M_PS: f64 = 299_792_458.0 * 1e-12;

/// A description in ten lines, which errors and `--help` show.
pub const EXAMPLE: &str = r#"{
  "histograms": ["spot_0.npy", "spot_1.npy"],
  "axes": ["row", "column", "bin"],
  "gate": {"t0_ps": 14242.8, "bin_width_ps": 32.0, "keep_m": [0.9, 13.3]},
  "camera": {"fov_deg": 60.0},
  "frame": ["right", "down", "forward"],
  "laser_m": [0.10, 0.0, 0.0],
  "directions": [[-0.30, 0.10, 1.0], [0.25, 0.15, 1.0]]
}"#;

/// Forms of the fields, each with an example.
const FORMS: [(&str, &str); 11] = [
    ("name", "a text, e.g. \"the room\""),
    (
        "array",
        "the name of an array in the file, e.g. \"histograms\"",
    ),
    (
        "axes",
        "a list of names, e.g. [\"row\", \"column\", \"bin\"]",
    ),
    ("pixels", "two whole numbers [rows, columns], e.g. [64, 64]"),
    (
        "gate",
        "numbers by name, e.g. {\"t0_ps\": 14242.8, \"bin_width_ps\": 32.0, \"keep_m\": [0.9, 13.3]}",
    ),
    (
        "camera",
        "numbers by name, e.g. {\"fov_deg\": 60.0}, or {\"fx\": 55.4, \"fy\": 55.4, \"cx\": 32.0, \"cy\": 32.0}",
    ),
    (
        "frame",
        "three axes, e.g. [\"right\", \"down\", \"forward\"]",
    ),
    ("laser_m", "three numbers in metres, e.g. [0.10, 0.0, 0.0]"),
    ("depth_m", "the name of a .npy file, e.g. \"depth.npy\""),
    ("range_m", "the name of a .npy file, e.g. \"range.npy\""),
    (
        "events",
        "columns by name, e.g. {\"time\": \"t\", \"row\": \"y\", \"column\": \"x\", \"time_ps\": 1.0}",
    ),
];

/// The file of a description, as it is written.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Description {
    /// Name of the capture.
    pub name: Option<String>,
    /// One file, or a list of one file for each spot.
    histograms: Value,
    /// Name of the array in a `.npz`, MATLAB or HDF5 file.
    pub array: Option<String>,
    /// Names of the array's axes.
    pub axes: Option<Vec<String>>,
    /// Rows and columns.
    pub pixels: Option<[u32; 2]>,
    pub gate: GateText,
    camera: Option<CameraText>,
    /// Directions of the axes in which positions are given.
    frame: Option<[String; 3]>,
    laser_m: Option<[f64; 3]>,
    /// A list of points, or the name of a `.npy` file.
    spots_m: Value,
    directions: Value,
    depth_m: Option<String>,
    range_m: Option<String>,
    /// Columns of a table of photon events.
    pub events: Option<EventsText>,
}

/// The times of the bins.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct GateText {
    start_m: Option<f64>,
    bin_width_m: Option<f64>,
    start_ps: Option<f64>,
    pub bin_width_ps: Option<f64>,
    t0_ps: Option<f64>,
    /// First and last path to keep.
    keep_m: Option<[f64; 2]>,
    pub bins: Option<u32>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraText {
    fov_deg: Option<f64>,
    fx: Option<f64>,
    fy: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
}

impl std::fmt::Display for CameraText {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let fields = [
            ("fov_deg", self.fov_deg),
            ("fx", self.fx),
            ("fy", self.fy),
            ("cx", self.cx),
            ("cy", self.cy),
        ];
        let given: Vec<String> = fields
            .iter()
            .filter_map(|(name, value)| value.map(|v| format!("{name} {v}")))
            .collect();
        match given.is_empty() {
            true => f.write_str("nothing"),
            false => f.write_str(&given.join(", ")),
        }
    }
}

/// Columns of a table of photon events: names of the header, or numbers from 0.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct EventsText {
    /// The photon's time after the laser pulse.
    pub time: Option<Value>,
    /// Picoseconds in a unit of `time`.
    pub time_ps: Option<f64>,
    /// Number of the pixel, rows after rows.
    pub pixel: Option<Value>,
    pub row: Option<Value>,
    pub column: Option<Value>,
    pub spot: Option<Value>,
    /// Number of spots, with `spot`.
    pub spots: Option<u32>,
    /// Marks the start (`line_start`) and the end (`line_stop`) of a line and of a frame.
    pub marker: Option<Value>,
    /// Time since the start of the measurement, which places a photon within its line.
    pub clock: Option<Value>,
    pub line_start: Option<i64>,
    pub line_stop: Option<i64>,
    pub frame: Option<i64>,
    /// A character; a comma without it.
    pub separator: Option<char>,
}

/// A description's place.
#[derive(Debug, Clone)]
pub(super) struct Described {
    /// The description, or the first file without one.
    pub file: PathBuf,
    /// The folder that names are relative to.
    pub folder: PathBuf,
    /// Whether there is a description.
    given: bool,
    /// The folder among the arguments, if any.
    pub source: Option<PathBuf>,
}

impl Described {
    /// Finds the description and the files that the arguments name.
    pub fn find(
        files: &[PathBuf],
        describe: Option<&Path>,
        opener: &Opener,
    ) -> Result<(Self, Vec<PathBuf>), ImportError> {
        let Some(first) = files.first() else {
            return Err(ImportError::refused(
                "FILES",
                "files",
                "histogram files, a folder or a description",
                "none",
                "name at least one",
            ));
        };
        let parent = |path: &Path| match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
            _ => PathBuf::from("."),
        };
        let is_json = |path: &Path| path.extension().is_some_and(|e| e == "json");
        let folder = match first.is_dir() {
            true => first.clone(),
            false => parent(first),
        };
        if first.is_dir() && files.len() > 1 {
            return Err(ImportError::refused(
                first,
                "files",
                "one folder, or several files",
                format!("a folder and {} more", files.len() - 1),
                "name the files, or the folder alone",
            ));
        }
        let source = first.is_dir().then(|| first.clone());
        if files.len() == 1 && is_json(first) && !first.is_dir() {
            let this = Self {
                file: first.clone(),
                folder,
                given: true,
                source: None,
            };
            return Ok((this, Vec::new()));
        }
        let next_to = folder.join(DESCRIPTION);
        let found = describe.map(Path::to_owned);
        let found = found.or_else(|| next_to.is_file().then_some(next_to));
        let named = match first.is_dir() {
            true => Vec::new(),
            false => files.to_vec(),
        };
        if let Some(file) = &found {
            opener.check(file)?;
        }
        let this = Self {
            given: found.is_some(),
            folder: found.as_deref().map_or(folder, parent),
            file: found.unwrap_or_else(|| first.clone()),
            source,
        };
        Ok((this, named))
    }

    /// Reads the description; an empty one if there is none.
    pub fn read(&self, reader: &Files) -> Result<Description, ImportError> {
        if !self.given {
            return Ok(Description::default());
        }
        let bytes = reader.bytes(&self.file)?;
        serde_json::from_slice(&bytes).map_err(|e| {
            self.wrong_field(&bytes).unwrap_or_else(|| {
                let hint = format!("correct the description, for example\n{EXAMPLE}");
                ImportError::unreadable(&self.file, e, hint)
            })
        })
    }

    /// Returns the error about the field of a description that has another form than expected.
    fn wrong_field(&self, bytes: &[u8]) -> Option<ImportError> {
        let all: Map<String, Value> = serde_json::from_slice(bytes).ok()?;
        for (name, value) in all {
            let Some((_, expected)) = FORMS.iter().find(|(known, _)| *known == name) else {
                continue;
            };
            let alone = Value::Object(Map::from_iter([(name.clone(), value.clone())]));
            if let Err(e) = serde_json::from_value::<Description>(alone) {
                let found = format!("{value} ({e})");
                return Some(self.refused(name, *expected, found));
            }
        }
        None
    }

    /// Returns the error about a field of the description.
    pub fn refused(
        &self,
        field: impl Into<String>,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> ImportError {
        let hint = match self.given {
            true => "correct the description".to_owned(),
            false => format!(
                "write a description to {DESCRIPTION} next to the file, or name it with --describe, for example\n{EXAMPLE}"
            ),
        };
        ImportError::refused(&self.file, field, expected, found, hint)
    }
}

impl Description {
    /// Returns the files that the description names.
    pub fn files(
        &self,
        described: &Described,
        reader: &Files,
    ) -> Result<Vec<PathBuf>, ImportError> {
        let names: Vec<&str> = match &self.histograms {
            Value::Null if described.source.is_some() => return Ok(Vec::new()),
            Value::Null => {
                return Err(described.refused(
                    "histograms",
                    "a file name, or a list of one file for each spot",
                    "none",
                ));
            }
            Value::String(name) => vec![name],
            Value::Array(names) => {
                let all: Option<Vec<&str>> = names.iter().map(Value::as_str).collect();
                all.filter(|all| !all.is_empty()).ok_or_else(|| {
                    described.refused(
                        "histograms",
                        "a list of file names",
                        self.histograms.to_string(),
                    )
                })?
            }
            other => {
                return Err(described.refused("histograms", "file names", other.to_string()));
            }
        };
        let folder = &described.folder;
        names
            .iter()
            .map(|name| reader.named(folder, name))
            .collect()
    }

    /// Returns the options of an import in one of the formats of data sets.
    pub fn options(&self, described: &Described) -> Result<ImportOptions, ImportError> {
        let g = &self.gate;
        let metres = |m: Option<f64>, ps: Option<f64>| m.or_else(|| ps.map(|ps| ps * LIGHT_M_PS));
        let bin_width_m = metres(g.bin_width_m, g.bin_width_ps);
        let bins = match (g.keep_m, g.bins, bin_width_m) {
            (Some([from, to]), None, Some(width)) if to > from && width > 0.0 => {
                Some(libm::ceil((to - from) / width - 1e-6) as u32)
            }
            (Some([from, to]), None, _) => {
                let what = "two increasing paths, with gate.bin_width_ps";
                return Err(described.refused("gate.keep_m", what, format!("{from} to {to}")));
            }
            (_, bins, _) => bins,
        };
        Ok(ImportOptions {
            gate_start_m: g.keep_m.map(|k| k[0]).or(g.start_m),
            bin_width_m,
            bins,
            fov_deg: self.camera.as_ref().and_then(|c| c.fov_deg),
            laser_m: self.laser(described)?,
            t0_s: g.t0_ps.map(|t| t * 1e-12),
            ..ImportOptions::default()
        })
    }
}
