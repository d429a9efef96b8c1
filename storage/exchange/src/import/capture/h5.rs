//! HDF5 files: arrays that a description names, and the layouts of y-tal, Zaragoza-NLOS and
//! Photon-HDF5.

use std::path::Path;

use super::super::files::Files;
#[cfg(feature = "formats")]
use super::super::hdf5::Hdf5;
#[cfg(not(feature = "formats"))]
use super::super::without_formats::Hdf5;
use super::super::{ImportError, mat::MAX_VALUES};
use super::arrays::{Part, Strided};
use super::describe::{Described, Description};
use super::events::Binner;
use super::kinds::{chosen, ordered, unknown};
use super::{own, walls};

const HINT: &str = "see whether the file is whole (h5ls FILE), or save the array with numpy.save";

/// An open file whose arrays are read as a whole.
pub(super) struct H5<'a> {
    pub file: &'a Path,
    content: Hdf5,
}

impl H5<'_> {
    /// Returns an array's shape, slowest axis first; `None` if there is none of this name.
    pub fn shape(&self, name: &str) -> Result<Option<Vec<usize>>, ImportError> {
        let shape = self.content.shape(name).map_err(|e| self.broken(name, e))?;
        Ok(shape.map(|s| s.iter().map(|n| *n as usize).collect()))
    }

    /// Reads an array with its shape.
    pub fn array(&self, name: &str) -> Result<(Vec<usize>, Vec<f64>), ImportError> {
        let Some(shape) = self.shape(name)? else {
            return Err(self.refused(name, "an array", "none".into()));
        };
        let count = shape.iter().try_fold(1usize, |n, d| n.checked_mul(*d));
        if count.is_none_or(|n| n > MAX_VALUES) {
            let what = format!("announces {shape:?} values, more than {MAX_VALUES}");
            return Err(self.broken(name, what));
        }
        let values = self.content.all(name).map_err(|e| self.broken(name, e))?;
        Ok((shape, values))
    }

    /// Reads an attribute of the file that is a number.
    pub fn attribute(&self, name: &str) -> Result<Option<f64>, ImportError> {
        self.content
            .attribute(name)
            .map_err(|e| self.broken(name, e))
    }

    /// Reads one number.
    pub fn number(&self, name: &str) -> Result<f64, ImportError> {
        match self.array(name)?.1[..] {
            [x] if x.is_finite() => Ok(x),
            ref other => {
                Err(self.refused(name, "one finite number", format!("{} values", other.len())))
            }
        }
    }

    /// Reads a point.
    pub fn point(&self, name: &str) -> Result<[f64; 3], ImportError> {
        match self.array(name)?.1[..] {
            [x, y, z] => Ok([x, y, z]),
            ref other => {
                Err(self.refused(name, "three numbers", format!("{} values", other.len())))
            }
        }
    }

    pub fn refused(&self, name: &str, expected: impl Into<String>, found: String) -> ImportError {
        ImportError::refused(self.file, name, expected, found, HINT)
    }

    fn broken(&self, name: &str, what: String) -> ImportError {
        ImportError::unreadable(self.file, format!("{name}: {what}"), HINT)
    }
}

/// Reads a file.
pub(super) fn read(
    file: &Path,
    description: &Description,
    described: &Described,
    reader: &Files,
) -> Result<Part, ImportError> {
    reader.hash(file)?;
    let content = Hdf5::open(file).map_err(|e| ImportError::unreadable(file, e, HINT))?;
    let names = content.names();
    let h5 = H5 { file, content };
    if description.array.is_some() {
        return named(&h5, &names, description);
    }
    let has = |all: &[&str]| all.iter().all(|n| names.iter().any(|m| m == n));
    if h5.shape("photon_data/timestamps")?.is_some() {
        return photons(&h5, description, described);
    }
    if has(&["transient", "intrinsics", "manifest"]) {
        return own::hdf5(&h5);
    }
    if has(&["H", "sensor_grid_xyz", "laser_grid_xyz"]) {
        return walls::tal(&h5);
    }
    if has(&["data", "cameraGridPositions", "laserGridPositions"]) {
        return walls::zaragoza(&h5);
    }
    if names.len() == 1 {
        return named(&h5, &names, description);
    }
    let mut shapes = Vec::new();
    for name in names.iter().take(24) {
        shapes.push(format!("{name} {:?}", h5.shape(name)?.unwrap_or_default()));
    }
    let looks = format!(
        "an HDF5 file of no layout this program knows, with the arrays {}; name the one of the histograms with \"array\" in a description",
        shapes.join(", ")
    );
    Err(unknown(file, &looks))
}

/// An array of histograms.
fn named(h5: &H5<'_>, names: &[String], description: &Description) -> Result<Part, ImportError> {
    // Arrays in groups are named by their paths, which `names` does not list.
    let name = match &description.array {
        Some(path) if h5.shape(path)?.is_some() => path,
        _ => chosen(h5.file, names, description)?,
    };
    let (shape, values) = h5.array(name)?;
    let values = values.into_iter().map(|x| x as f32).collect();
    ordered(h5.file, "hdf5", Strided::rows(shape, values), description)
}

/// Photon-HDF5 (photon-hdf5.readthedocs.io, version 0.5): each detector is a pixel, and nanotimes
/// count from the laser pulse. A photon is counted at the middle of its channel.
fn photons(
    h5: &H5<'_>,
    description: &Description,
    described: &Described,
) -> Result<Part, ImportError> {
    const GROUP: &str = "photon_data";
    let name = |array: &str| format!("{GROUP}/{array}");
    let nanotimes = name("nanotimes");
    if h5.shape(&nanotimes)?.is_none() {
        let expected = "the time of each photon after the laser pulse";
        return Err(h5.refused(
            &nanotimes,
            expected,
            "none: the file counts photons only".into(),
        ));
    }
    let (_, times) = h5.array(&nanotimes)?;
    let unit_ps = h5.number(&name("nanotimes_specs/tcspc_unit"))? * 1e12;
    let bins = name("nanotimes_specs/tcspc_num_bins");
    let most = match h5.shape(&bins)? {
        Some(_) => Some(h5.number(&bins)? as u64),
        None => None,
    };
    let detectors = match h5.shape(&name("detectors"))? {
        Some(_) => h5.array(&name("detectors"))?.1,
        None => vec![0.0; times.len()],
    };
    if detectors.len() != times.len() {
        let found = format!("{} of {} photons", detectors.len(), times.len());
        return Err(h5.refused(&name("detectors"), "a detector for each photon", found));
    }
    let gate = description.event_gate(described, unit_ps, most)?;
    let mut binner = Binner::new(h5.file, description.pixels, 1, gate, described)?;
    let width = binner.image()[1];
    for (time, detector) in times.iter().zip(&detectors) {
        let pixel = *detector as usize;
        binner.add(
            Some((0, pixel / width, pixel % width)),
            description.path_m((time + 0.5) * unit_ps),
        );
    }
    let note = format!("each detector is a pixel; bins of the file have {unit_ps} ps");
    binner.finish(h5.file, "photon-hdf5", false, vec![note])
}
