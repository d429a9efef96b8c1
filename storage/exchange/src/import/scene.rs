//! A scene read from files, in our units and axes, ready for encoding.

use std::path::Path;

use serde_json::Value;

use super::vector::{distance, norm};
use super::{ImportError, SourceFile};
use picofarm_dataset::Quantity;
use picofarm_dataset::photon_scale;
use picofarm_dataset::{Gate, Subsets};
use picofarm_dataset::{Intrinsics, SceneRecord, Spot, SubsetRecord};

/// Photons in the median pixel's brightest bin, by convention for the stored scale.
const PEAK_PHOTONS: f32 = 400.0;
/// Maximum negative energy, relative to the total, that a lossy code may have caused.
const NEGATIVE: f64 = 0.01;
/// The name under which unknown lengths of beams are listed as missing.
const PATHS: &str = "spots.path";
/// Larger depths are sky.
const SKY_M: f32 = 1e4;

/// Sizes that all scenes of a data set share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Shape {
    pub height: u32,
    pub width: u32,
    pub spots: u32,
    pub subsets: Subsets,
    /// Whether the source has two-bounce paths.
    pub two_bounce: bool,
    pub gate: Gate,
}

impl Shape {
    pub fn pixels(&self) -> usize {
        self.height as usize * self.width as usize
    }

    /// Returns the first field that differs in `other`: (field, ours, theirs).
    pub fn difference(&self, other: &Self) -> Option<(&'static str, String, String)> {
        let pairs = [
            ("height", self.height.to_string(), other.height.to_string()),
            ("width", self.width.to_string(), other.width.to_string()),
            ("spots", self.spots.to_string(), other.spots.to_string()),
            (
                "subsets",
                format!("{:?}", self.subsets.sizes()),
                format!("{:?}", other.subsets.sizes()),
            ),
            (
                "two_bounce",
                self.two_bounce.to_string(),
                other.two_bounce.to_string(),
            ),
            (
                "gate",
                format!("{:?}", self.gate),
                format!("{:?}", other.gate),
            ),
        ];
        pairs.into_iter().find(|(_, ours, theirs)| ours != theirs)
    }
}

/// A scene that was read, checked and converted.
#[derive(Debug, Clone)]
pub struct ImportedScene {
    /// Its name in the source.
    pub name: String,
    /// Its source files.
    pub files: Vec<SourceFile>,
    /// Descriptions of the conversions.
    pub conversions: Vec<String>,
    /// Quantities that the source does not have; they are stored as zeros.
    pub missing: Vec<&'static str>,
    /// Results of the cross-check; null if it was skipped.
    pub check: Value,
    pub(super) shape: Shape,
    pub(super) transient: Vec<f32>,
    pub(super) subsets: Vec<(Quantity, Vec<f32>)>,
    /// Each spot alone, `[spot][row][column][bin]`; empty if the data set has no such array.
    pub(super) each: Vec<f32>,
    pub(super) depth: Vec<f32>,
    pub(super) range: Vec<f32>,
    pub(super) normal: Vec<f32>,
    pub(super) instance: Vec<u32>,
    pub(super) label: Vec<u16>,
    pub(super) specular: Vec<u8>,
    pub(super) visibility: Vec<u8>,
    /// `[spot][row][column]`, metres; empty if the shape has none.
    pub(super) two_bounce: Vec<f32>,
    pub(super) rgb: Vec<f32>,
    pub(super) spots: Vec<Option<Spot>>,
    pub(super) intrinsics: Intrinsics,
    pub(super) camera: [[f32; 4]; 4],
    pub(super) laser: [f32; 3],
    /// Photons per unit of h; `None` = by convention.
    pub(super) scale: Option<f32>,
}

