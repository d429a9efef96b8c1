//! The description of a capture: what histogram files do not say.

use std::ops::Range;
use std::path::{Path, PathBuf};

use picofarm_dataset::{Gate, Intrinsics};
use picofarm_files::Opener;
use serde::Deserialize;
use serde_json::Value;

use super::super::files::Files;
use super::super::scene::intrinsics_from_fov;
use super::super::vector::{distance, norm};
use super::super::{ImportError, ImportOptions, npy};
use super::arrays::Part;
use super::{Beam, DESCRIPTION};

/// Speed of light, metres per picosecond.
const LIGHT_M_PS: f64 = 299_792_458.0 * 1e-12;
/// Most beams of a capture.
const MOST_BEAMS: usize = 1 << 14;

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

/// When the bins are.
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

/// What a capture needs besides histograms.
pub(super) struct Calibration {
    pub gate: Gate,
    pub intrinsics: Intrinsics,
    pub laser: [f32; 3],
    pub beams: Vec<Beam>,
    pub depth: Option<Vec<f32>>,
    pub notes: Vec<String>,
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
            let hint = format!("correct the description, for example\n{EXAMPLE}");
            ImportError::unreadable(&self.file, e, hint)
        })
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
        Ok(ImportOptions {
            gate_start_m: g.keep_m.map(|k| k[0]).or(g.start_m),
            bin_width_m: metres(g.bin_width_m, g.bin_width_ps),
            bins: g.bins,
            fov_deg: self.camera.as_ref().and_then(|c| c.fov_deg),
            laser_m: self.laser(described)?,
            t0_s: g.t0_ps.map(|t| t * 1e-12),
            ..ImportOptions::default()
        })
    }

    /// Returns start and width of the bins in metres of path, if the description has them.
    fn gate_m(&self, described: &Described) -> Result<Option<[f64; 2]>, ImportError> {
        let g = &self.gate;
        let width = match (g.bin_width_m, g.bin_width_ps) {
            (None, None) => None,
            (Some(m), None) => Some(m),
            (None, Some(ps)) => Some(ps * LIGHT_M_PS),
            (Some(_), Some(_)) => {
                let what = "bin_width_m or bin_width_ps";
                return Err(described.refused("gate", what, "both"));
            }
        };
        let start = match (g.start_m, g.start_ps, g.t0_ps) {
            (None, None, None) => None,
            (Some(m), None, None) => Some(m),
            (None, start, Some(t0)) => Some((start.unwrap_or(0.0) - t0) * LIGHT_M_PS),
            (None, Some(_), None) => {
                let what =
                    "t0_ps with start_ps: the time at which light without a path would arrive";
                return Err(described.refused("gate.t0_ps", what, "none"));
            }
            (Some(_), ..) => {
                let what = "start_m, or start_ps and t0_ps";
                return Err(described.refused("gate", what, "both"));
            }
        };
        match (start, width) {
            (Some(start), Some(width)) if start.is_finite() && width.is_finite() && width > 0.0 => {
                Ok(Some([start, width]))
            }
            (Some(start), Some(width)) => {
                let found = format!("start {start} m, width {width} m");
                Err(described.refused("gate", "a finite start and a positive width", found))
            }
            (None, None) => Ok(None),
            (Some(_), None) => Err(described.refused(
                "gate.bin_width_m",
                "the width of a bin: bin_width_m, or bin_width_ps",
                "none",
            )),
            (None, Some(_)) => Err(described.refused(
                "gate.start_m",
                "the path at which bin 0 starts: start_m, or t0_ps and, if it is not 0, start_ps",
                "none",
            )),
        }
    }

    /// Returns the gate into which photon events are binned: start and width in metres, bins.
    pub fn event_gate(
        &self,
        described: &Described,
        unit_ps: f64,
        most: Option<u64>,
    ) -> Result<Gate, ImportError> {
        let with_unit = Self {
            gate: GateText {
                bin_width_ps: match (self.gate.bin_width_m, self.gate.bin_width_ps) {
                    (None, None) => Some(unit_ps),
                    (_, given) => given,
                },
                ..self.gate.clone()
            },
            ..Self::default()
        };
        let Some([start, width]) = with_unit.gate_m(described)? else {
            return Err(described.refused(
                "gate.t0_ps",
                "the time at which light without a path would arrive",
                "none",
            ));
        };
        let (start, bins) = match (self.gate.keep_m, self.gate.bins, most) {
            (Some([from, to]), None, _) if to > from => {
                (from, libm::ceil((to - from) / width - 1e-6))
            }
            (Some(_), ..) => {
                let what = "two increasing paths, without gate.bins";
                return Err(described.refused(
                    "gate.keep_m",
                    what,
                    format!("{:?}", self.gate.keep_m),
                ));
            }
            (None, Some(bins), _) => (start, f64::from(bins)),
            (None, None, Some(units)) => (
                start,
                libm::ceil(units as f64 * unit_ps * LIGHT_M_PS / width),
            ),
            (None, None, None) => {
                let what = "the number of bins, or keep_m: the first and the last path";
                return Err(described.refused("gate.bins", what, "none"));
            }
        };
        if !(1.0..=f64::from(1 << 18)).contains(&bins) {
            let what = format!("1 to {} bins", 1 << 18);
            return Err(described.refused("gate", what, bins.to_string()));
        }
        Ok(Gate {
            start_m: start,
            bin_width_m: width,
            bins: bins as u32,
        })
    }

    /// Returns the path in metres of a photon that arrives this many picoseconds after time 0 of
    /// the files.
    pub fn path_m(&self, ps: f64) -> f64 {
        match (self.gate.start_m, self.gate.t0_ps) {
            (Some(start), _) => start + ps * LIGHT_M_PS,
            (None, t0) => (ps - t0.unwrap_or(0.0)) * LIGHT_M_PS,
        }
    }

    /// Returns the bins to keep.
    pub fn kept(&self, gate: &Gate, file: &Path) -> Result<Range<usize>, ImportError> {
        let all = 0..gate.bins as usize;
        let Some([from, to]) = self.gate.keep_m else {
            return Ok(all);
        };
        let bin = |path: f64| {
            let bin = libm::round((path - gate.start_m) / gate.bin_width_m);
            bin.clamp(0.0, f64::from(gate.bins)) as usize
        };
        let kept = bin(from)..bin(to);
        if kept.is_empty() {
            return Err(ImportError::refused(
                file,
                "gate.keep_m",
                format!(
                    "two increasing paths within {:.4} to {:.4} m, the files' gate",
                    gate.start_m,
                    gate.end_m()
                ),
                format!("{from} to {to}"),
                "correct the description: paths count from laser to camera",
            ));
        }
        Ok(kept)
    }

    /// For each of our axes (right, down, forward): index of the description's axis, and sign.
    fn frame(&self, described: &Described) -> Result<[(usize, f64); 3], ImportError> {
        let Some(names) = &self.frame else {
            return Ok([(0, 1.0), (1, 1.0), (2, 1.0)]);
        };
        let expected = "right or left, down or up, forward or backward, each once";
        let refused = || described.refused("frame", expected, format!("{names:?}"));
        let mut axes = [None; 3];
        for (from, name) in names.iter().enumerate() {
            let (to, sign) = match name.as_str() {
                "right" => (0, 1.0),
                "left" => (0, -1.0),
                "down" => (1, 1.0),
                "up" => (1, -1.0),
                "forward" => (2, 1.0),
                "backward" => (2, -1.0),
                _ => return Err(refused()),
            };
            axes[to] = Some((from, sign));
        }
        let [Some(x), Some(y), Some(z)] = axes else {
            return Err(refused());
        };
        Ok([x, y, z])
    }

    /// The laser in the camera's axes.
    fn laser(&self, described: &Described) -> Result<Option<[f64; 3]>, ImportError> {
        let Some(laser) = self.laser_m else {
            return Ok(None);
        };
        let frame = self.frame(described)?;
        Ok(Some(frame.map(|(from, sign)| sign * laser[from])))
    }

    /// Points of the description in the camera's axes.
    fn points(
        &self,
        field: &str,
        value: &Value,
        described: &Described,
        reader: &Files,
    ) -> Result<Option<Vec<[f64; 3]>>, ImportError> {
        let expected = "a list of [x, y, z], or the name of a .npy file [spots, 3]";
        let rows: Vec<[f64; 3]> = match value {
            Value::Null => return Ok(None),
            Value::String(name) => {
                let path = reader.named(&described.folder, name)?;
                let array = npy::parse(&path, &reader.bytes(&path)?)?;
                if array.shape.len() != 2 || array.shape[1] != 3 {
                    let found = format!("an array {:?} in {name}", array.shape);
                    return Err(described.refused(field, expected, found));
                }
                let rows = array.values.chunks_exact(3);
                rows.map(|r| [r[0], r[1], r[2]].map(f64::from)).collect()
            }
            list => serde_json::from_value(list.clone())
                .map_err(|e| described.refused(field, expected, e.to_string()))?,
        };
        if rows.is_empty() || rows.len() > MOST_BEAMS {
            let found = format!("{} rows", rows.len());
            return Err(described.refused(field, format!("1 to {MOST_BEAMS} rows"), found));
        }
        let frame = self.frame(described)?;
        let turn = |r: &[f64; 3]| frame.map(|(from, sign)| sign * r[from]);
        Ok(Some(rows.iter().map(turn).collect()))
    }

    /// Returns the camera's intrinsics.
    fn intrinsics(
        &self,
        (height, width): (usize, usize),
        described: &Described,
    ) -> Result<Option<Intrinsics>, ImportError> {
        let Some(c) = &self.camera else {
            return Ok(None);
        };
        let found = format!("{c:?}");
        if let Some(fov) = c.fov_deg {
            if c.fx.or(c.fy).or(c.cx).or(c.cy).is_some() {
                let what = "fov_deg alone, or fx, fy, cx, cy";
                return Err(described.refused("camera", what, found));
            }
            if !(fov > 0.0 && fov < 180.0) {
                let what = "more than 0 and less than 180: the width of the view in degrees";
                return Err(described.refused("camera.fov_deg", what, fov.to_string()));
            }
            return Ok(Some(intrinsics_from_fov(width as u32, height as u32, fov)));
        }
        let Some(fx) = c.fx else {
            return Err(described.refused("camera", "fov_deg, or fx, fy, cx, cy in pixels", found));
        };
        let fy = c.fy.unwrap_or(fx);
        let (cx, cy) = (
            c.cx.unwrap_or(width as f64 / 2.0),
            c.cy.unwrap_or(height as f64 / 2.0),
        );
        if !(fx > 0.0 && fy > 0.0 && [fx, fy, cx, cy].iter().all(|x| x.is_finite())) {
            return Err(described.refused("camera", "positive focal lengths in pixels", found));
        }
        Ok(Some(Intrinsics {
            fx: fx as f32,
            fy: fy as f32,
            cx: cx as f32,
            cy: cy as f32,
        }))
    }

    /// Combines what the description and the file say. The description has precedence.
    pub fn calibration(
        &self,
        part: &Part,
        described: &Described,
        reader: &Files,
    ) -> Result<Calibration, ImportError> {
        let [spots, height, width, bins] = part.dims;
        let mut notes = Vec::new();
        let mut overridden = |what: &str| {
            notes.push(format!("{what} of the file replaced by the description's"));
        };
        let gate = match part.binned {
            true => part.stated.gate,
            false => {
                let ours = self.gate_m(described)?;
                if ours.is_some() && part.stated.gate.is_some() {
                    overridden("the gate");
                }
                ours.or(part.stated.gate)
            }
        };
        let camera = self.intrinsics((height, width), described)?;
        let laser = self.laser(described)?;
        let places = self.points("spots_m", &self.spots_m, described, reader)?;
        let ways = self.points("directions", &self.directions, described, reader)?;
        for (what, ours, theirs) in [
            (
                "the camera",
                camera.is_some(),
                part.stated.intrinsics.is_some(),
            ),
            ("the laser", laser.is_some(), part.stated.laser.is_some()),
            (
                "the spots",
                places.is_some() || ways.is_some(),
                part.stated.beams.is_some(),
            ),
        ] {
            if ours && theirs {
                overridden(what);
            }
        }
        let camera = camera.or(part.stated.intrinsics);
        let laser = laser.or(part.stated.laser);
        let beams = match (places, ways) {
            (Some(_), Some(_)) => {
                return Err(described.refused("spots_m", "spots_m or directions", "both"));
            }
            (Some(places), None) => {
                let laser = laser.unwrap_or_default();
                Some(places.iter().map(|p| placed(*p, laser)).collect())
            }
            (None, Some(ways)) => {
                let towards: Result<Vec<Beam>, ImportError> = ways
                    .iter()
                    .enumerate()
                    .map(|(k, way)| {
                        directed(*way).ok_or_else(|| {
                            let what = "a direction that is not zero";
                            described.refused(format!("directions[{k}]"), what, format!("{way:?}"))
                        })
                    })
                    .collect();
                Some(towards?)
            }
            (None, None) => part.stated.beams.clone(),
        };
        let lacking: Vec<&str> = [
            ("gate", gate.is_none()),
            ("camera", camera.is_none()),
            ("laser_m", laser.is_none()),
            ("spots_m (or directions)", beams.is_none()),
        ]
        .into_iter()
        .filter_map(|(name, lacks)| lacks.then_some(name))
        .collect();
        let (Some([start_m, bin_width_m]), Some(intrinsics), Some(laser), Some(beams)) =
            (gate, camera, laser, beams)
        else {
            let found = format!(
                "{} histograms of {height}x{width} pixels and {bins} bins in {}",
                spots,
                reader.name(&part.file)
            );
            return Err(described.refused(
                lacking.join(", "),
                "a value: the files do not say it",
                found,
            ));
        };
        if part.apart && beams.len() != spots {
            let what = format!("{spots}, one for each histogram");
            return Err(described.refused("spots_m, directions", what, format!("{}", beams.len())));
        }
        if let Some(given) = self
            .gate
            .bins
            .filter(|b| !part.binned && *b as usize != bins)
        {
            return Err(described.refused(
                "gate.bins",
                format!("{bins}, as the file has"),
                given.to_string(),
            ));
        }
        let depth = self.depth(intrinsics, (height, width), described, reader)?;
        Ok(Calibration {
            gate: Gate {
                start_m,
                bin_width_m,
                bins: bins as u32,
            },
            intrinsics,
            laser: laser.map(|x| x as f32),
            beams,
            depth,
            notes,
        })
    }

    /// The true z-depth.
    fn depth(
        &self,
        intrinsics: Intrinsics,
        (height, width): (usize, usize),
        described: &Described,
        reader: &Files,
    ) -> Result<Option<Vec<f32>>, ImportError> {
        let (field, name) = match (&self.depth_m, &self.range_m) {
            (None, None) => return Ok(None),
            (Some(name), None) => ("depth_m", name),
            (None, Some(name)) => ("range_m", name),
            (Some(_), Some(_)) => {
                return Err(described.refused("depth_m", "depth_m or range_m", "both"));
            }
        };
        let path = reader.named(&described.folder, name)?;
        let array = npy::parse(&path, &reader.bytes(&path)?)?;
        if array.shape != [height, width] {
            let expected = format!("an image [{height}, {width}]");
            return Err(described.refused(field, expected, format!("{:?}", array.shape)));
        }
        let z = |(pixel, value): (usize, &f32)| {
            let ray = super::super::scene::direction(intrinsics, pixel / width, pixel % width);
            match () {
                () if !value.is_finite() || *value <= 0.0 => 0.0,
                () if field == "depth_m" => *value,
                () => value / norm(ray) as f32,
            }
        };
        Ok(Some(array.values.iter().enumerate().map(z).collect()))
    }
}

/// A spot that a straight beam reaches; nothing for a point that is not finite.
pub(super) fn placed(point: [f64; 3], laser: [f64; 3]) -> Beam {
    match point.iter().all(|x| x.is_finite()) {
        true => Beam::Spot {
            position: point.map(|x| x as f32),
            path_m: distance(point, laser) as f32,
        },
        false => Beam::Nothing,
    }
}

/// A beam of a direction, which need not be a unit vector.
fn directed(way: [f64; 3]) -> Option<Beam> {
    let length = norm(way);
    (length.is_finite() && length > 0.0).then(|| Beam::Direction(way.map(|x| (x / length) as f32)))
}
