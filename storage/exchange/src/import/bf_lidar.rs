//! Bounce-flash lidar captures: `spot_<i>.mat` with `dataCube` (pixels × bins of 8 ps, photon
//! counts) for each laser spot, and `detector_scan*.mat` with the grid (`num_u`, `num_v`) and the
//! rays (`thetaMap`, `phiMap`).
//!
//! A ray is (cos θ, sin φ sin θ, cos φ sin θ), with x to the left, y up and z forward; its pixel is
//! u + v·num_u. The grid is regular in the plane z = 1, so a pinhole camera fits, and this is
//! checked. Bin k (from 1) has the time k · 8 ps − t0. The files contain neither t0 nor the laser's
//! position.
//!
//! If all captures become one scene, it has their sum and, if asked for, each of them. Two-bounce
//! times and detections next to them are imported, too: [`two_bounce`].

mod scan;
mod two_bounce;

use std::path::{Path, PathBuf};

use serde_json::Value;

use picofarm_files::Opener;

use super::files::{self, Files};
use super::mat::Mat;
use super::scene::{ImportedScene, Shape};
use super::{Captures, ImportError, ImportOptions, Item};
use picofarm_dataset::{Gate, Subsets};
use scan::{Scan, scan_file};

const LIGHT_M_S: f64 = 299_792_458.0;
const BIN_S: f64 = 8e-12;
/// The default start of the gate.
const START_M: f64 = 0.9;
const BINS: usize = 1502;

/// Returns the captures of a folder, by number: `spot_<i>.mat`. Captures through a filter (`_NDF`)
/// are other measurements.
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
    if options.captures != Captures::Separate {
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
    let given = item.capture.is_none() && two_bounce::files_of(&item.folder)?.is_some();
    let (shape, _) = shape_of(first, &cube, &scan, (paths.len(), given), options)?;
    Ok(shape)
}

/// Returns the shape, and the first bin to keep.
fn shape_of(
    file: &Path,
    cube: &Mat,
    scan: &Scan,
    (spots, two_bounce): (usize, bool),
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
        two_bounce,
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
    // With a single capture they are useless.
    let given = match item.capture {
        None => two_bounce::files_of(&item.folder)?,
        Some(_) => None,
    };
    let given = given.map(|both| two_bounce::read(&both, &scan, paths.len(), laser, files));
    let given = given.transpose()?;
    let mut total: Option<(Shape, Vec<f32>)> = None;
    let mut each = Vec::new();
    let (mut positions, mut checks, mut conversions) = (Vec::new(), Vec::new(), Vec::new());
    for path in &paths {
        let cube = Mat::open(path, files)?;
        let (shape, first) = shape_of(path, &cube, &scan, (paths.len(), given.is_some()), options)?;
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
        if options.captures == Captures::Both {
            each.extend_from_slice(&counts);
        }
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
    conversions.push(match &given {
        None => "spots found at the brightest bin of the brightest pixel".into(),
        Some(given) if given.turned => {
            "spots are those of illum_pts, turned upside down: so depths of a pixel agree".into()
        }
        Some(_) => "spots are those of illum_pts".to_string(),
    });
    scene.each = each;
    if paths.len() > 1 {
        conversions.push(format!("{} captures summed", paths.len()));
    }
    scene.conversions = conversions;
    scene.laser = laser.map(|x| x as f32);
    match given {
        None => {
            scene.set_spots(&positions);
            scene.missing.push("visibility");
        }
        Some(given) => {
            scene.set_spots(&given.spots);
            scene.two_bounce = given.paths_m;
            scene.visibility = given.lit;
            checks.push(given.check);
        }
    }
    // The spots were computed from straight beams.
    scene.judge_beams(true);
    // The values are photon counts.
    scene.scale = Some(1.0);
    scene.missing.extend([
        "depth", "range", "specular", "normal", "instance", "label", "rgb", "camera",
    ]);
    if !scene.two_bounce.is_empty() && !options.unchecked {
        let found = super::paths::check(&scene, &item.folder)?;
        if let Some(Value::Object(given)) = checks.last_mut() {
            given.insert("two_bounce_paths".into(), found);
        }
    }
    scene.check = Value::Array(checks);
    Ok(scene)
}
