//! Captures: one scene that a laboratory measured, with a histogram for each spot or their sum.
//!
//! [`import`] reads files in the laboratory's own format and a short description of what they do
//! not say (see [`EXAMPLE`]). [`Capture::write`] stores the capture in the form of a single
//! render, which every command for data sets accepts, and [`Capture::read`] reads such a folder.
//! Values are photons or energy as the files have them; nothing is normalised.

mod arrays;
mod consumer_nlos;
mod describe;
mod events;
mod folder;
mod h5;
mod kinds;
mod known;
mod own;
mod ptu;
mod resample;
mod tables;
mod walls;

use std::path::{Path, PathBuf};

use picofarm_dataset::{Gate, Intrinsics};
use picofarm_files::Opener;

pub use consumer_nlos::FORMAT as RELAY_ZONES;
pub use describe::EXAMPLE;
pub use folder::is_capture;
pub use resample::Resampling;

use super::files::Files;
use super::scene::clean;
use super::{ImportError, SourceFile};
use arrays::Part;
use describe::{Described, Description};

/// Name of a description that is found next to the files.
pub const DESCRIPTION: &str = "capture.json";

/// A beam of the laser, in the camera's axes, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Beam {
    /// The spot's place, and the length of the path from the laser to it.
    Spot {
        /// Position of the spot.
        position: [f32; 3],
        /// Length of the path from the laser.
        path_m: f32,
    },
    /// The direction in which the beam leaves the laser, as a unit vector.
    Direction([f32; 3]),
    /// The beam hits nothing.
    Nothing,
}

/// One measured scene. The axes are the camera's: x to the right, y downwards, z along the view,
/// with the camera at the origin. Paths count from the laser, via spot and surface, to the camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Capture {
    /// The name, from the description or the file.
    pub name: String,
    /// Rows of pixels.
    pub height: u32,
    /// Columns of pixels.
    pub width: u32,
    /// Start and width of the bins, metres of path.
    pub gate: Gate,
    /// The light of all spots, `[row][column][bin]`.
    pub sum: Vec<f32>,
    /// The light of each spot, `[spot][row][column][bin]`, if the spots were measured one by one.
    pub per_spot: Option<Vec<f32>>,
    /// The pinhole camera, in pixels.
    pub intrinsics: Intrinsics,
    /// Position of the laser.
    pub laser: [f32; 3],
    /// The beams, one for each spot.
    pub beams: Vec<Beam>,
    /// True z-depth in metres, `[row][column]`, 0 = unknown, if the files have it.
    pub depth: Option<Vec<f32>>,
    /// The origin of the capture.
    pub origin: Origin,
}

/// The source of a capture, and the conversions of its import.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Origin {
    /// The format of the files, for example `numpy`.
    pub format: String,
    /// The files with their SHA-256.
    pub files: Vec<SourceFile>,
    /// The conversions and assumptions, one sentence each.
    pub conversions: Vec<String>,
    /// Photons (or energy) of the files outside the gate that was kept.
    pub outside: f64,
    /// Photons (or energy) of pixels that were cropped away.
    pub cropped: f64,
}

impl Capture {
    /// Returns the number of pixels.
    pub fn pixels(&self) -> usize {
        self.height as usize * self.width as usize
    }

    /// Returns the histograms of one spot, `[row][column][bin]`; `None` without histograms for
    /// each spot, or for a spot that does not exist.
    pub fn spot(&self, spot: usize) -> Option<&[f32]> {
        let len = self.pixels() * self.gate.bins as usize;
        self.per_spot.as_ref()?.get(spot * len..(spot + 1) * len)
    }
}

/// Reads a capture from files of a laboratory.
///
/// `files` are histogram files, one folder, or one description. Several files are one spot each,
/// in this order. `describe` names the description; without it, a file `capture.json` in the folder
/// of the first file is used. A folder without description must be in one of the formats of
/// [`super::Source`].
///
/// # Errors
/// [`ImportError`] names the file and the field. For an unknown file it describes what the file
/// looks like and how to describe it.
pub fn import(
    files: &[PathBuf],
    describe: Option<&Path>,
    opener: &Opener,
) -> Result<Capture, ImportError> {
    let (described, named) = Described::find(files, describe, opener)?;
    let root = described.folder.clone();
    let reader = Files::new(&root, opener);
    let description = described.read(&reader)?;
    let named = match named.is_empty() {
        false => named,
        true => description.files(&described, &reader)?,
    };
    if named.is_empty() {
        return known::read(&described, &description, opener);
    }
    let mut parts = Vec::new();
    let several = named.len() > 1;
    for file in &named {
        opener.check(file)?;
        parts.push(kinds::read(file, &description, &described, &reader)?);
    }
    let part = join(parts)?;
    let mut capture = finish(part, several, &description, &described, &reader)?;
    capture.origin.files = reader.into_list();
    Ok(capture)
}