impl ImportedScene {
    /// Returns a scene with only its histogram and geometry.
    pub(super) fn new(
        name: &str,
        shape: Shape,
        transient: Vec<f32>,
        intrinsics: Intrinsics,
    ) -> Self {
        let n = shape.pixels();
        Self {
            name: name.to_owned(),
            files: Vec::new(),
            conversions: Vec::new(),
            missing: Vec::new(),
            check: Value::Null,
            transient,
            subsets: Vec::new(),
            each: Vec::new(),
            depth: vec![0.0; n],
            range: vec![0.0; n],
            normal: vec![0.0; n * 3],
            instance: vec![0; n],
            label: vec![0; n],
            specular: vec![0; n],
            visibility: vec![0; n * shape.spots as usize],
            two_bounce: Vec::new(),
            rgb: vec![0.0; n * 3],
            spots: vec![None; shape.spots as usize],
            intrinsics,
            camera: IDENTITY,
            laser: [0.0; 3],
            scale: None,
            shape,
        }
    }

    /// Sets depth and range from an image of either.
    pub(super) fn set_depth(
        &mut self,
        file: &Path,
        values: &[f32],
        is_range: bool,
    ) -> Result<(), ImportError> {
        let w = self.shape.width as usize;
        let mut sky = 0u64;
        for (pixel, value) in values.iter().enumerate() {
            if *value < 0.0 || value.is_nan() {
                return Err(ImportError::refused(
                    file,
                    format!("pixel ({}, {})", pixel % w, pixel / w),
                    "a depth of at least 0 (0, infinity or more than 10 km where there is nothing)",
                    value.to_string(),
                    "correct the file",
                ));
            }
            let value = match *value > SKY_M {
                true => {
                    sky += 1;
                    0.0
                }
                false => *value,
            };
            let stretch = norm(direction(self.intrinsics, pixel / w, pixel % w)) as f32;
            (self.depth[pixel], self.range[pixel]) = match is_range {
                true => (value / stretch, value),
                false => (value, value * stretch),
            };
        }
        if sky > 0 {
            self.conversions.push(format!(
                "{sky} pixels deeper than {SKY_M} m became 0 (nothing)"
            ));
        }
        let (from, to) = if is_range {
            ("range", "depth")
        } else {
            ("depth", "range")
        };
        self.conversions
            .push(format!("{to} computed from {from} and intrinsics"));
        Ok(())
    }

    /// Sets the spots, assuming straight beams from the laser. Normals are unknown.
    pub(super) fn set_spots(&mut self, positions: &[[f32; 3]]) {
        let laser = self.laser.map(f64::from);
        let spot = |p: &[f32; 3]| {
            p.iter().all(|x| x.is_finite()).then(|| Spot {
                position: *p,
                normal: [0.0; 3],
                path_m: distance(p.map(f64::from), laser) as f32,
            })
        };
        self.spots = positions.iter().map(spot).collect();
        self.missing.push("spots.normal");
    }

    /// Decides whether the straight beams of [`Self::set_spots`] are correct, once the mirrors are
    /// known. They are correct if the camera sees no mirror, or if `stated` is set. Otherwise the
    /// lengths are listed as missing, because a beam reflected by a mirror is longer than the
    /// straight line.
    pub(super) fn judge_beams(&mut self, stated: bool) {
        let mirrors = match self.missing.contains(&"specular") {
            true => None,
            false => Some(self.specular.contains(&1)),
        };
        let why = match (stated, mirrors) {
            (true, _) => "as stated",
            (false, Some(false)) => "the camera sees no mirror",
            (false, _) => return self.missing.push(PATHS),
        };
        self.conversions.push(format!(
            "paths of the beams computed as straight lines from the laser: {why}"
        ));
    }

    /// Sets the lengths of the beams in metres; a beam that hits nothing has none.
    ///
    /// # Errors
    /// The index of the first beam that is shorter than the straight line or has no length, and its
    /// minimum length.
    pub(super) fn set_paths(&mut self, paths_m: &[f32]) -> Result<(), (usize, f32)> {
        for (beam, (spot, path)) in self.spots.iter_mut().zip(paths_m).enumerate() {
            let Some(spot) = spot else { continue };
            let straight = spot.path_m;
            let long_enough = *path >= straight - (1e-3 * straight).max(1e-4);
            if !(long_enough && path.is_finite()) {
                return Err((beam, straight));
            }
            spot.path_m = *path;
        }
        Ok(())
    }

