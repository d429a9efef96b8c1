//! Bounce-flash lidar captures: `spot_<i>.mat` with `dataCube` (pixels × bins of 8 ps, photon counts) for each laser
//! spot, and `detector_scan*.mat` with the grid (`num_u`, `num_v`) and the rays (`thetaMap`, `phiMap`).
//!
//! A ray is (cos θ, sin φ sin θ, cos φ sin θ), with x to the left, y up and z forward; pixel u + v·num_u. The grid is
//! regular in the plane z = 1, so that a pinhole camera fits, which is checked. Bin k (from 1) stands for the time
//! k · 8 ps − t0. Neither t0 nor the laser's place are in the files.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use picofarm_files::Opener;

use super::files::{self, Files};
use super::mat::Mat;
use super::platonerf::along;
use super::scene::{ImportedScene, Shape};
use super::{Captures, ImportError, ImportOptions, Item};
use crate::layout::record::Intrinsics;
use crate::layout::spec::{Gate, Subsets};

const LIGHT_M_S: f64 = 299_792_458.0;
const BIN_S: f64 = 8e-12;
/// The gate that is kept, where no other is asked for.
const START_M: f64 = 0.9;
const BINS: usize = 1502;
/// Rays may deviate so far from a pinhole camera's.
const STRAY_PX: f64 = 0.5;

/// The captures of a folder, by number: `spot_<i>.mat`. Those through a filter (`_NDF`) are other measurements.
fn captures(folder: &Path) -> Result<Vec<(u64, PathBuf)>, ImportError> {
    let (_, all) = files::entries(folder)?;
    let mut found: Vec<(u64, PathBuf)> = all
        .into_iter()
        .filter_map(|path| {
            let number = path
                .file_name()?
                .to_str()?
                .strip_prefix("spot_")?
                .strip_suffix(".mat")?;
            Some((number.parse().ok()?, path))
        })
        .collect();
    found.sort();
    Ok(found)
}