/// Joins files of one spot each.
fn join(mut parts: Vec<Part>) -> Result<Part, ImportError> {
    let mut first = parts.remove(0);
    if parts.is_empty() {
        return Ok(first);
    }
    for part in std::iter::once(&first).chain(&parts) {
        if part.format == consumer_nlos::FORMAT {
            return Err(ImportError::refused(
                &part.file,
                "files",
                "one frame of a moving sensor",
                format!("{} files", parts.len() + 1),
                "import each frame alone",
            ));
        }
        if part.apart {
            return Err(ImportError::refused(
                &part.file,
                "axes",
                "histograms of one spot in each of several files",
                "an axis \"spot\"",
                "import this file alone",
            ));
        }
        if part.dims != first.dims {
            return Err(ImportError::refused(
                &part.file,
                "shape",
                format!(
                    "{:?} (row, column, bin), as in {}",
                    &first.dims[1..],
                    first.file.display()
                ),
                format!("{:?}", &part.dims[1..]),
                "import captures of one shape together",
            ));
        }
    }
    for part in parts {
        first.values.extend(part.values);
        first.dims[0] += 1;
        first.outside += part.outside;
        first.notes.extend(part.notes);
        if let (Some(all), Some(more)) = (&mut first.stated.beams, part.stated.beams) {
            all.extend(more);
        }
    }
    first
        .notes
        .push(format!("{} files are one spot each", first.dims[0]));
    first.apart = true;
    Ok(first)
}

/// The name of a capture without a name: the file's, or that of the folder of several files.
fn named_after(file: &Path, several: bool) -> String {
    let folder = file.parent().and_then(Path::file_name);
    let name = match several {
        true => folder.or(file.file_stem()),
        false => file.file_stem(),
    };
    name.unwrap_or_default().to_string_lossy().into_owned()
}

/// Combines histograms with the description of what they do not say.
fn finish(
    mut part: Part,
    several: bool,
    description: &Description,
    described: &Described,
    reader: &Files,
) -> Result<Capture, ImportError> {
    let file = part.file.clone();
    let calibration = description.calibration(&part, described, reader)?;
    let mut gate = calibration.gate;
    let mut notes = std::mem::take(&mut part.notes);
    notes.extend(calibration.notes);
    if !part.binned {
        let kept = description.kept(&gate, &described.file)?;
        if kept != (0..gate.bins as usize) {
            let (values, outside) = arrays::cut(&part.values, gate.bins as usize, &kept);
            notes.push(format!(
                "bins {} to {} of {} kept",
                kept.start,
                kept.end - 1,
                gate.bins
            ));
            part.outside += outside;
            gate = Gate {
                start_m: gate.start_m + kept.start as f64 * gate.bin_width_m,
                bins: kept.len() as u32,
                ..gate
            };
            part.values = values;
        }
    }
    clean(&file, &mut part.values, gate.bins as usize, &mut notes)?;
    let [spots, height, width, _] = part.dims;
    let (sum, per_spot) = match part.apart {
        true => (arrays::sum(&part.values, spots), Some(part.values)),
        false => (part.values, None),
    };
    let name = description
        .name
        .clone()
        .unwrap_or_else(|| named_after(&file, several));
    Ok(Capture {
        name,
        height: height as u32,
        width: width as u32,
        gate,
        sum,
        per_spot,
        intrinsics: calibration.intrinsics,
        laser: calibration.laser,
        beams: calibration.beams,
        depth: calibration.depth,
        origin: Origin {
            format: part.format,
            files: Vec::new(),
            conversions: notes,
            outside: part.outside,
            cropped: 0.0,
        },
    })
}