    /// Calls `use_it` with the record for the encoder.
    pub(super) fn with_record<T>(&self, use_it: impl FnOnce(&SceneRecord<'_>) -> T) -> T {
        let mut subsets: Vec<SubsetRecord<'_>> = self
            .subsets
            .iter()
            .map(|(quantity, h)| SubsetRecord {
                quantity: *quantity,
                planes: vec![h],
            })
            .collect();
        if !self.each.is_empty() {
            subsets.push(SubsetRecord {
                quantity: Quantity::TransientSpots,
                planes: self.each.chunks_exact(self.transient.len()).collect(),
            });
        }
        let bins = self.shape.gate.bins as usize;
        let scale = self
            .scale
            .unwrap_or_else(|| photon_scale(&self.transient, bins, PEAK_PHOTONS));
        use_it(&SceneRecord {
            transient: &self.transient,
            subsets: &subsets,
            depth: &self.depth,
            range: &self.range,
            normal: &self.normal,
            instance: &self.instance,
            label: &self.label,
            specular: &self.specular,
            visibility: &self.visibility,
            two_bounce: &self.two_bounce,
            rgb: &self.rgb,
            spots: &self.spots,
            intrinsics: self.intrinsics,
            camera: self.camera,
            laser: self.laser,
            scale,
        })
    }
}

pub(super) const IDENTITY: [[f32; 4]; 4] = [
    [1.0, 0.0, 0.0, 0.0],
    [0.0, 1.0, 0.0, 0.0],
    [0.0, 0.0, 1.0, 0.0],
    [0.0, 0.0, 0.0, 1.0],
];

/// Returns the direction of a pixel's centre in the camera frame, with z = 1.
pub(super) fn direction(i: Intrinsics, row: usize, column: usize) -> [f64; 3] {
    [
        (column as f64 + 0.5 - f64::from(i.cx)) / f64::from(i.fx),
        (row as f64 + 0.5 - f64::from(i.cy)) / f64::from(i.fy),
        1.0,
    ]
}

/// Returns the intrinsics of a horizontal field of view, with the axis in the image's centre.
pub(super) fn intrinsics_from_fov(width: u32, height: u32, degrees: f64) -> Intrinsics {
    let f = f64::from(width) / 2.0 / libm::tan(degrees.to_radians() / 2.0);
    Intrinsics {
        fx: f as f32,
        fy: f as f32,
        cx: width as f32 / 2.0,
        cy: height as f32 / 2.0,
    }
}

/// Checks that histograms have no negative or undefined bins. Small negative values left by a lossy
/// code become 0.
pub(super) fn clean(
    file: &Path,
    h: &mut [f32],
    bins: usize,
    conversions: &mut Vec<String>,
) -> Result<(), ImportError> {
    let (mut negative, mut count, mut total) = (0.0f64, 0u64, 0.0f64);
    for (at, x) in h.iter_mut().enumerate() {
        if !x.is_finite() {
            return Err(ImportError::refused(
                file,
                format!("bin {} of pixel {}", at % bins, at / bins),
                "a finite number",
                x.to_string(),
                "correct or leave out this scene",
            ));
        }
        match *x < 0.0 {
            true => {
                negative -= f64::from(*x);
                count += 1;
                *x = 0.0;
            }
            false => total += f64::from(*x),
        }
    }
    if negative > NEGATIVE * total {
        return Err(ImportError::refused(
            file,
            "histograms",
            format!(
                "values of at least 0 (a lossy code may leave up to {NEGATIVE} of the energy negative)"
            ),
            format!(
                "{count} negative values with {:.3} of the energy",
                negative / total.max(f64::MIN_POSITIVE)
            ),
            "subtract no background before importing",
        ));
    }
    if count > 0 {
        conversions.push(format!(
            "{count} negative values in {} (together {:.2e} of its energy) became 0",
            file.file_name().unwrap_or_default().to_string_lossy(),
            negative / total.max(f64::MIN_POSITIVE)
        ));
    }
    Ok(())
}