fn scan_file(folder: &Path) -> Result<Option<PathBuf>, ImportError> {
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

pub(super) fn find(
    root: &Path,
    options: &ImportOptions,
    opener: &Opener,
) -> Result<Vec<Item>, ImportError> {
    let is_scene = |folder: &Path| {
        matches!(
            scan_file(folder),
            Ok(Some(_)) | Err(ImportError::Refused { .. })
        ) && captures(folder).is_ok_and(|c| !c.is_empty())
    };
    let folders = super::folders_with(root, opener, is_scene)?;
    if options.captures == Captures::Sum {
        return Ok(folders);
    }
    let mut items = Vec::new();
    for item in folders {
        for (capture, (number, _)) in captures(&item.folder)?.into_iter().enumerate() {
            items.push(Item {
                name: format!("{}/spot_{number}", item.name),
                folder: item.folder.clone(),
                capture: Some(capture),
                opener: opener.clone(),
            });
        }
    }
    Ok(items)
}

fn chosen(item: &Item) -> Result<Vec<PathBuf>, ImportError> {
    let all = captures(&item.folder)?.into_iter().map(|c| c.1);
    Ok(match item.capture {
        None => all.collect(),
        Some(capture) => all.skip(capture).take(1).collect(),
    })
}

pub(super) fn shape(item: &Item, options: &ImportOptions) -> Result<Shape, ImportError> {
    let files = item.files();
    let scan = Scan::read(&item.folder, &files)?;
    let paths = chosen(item)?;
    let Some(first) = paths.first() else {
        return Err(ImportError::refused(
            &item.folder,
            "captures",
            "as many as before",
            "fewer",
            "open the source again",
        ));
    };
    let cube = Mat::open(first, &files)?;
    let (shape, _) = shape_of(first, &cube, &scan, paths.len(), options)?;
    Ok(shape)
}

/// The shape, and the first bin kept.
fn shape_of(
    file: &Path,
    cube: &Mat,
    scan: &Scan,
    spots: usize,
    options: &ImportOptions,
) -> Result<(Shape, usize), ImportError> {
    let dims = cube.dims("dataCube")?;
    let pixels = scan.width * scan.height;
    if dims.len() != 2 || dims[0] != pixels {
        let expected = format!(
            "[{pixels}, bins], a row for each of the {}x{} pixels",
            scan.width, scan.height
        );
        let found = format!("{dims:?}");
        return Err(ImportError::refused(
            file,
            "dataCube",
            expected,
            found,
            "see whether the files belong together",
        ));
    }
    let Some(t0) = options.t0_s else {
        return Err(ImportError::refused(
            file,
            "t0",
            "the time of arrival at no distance",
            "nothing: the files do not tell it",
            "give --t0-s (14.2428e-9 in the published scripts)",
        ));
    };
    let width = options.bin_width_m.unwrap_or(BIN_S * LIGHT_M_S);
    let start = options.gate_start_m.unwrap_or(START_M);
    let zero = t0 * LIGHT_M_S;
    // Bin j (from 0) is centred on the path (j + 1)·width − zero.
    let first = libm::round((start + zero) / width - 0.5);
    let there = dims[1] as f64;
    let kept = options.bins.map_or(BINS as f64, f64::from);
    let kept = if options.bins.is_some() {
        kept
    } else {
        kept.min(there - first)
    };
    if !(first >= 0.0 && kept >= 1.0 && first + kept <= there) {
        let last = there * width - zero;
        return Err(ImportError::refused(
            file,
            "dataCube",
            format!("{kept} bins from {start} m of path"),
            format!(
                "{} bins from {:.3} to {last:.3} m",
                dims[1],
                0.5 * width - zero
            ),
            "give --gate-start-m and --bins, or another --t0-s",
        ));
    }
    let shape = Shape {
        height: scan.height as u32,
        width: scan.width as u32,
        spots: spots as u32,
        subsets: Subsets::NONE,
        gate: Gate {
            start_m: (first + 0.5) * width - zero,
            bin_width_m: width,
            bins: kept as u32,
        },
    };
    Ok((shape, first as usize))
}

pub(super) fn read(
    item: &Item,
    options: &ImportOptions,
    files: &Files,
) -> Result<ImportedScene, ImportError> {
    let scan = Scan::read(&item.folder, files)?;
    let Some(laser) = options.laser_m else {
        return Err(ImportError::refused(
            &scan.file,
            "laser",
            "where the laser is, in the scan's axes (x left, y up, z forward)",
            "nothing: the files do not tell it",
            "give --laser-m (0.257,0,0 in the published scripts)",
        ));
    };
    let laser = [-laser[0], -laser[1], laser[2]];
    let paths = chosen(item)?;
    let mut total: Option<(Shape, Vec<f32>)> = None;
    let (mut positions, mut checks, mut conversions) = (Vec::new(), Vec::new(), Vec::new());
    for path in &paths {
        let cube = Mat::open(path, files)?;
        let (shape, first) = shape_of(path, &cube, &scan, paths.len(), options)?;
        let bins = shape.gate.bins as usize;
        let read = cube.columns("dataCube", first..first + bins)?;
        let mut counts = vec![0.0; read.len()];
        for (pixel, h) in counts.chunks_exact_mut(bins).enumerate() {
            h.copy_from_slice(&read[scan.source(pixel) * bins..][..bins]);
        }
        drop(read);
        if let Some(odd) = counts
            .iter()
            .find(|x| !(x.is_finite() && **x >= 0.0 && x.fract() == 0.0))
        {
            let found = odd.to_string();
            return Err(ImportError::refused(
                path,
                "dataCube",
                "counts of photons",
                found,
                "import counts, not what was made of them",
            ));
        }
        conversions.push(format!(
            "{}: bins {first} to {} of {} kept",
            files.name(path),
            first + bins - 1,
            cube.dims("dataCube")?[1]
        ));
        let (position, check) = scan.spot(path, &shape, &counts, laser)?;
        positions.push(position);
        checks.push(check);
        match &mut total {
            None => total = Some((shape, counts)),
            Some((first, sum)) => {
                if let Some((field, expected, found)) = first.difference(&shape) {
                    return Err(ImportError::refused(
                        path,
                        field,
                        expected,
                        found,
                        "sum captures of one shape",
                    ));
                }
                sum.iter_mut().zip(&counts).for_each(|(s, n)| *s += n);
            }
        }
    }
    let Some((shape, transient)) = total else {
        return Err(ImportError::refused(
            &item.folder,
            "captures",
            "as many as before",
            "fewer",
            "open the source again",
        ));
    };
    let mut scene = ImportedScene::new(&item.name, shape, transient, scan.intrinsics);
    conversions.push(
        "axes left, up, forward to right, down, forward; rows and columns put in that order".into(),
    );
    conversions.push(format!(
        "pinhole camera fitted to the rays: {:.3} pixels off at most",
        scan.stray_px
    ));
    conversions.push("spots found at the brightest bin of the brightest pixel".into());
    if paths.len() > 1 {
        conversions.push(format!("{} captures summed", paths.len()));
    }
    scene.conversions = conversions;
    scene.laser = laser.map(|x| x as f32);
    scene.set_spots(&positions);
    // The spots were found along straight beams.
    scene.judge_beams(true);
    // They are counts.
    scene.scale = Some(1.0);
    scene.check = Value::Array(checks);
    scene.missing.extend([
        "depth",
        "range",
        "visibility",
        "specular",
        "normal",
        "instance",
        "label",
        "rgb",
        "camera",
    ]);
    Ok(scene)
}

/// The detector's scan.
struct Scan {
    file: PathBuf,
    width: usize,
    height: usize,
    /// Whether columns and rows stand the other way round in the files.
    turned: [bool; 2],
    /// Ours.
    intrinsics: Intrinsics,
    stray_px: f64,
}

impl Scan {
    fn read(folder: &Path, files: &Files) -> Result<Self, ImportError> {
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

    /// Where our pixel stands in the files.
    fn source(&self, pixel: usize) -> usize {
        let turn = |at: usize, size: usize, turned: bool| if turned { size - 1 - at } else { at };
        let column = turn(pixel % self.width, self.width, self.turned[0]);
        let row = turn(pixel / self.width, self.height, self.turned[1]);
        row * self.width + column
    }

    /// The spot from light of one bounce.
    fn spot(
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
        let d = super::scene::direction(self.intrinsics, pixel / self.width, pixel % self.width);
        let d = d.map(|x| x / super::vector::norm(d));
        let path = shape.gate.start_m + (bin as f64 + 0.5) * shape.gate.bin_width_m;
        // Light's way turned round: from the detector along the pixel's ray, then to the laser.
        let from = laser.map(|x| -x);
        let relative = along(from, d, path);
        let position = [0, 1, 2].map(|k| relative[k] + laser[k]);
        let baseline = super::vector::norm(laser);
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
        let check = json!({"one_bounce_path_m": path, "spot_range_m": super::vector::norm(position), "counts": h[at]});
        Ok((position.map(|x| x as f32), check))
    }
}

/// Slope and intercept of `values` over pixel centres.
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
