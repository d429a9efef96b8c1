//! The detector's scan: a ray per pixel, and the pinhole camera that fits the rays.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::super::ImportError;
use super::super::files::{self, Files};
use super::super::mat::Mat;
use super::super::platonerf::along;
use super::super::scene::{Shape, direction};
use super::super::vector::norm;
use picofarm_dataset::Intrinsics;

/// Maximum deviation of rays from the pinhole camera's, in pixels.
const STRAY_PX: f64 = 0.5;

pub(super) fn scan_file(folder: &Path) -> Result<Option<PathBuf>, ImportError> {
    let (_, all) = files::entries(folder)?;
    let is_scan = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("detector_scan") && name.ends_with(".mat")
    };
    let scans: Vec<PathBuf> = all.into_iter().filter(is_scan).collect();
    match &scans[..] {
        [] => Ok(None),
        [one] => Ok(Some(one.clone())),
        several => {
            let found = format!("{}", several.len());
            Err(ImportError::refused(
                folder,
                "detector_scan*.mat",
                "one",
                found,
                "keep the one that belongs to the captures",
            ))
        }
    }
}

/// The detector's scan.
pub(super) struct Scan {
    pub file: PathBuf,
    pub width: usize,
    pub height: usize,
    /// Whether columns and rows are reversed in the files.
    turned: [bool; 2],
    /// Our intrinsics.
    pub intrinsics: Intrinsics,
    pub stray_px: f64,
}

impl Scan {
    pub fn read(folder: &Path, files: &Files) -> Result<Self, ImportError> {
        let Some(file) = scan_file(folder)? else {
            return Err(ImportError::refused(
                folder,
                "detector_scan*.mat",
                "one",
                "none",
                "add it",
            ));
        };
        let mat = Mat::open(&file, files)?;
        let (width, height) = (mat.number("num_u")? as usize, mat.number("num_v")? as usize);
        let (theta, phi) = (mat.matrix("thetaMap")?.values, mat.matrix("phiMap")?.values);
        let pixels = width.saturating_mul(height);
        if width < 2 || height < 2 || theta.len() != pixels || phi.len() != pixels {
            let expected =
                format!("{pixels} angles for num_u = {width}, num_v = {height}, at least 2 each");
            let found = format!("{} and {}", theta.len(), phi.len());
            return Err(ImportError::refused(
                &file,
                "thetaMap and phiMap",
                expected,
                found,
                "see whether the files belong together",
            ));
        }
        let mut slopes = [Vec::with_capacity(pixels), Vec::with_capacity(pixels)];
        for (theta, phi) in theta.iter().zip(&phi) {
            let forward = libm::cos(*phi) * libm::sin(*theta);
            if forward.is_nan() || forward <= 0.0 {
                let found = format!("theta = {theta}, phi = {phi}");
                let hint = "give angles in radians";
                return Err(ImportError::refused(
                    &file,
                    "thetaMap and phiMap",
                    "rays that go forward",
                    found,
                    hint,
                ));
            }
            slopes[0].push(-libm::cos(*theta) / forward);
            slopes[1].push(-libm::sin(*phi) * libm::sin(*theta) / forward);
        }
        let across = fit(&slopes[0], |p| p % width);
        let down = fit(&slopes[1], |p| p / width);
        let stray = |slopes: &[f64], (a, b): (f64, f64), at: &dyn Fn(usize) -> usize| {
            let off = slopes
                .iter()
                .enumerate()
                .map(|(p, s)| libm::fabs((s - b) / a - (at(p) as f64 + 0.5)));
            off.fold(0.0, f64::max)
        };
        let stray_px =
            stray(&slopes[0], across, &|p| p % width).max(stray(&slopes[1], down, &|p| p / width));
        if stray_px.is_nan() || stray_px > STRAY_PX {
            return Err(ImportError::refused(
                &file,
                "thetaMap and phiMap",
                format!("rays of a pinhole camera, within {STRAY_PX} pixels, pixel u + v*num_u"),
                format!("{stray_px:.2} pixels off"),
                "rectify the scan before importing",
            ));
        }
        let ours = |(a, b): (f64, f64), size: usize| {
            let (turned, a, b) = match a < 0.0 {
                true => (true, -a, b + a * size as f64),
                false => (false, a, b),
            };
            (turned, 1.0 / a, -b / a)
        };
        let (turn_u, fx, cx) = ours(across, width);
        let (turn_v, fy, cy) = ours(down, height);
        Ok(Self {
            file,
            width,
            height,
            turned: [turn_u, turn_v],
            intrinsics: Intrinsics {
                fx: fx as f32,
                fy: fy as f32,
                cx: cx as f32,
                cy: cy as f32,
            },
            stray_px,
        })
    }

    /// Returns the file's index of our pixel.
    pub fn source(&self, pixel: usize) -> usize {
        let turn = |at: usize, size: usize, turned: bool| if turned { size - 1 - at } else { at };
        let column = turn(pixel % self.width, self.width, self.turned[0]);
        let row = turn(pixel / self.width, self.height, self.turned[1]);
        row * self.width + column
    }

    /// Computes the spot's position from one-bounce light.
    pub fn spot(
        &self,
        file: &Path,
        shape: &Shape,
        h: &[f32],
        laser: [f64; 3],
    ) -> Result<([f32; 3], Value), ImportError> {
        let bins = shape.gate.bins as usize;
        let at = (0..h.len())
            .max_by(|a, b| h[*a].total_cmp(&h[*b]))
            .unwrap_or(0);
        let (pixel, bin) = (at / bins, at % bins);
        let d = direction(self.intrinsics, pixel / self.width, pixel % self.width);
        let d = d.map(|x| x / norm(d));
        let path = shape.gate.start_m + (bin as f64 + 0.5) * shape.gate.bin_width_m;
        // The light's way is reversed: from the detector along the pixel's ray, then to the laser.
        let from = laser.map(|x| -x);
        let relative = along(from, d, path);
        let position = [0, 1, 2].map(|k| relative[k] + laser[k]);
        let baseline = norm(laser);
        if path <= baseline || position[2] <= 0.0 {
            return Err(ImportError::refused(
                file,
                "brightest bin",
                format!(
                    "light of one bounce, after more than the {baseline:.3} m between laser and detector"
                ),
                format!("{path:.3} m"),
                "give another --t0-s or --laser-m",
            ));
        }
        let check =
            json!({"one_bounce_path_m": path, "spot_range_m": norm(position), "counts": h[at]});
        Ok((position.map(|x| x as f32), check))
    }
}

/// Returns slope and intercept of `values` over pixel centres.
fn fit(values: &[f64], at: impl Fn(usize) -> usize) -> (f64, f64) {
    let n = values.len() as f64;
    let centre = |p: usize| at(p) as f64 + 0.5;
    let mean_x = (0..values.len()).map(centre).sum::<f64>() / n;
    let mean_y = values.iter().sum::<f64>() / n;
    let (mut xy, mut xx) = (0.0, 0.0);
    for (p, y) in values.iter().enumerate() {
        let x = centre(p) - mean_x;
        xy += x * (y - mean_y);
        xx += x * x;
    }
    let slope = xy / xx;
    (slope, mean_y - slope * mean_x)
}
