//! Two-bounce data derived from the captures and stored next to them: `t2.mat` with `t2` (spots ×
//! pixels: seconds from the laser to the detector), and `two_bounce_detections.mat` with `has_2B`
//! (spots × pixels, 1 = lit) and `illum_pts` (a row per spot, and one for the camera).
//!
//! The scan was turned upside down at some point in their processing, and in published files the
//! spots were not. Therefore both orientations are tried: with the correct one, a pixel's depths
//! computed from its spots agree.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::super::ImportError;
use super::super::files::Files;
use super::super::mat::{Mat, Matrix};
use super::super::vector::{distance, dot, norm};
use super::{LIGHT_M_S, Scan};
use crate::import::scene::direction;

const TIMES: &str = "t2.mat";
const DETECTIONS: &str = "two_bounce_detections.mat";
/// Factor by which depths must agree better for upside-down spots to be believed.
const BETTER: f64 = 2.0;

/// Two-bounce paths and masks in our axes.
pub(super) struct TwoBounce {
    /// `[spot][row][column]`, metres; 0 if no two-bounce light was found.
    pub paths_m: Vec<f32>,
    /// `[spot][row][column]`, 1 = lit.
    pub lit: Vec<u8>,
    /// Positions of the spots in the camera frame, metres.
    pub spots: Vec<[f32; 3]>,
    /// Agreement of a pixel's depths, metres.
    pub check: Value,
    /// Whether the spots had to be turned upside down.
    pub turned: bool,
}

/// Returns the files, if both exist.
pub(super) fn files_of(folder: &Path) -> Result<Option<[PathBuf; 2]>, ImportError> {
    let both = [folder.join(TIMES), folder.join(DETECTIONS)];
    match [both[0].is_file(), both[1].is_file()] {
        [true, true] => Ok(Some(both)),
        [false, false] => Ok(None),
        [times, _] => Err(ImportError::refused(
            folder,
            "two-bounce times",
            format!("{TIMES} and {DETECTIONS}"),
            (if times { TIMES } else { DETECTIONS }).to_string() + " alone",
            "add the other one, or remove it",
        )),
    }
}

/// Reads the files for this number of spots. `laser` is the laser's position in the camera frame.
pub(super) fn read(
    [times, detections]: &[PathBuf; 2],
    scan: &Scan,
    spots: usize,
    laser: [f64; 3],
    files: &Files,
) -> Result<TwoBounce, ImportError> {
    let pixels = scan.width * scan.height;
    let of = |file: &Path, mat: &Mat, name: &str| -> Result<Matrix, ImportError> {
        let matrix = mat.matrix(name)?;
        match matrix.dims[..] == [spots, pixels] {
            true => Ok(matrix),
            false => Err(ImportError::refused(
                file,
                name,
                format!("[{spots}, {pixels}], a row for each capture"),
                format!("{:?}", matrix.dims),
                "keep the captures that these times belong to",
            )),
        }
    };
    let t2 = of(times, &Mat::open(times, files)?, "t2")?;
    let found = Mat::open(detections, files)?;
    let has = of(detections, &found, "has_2B")?;
    let points = found.matrix("illum_pts")?;
    let rows = points.dims.first().copied().unwrap_or(0);
    if points.dims.len() != 2 || points.dims[1] != 3 || ![spots, spots + 1].contains(&rows) {
        return Err(ImportError::refused(
            detections,
            "illum_pts",
            format!("[{spots}, 3] or, with the camera, [{}, 3]", spots + 1),
            format!("{:?}", points.dims),
            "keep the captures that these points belong to",
        ));
    }
    let mut paths_m = vec![0.0f32; spots * pixels];
    let mut lit = vec![0u8; spots * pixels];
    for spot in 0..spots {
        for pixel in 0..pixels {
            let at = spot + scan.source(pixel) * spots;
            let (seconds, detected) = (t2.values[at], has.values[at]);
            if detected != 0.0 && detected != 1.0 {
                return Err(ImportError::refused(
                    detections,
                    "has_2B",
                    "0 and 1",
                    detected.to_string(),
                    "threshold it before importing",
                ));
            }
            let path = seconds * LIGHT_M_S;
            if detected == 1.0 && path.is_finite() && path > 0.0 {
                paths_m[spot * pixels + pixel] = path as f32;
                lit[spot * pixels + pixel] = 1;
            }
        }
    }
    let at = |row: usize, sign: f64| {
        let [x, y, z] = [0, 1, 2].map(|axis| points.values[row + axis * rows]);
        [-x, -sign * y, z]
    };
    let upright: Vec<[f64; 3]> = (0..spots).map(|s| at(s, 1.0)).collect();
    let over: Vec<[f64; 3]> = (0..spots).map(|s| at(s, -1.0)).collect();
    let spread = [&upright, &over].map(|spots| scan.spread_m(spots, laser, &paths_m));
    let turned = spread[1] * BETTER < spread[0] || (spread[0].is_nan() && !spread[1].is_nan());
    if spread[usize::from(turned)].is_nan() {
        return Err(ImportError::refused(
            times,
            "t2",
            "times from the laser by the spot to the detector, in seconds, which give a pixel a depth from two spots",
            "none that are long enough".to_owned(),
            "let them count from when the laser fires; see also --laser-m",
        ));
    }
    let chosen = if turned { over } else { upright };
    Ok(TwoBounce {
        paths_m,
        lit,
        spots: chosen.iter().map(|p| p.map(|x| x as f32)).collect(),
        check: json!({"spread_m": finite(spread[0]), "spread_of_spots_upside_down_m": finite(spread[1])}),
        turned,
    })
}

/// Returns a number, or null if it is not finite.
fn finite(x: f64) -> Value {
    if x.is_finite() { json!(x) } else { Value::Null }
}

impl Scan {
    /// Returns the median over the pixels of the deviation of depths, computed from their spots,
    /// from the pixel's median depth, in metres; NaN if no pixel has two.
    fn spread_m(&self, spots: &[[f64; 3]], laser: [f64; 3], paths_m: &[f32]) -> f64 {
        let pixels = self.width * self.height;
        let lasers: Vec<f64> = spots.iter().map(|spot| distance(*spot, laser)).collect();
        let mut all = Vec::new();
        for pixel in 0..pixels {
            let ray = direction(self.intrinsics, pixel / self.width, pixel % self.width);
            let ray = ray.map(|x| x / norm(ray));
            let depths = spots.iter().enumerate().filter_map(|(s, spot)| {
                // The rest of the path, spot to surface to camera, defines an ellipsoid with spot
                // and camera as foci.
                let rest = f64::from(paths_m[s * pixels + pixel]) - lasers[s];
                let depth = (rest * rest - dot(*spot, *spot)) / (2.0 * (rest - dot(ray, *spot)));
                (rest > norm(*spot) && depth > 0.0).then_some(depth)
            });
            let mut depths: Vec<f64> = depths.collect();
            if depths.len() > 1 {
                let middle = median(&mut depths);
                let mut off: Vec<f64> = depths.iter().map(|d| libm::fabs(d - middle)).collect();
                all.push(median(&mut off));
            }
        }
        median(&mut all)
    }
}

/// Returns the upper median; NaN for an empty slice.
fn median(of: &mut [f64]) -> f64 {
    if of.is_empty() {
        return f64::NAN;
    }
    let middle = of.len() / 2;
    *of.select_nth_unstable_by(middle, f64::total_cmp).1
}
