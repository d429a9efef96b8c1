//! The paper's release: a folder per scene with `lidar_{4,25,100}.exr` (one half-precision channel
//! "Y", a line per pixel, a column per bin), `depth.exr`, `specular_mask.png`, `shadows_v1.npz` and
//! `lights_camera_frame.npy`.
//!
//! The files contain neither gate nor intrinsics, nor the orientation of their masks and axes. The
//! conventions of the paper and its code are used and then checked against the histograms: path
//! from 1 m in bins of 0.0384 m; 90° across the width; camera and laser at the origin, x right, y
//! down; masks 1 = lit; z-depth in metres; the 4 and 25 spots are those of
//! [`Quantity::spots_of_100`]. If our own export has left a `picofarm.json`, it provides most of
//! these.

mod contents;

use std::path::{Path, PathBuf};

use picofarm_files::Opener;

use super::check::check;
use super::files::Files;
use super::profile::{CheckedFiles, Geometry};
use super::scene::{ImportedScene, Shape, intrinsics_from_fov};
use super::{DepthKind, ImportError, ImportOptions, Item, image};
use crate::export::{SIDECAR, Sidecar};
use contents::{depth, histogram, lights, not_more, shadows, specular};
use picofarm_dataset::Quantity;
use picofarm_dataset::{Gate, Subsets};

const DEPTH: &str = "depth.exr";
const SPECULAR: &str = "specular_mask.png";
const SHADOWS: &str = "shadows_v1.npz";
const LIGHTS: &str = "lights_camera_frame.npy";
/// Minimum grey level of a mirror pixel (the paper's code: 0.1 of white).
const MIRROR: u8 = 26;
const GRID: usize = 100;
/// The paper's gate; the number of bins is read from the files.
const PAPER: Gate = Gate {
    start_m: 1.0,
    bin_width_m: 0.0384,
    bins: 637,
};
const OPTIONS: &str = "--gate-start-m, --bin-width-m, --fov-deg, --length-unit-m, --depth range";

fn lidar(folder: &Path, spots: u32) -> PathBuf {
    folder.join(format!("lidar_{spots}.exr"))
}

fn counts_there(folder: &Path) -> Vec<u32> {
    [4, 25, 100]
        .into_iter()
        .filter(|n| lidar(folder, *n).is_file())
        .collect()
}

pub(super) fn find(root: &Path, opener: &Opener) -> Result<Vec<Item>, ImportError> {
    super::folders_with(root, opener, |folder| !counts_there(folder).is_empty())
}

/// Returns the spot count of the scene's own histogram, and the subsets to import.
fn chosen(item: &Item, options: &ImportOptions) -> Result<(u32, Subsets), ImportError> {
    let there = counts_there(&item.folder);
    let most = there.last().copied();
    let main = match options.spots {
        None => most,
        Some(n) => there.contains(&n).then_some(n),
    };
    let Some(main) = main else {
        let expected = match options.spots {
            Some(n) => format!("lidar_{n}.exr (asked for by --spots)"),
            None => "lidar_4.exr, lidar_25.exr or lidar_100.exr".into(),
        };
        let found = format!("{there:?}");
        return Err(ImportError::refused(
            &item.folder,
            "histograms",
            expected,
            found,
            "give another --spots",
        ));
    };
    let subsets: Vec<u32> = there
        .into_iter()
        .filter(|n| main == 100 && *n < 100)
        .collect();
    let subsets = Subsets::of(&subsets).expect("4 and 25 are subsets");
    Ok((main, subsets))
}

/// Reads the additional file of our own export.
fn sidecar(item: &Item, files: &Files) -> Result<Option<Sidecar>, ImportError> {
    let path = item.folder.join(SIDECAR);
    if !path.is_file() {
        return Ok(None);
    }
    let hint = "export the scene again, or remove the file and give the gate as options";
    let sidecar: Sidecar = serde_json::from_slice(&files.bytes(&path)?)
        .map_err(|e| ImportError::unreadable(&path, e, hint))?;
    if sidecar.format != Sidecar::FORMAT || !(sidecar.factor.is_normal() && sidecar.factor > 0.0) {
        let expected = format!("{}, with a positive factor", Sidecar::FORMAT);
        let found = format!("{} with {}", sidecar.format, sidecar.factor);
        return Err(ImportError::refused(path, "format", expected, found, hint));
    }
    Ok(Some(sidecar))
}

pub(super) fn shape(item: &Item, options: &ImportOptions) -> Result<Shape, ImportError> {
    let (spots, subsets) = chosen(item, options)?;
    let files = item.files();
    let (width, height) = image::exr_size(&item.folder.join(DEPTH), &files)?;
    let file = lidar(&item.folder, spots);
    let (bins, lines) = image::exr_size(&file, &files)?;
    if lines != width * height {
        return Err(lines_differ(&file, lines, width, height));
    }
    let gate = sidecar(item, &files)?.map_or(PAPER, |a| a.gate);
    Ok(Shape {
        height: height as u32,
        width: width as u32,
        spots,
        subsets,
        two_bounce: false,
        gate: Gate {
            start_m: options.gate_start_m.unwrap_or(gate.start_m),
            bin_width_m: options.bin_width_m.unwrap_or(gate.bin_width_m),
            bins: bins as u32,
        },
    })
}

fn lines_differ(file: &Path, lines: usize, width: usize, height: usize) -> ImportError {
    ImportError::refused(
        file,
        "height",
        format!(
            "{} lines, one for each of the {width}x{height} pixels of {DEPTH}",
            width * height
        ),
        lines.to_string(),
        "see whether the files belong together",
    )
}

pub(super) fn read(
    item: &Item,
    options: &ImportOptions,
    files: &Files,
) -> Result<ImportedScene, ImportError> {
    let shape = shape(item, options)?;
    let path = |name: &str| item.folder.join(name);
    let (w, h) = (shape.width as usize, shape.height as usize);
    let sidecar = sidecar(item, files)?;
    let by = match &sidecar {
        Some(_) => format!("by {SIDECAR} or the options"),
        None => "and camera and laser at the origin: by the paper or the options".into(),
    };
    let mut conversions = vec![format!(
        "gate from {} m in bins of {} m, {by}",
        shape.gate.start_m, shape.gate.bin_width_m
    )];
    let intrinsics = match (options.fov_deg, &sidecar) {
        (None, Some(sidecar)) => sidecar.intrinsics(),
        (fov, _) => intrinsics_from_fov(shape.width, shape.height, fov.unwrap_or(90.0)),
    };
    let main = lidar(&item.folder, shape.spots);
    let mut transient = histogram(&main, &shape, files, &mut conversions)?;
    unscale(&mut transient, sidecar.as_ref());
    let mut scene = ImportedScene::new(&item.name, shape, transient, intrinsics);
    for n in shape.subsets.sizes() {
        let file = lidar(&item.folder, n);
        let quantity = if n == 4 {
            Quantity::Transient4
        } else {
            Quantity::Transient25
        };
        let mut h = histogram(&file, &shape, files, &mut conversions)?;
        unscale(&mut h, sidecar.as_ref());
        not_more(&file, n, &h, shape.spots, &scene.transient)?;
        scene.subsets.push((quantity, h));
    }
    for n in counts_there(&item.folder) {
        if n != shape.spots && !shape.subsets.sizes().contains(&n) {
            conversions.push(format!(
                "lidar_{n}.exr left out: its spots are not among the {}",
                shape.spots
            ));
        }
    }
    let unit = options.length_unit_m.unwrap_or(1.0);
    if unit != 1.0 {
        conversions.push(format!("lengths times {unit} to metres"));
    }
    scene.conversions = conversions;
    let depth: Vec<f32> = depth(&path(DEPTH), files)?
        .into_iter()
        .map(|d| (f64::from(d) * unit) as f32)
        .collect();
    scene.set_depth(
        &path(DEPTH),
        &depth,
        options.depth == Some(DepthKind::Range),
    )?;
    specular(&path(SPECULAR), &mut scene, files)?;
    let lights: Vec<[f32; 3]> = lights(&path(LIGHTS), shape.spots, files)?
        .into_iter()
        .map(|l| l.map(|x| (f64::from(x) * unit) as f32))
        .collect();
    match &sidecar {
        None => {
            scene.missing.push("camera");
            scene.set_spots(&lights);
            scene.judge_beams(options.straight_beams);
        }
        Some(sidecar) => {
            if sidecar.spots.len() != shape.spots as usize {
                let (expected, found) = (shape.spots.to_string(), sidecar.spots.len().to_string());
                let hint = "see whether the files belong together";
                return Err(ImportError::refused(
                    path(SIDECAR),
                    "spots",
                    expected,
                    found,
                    hint,
                ));
            }
            (scene.laser, scene.camera) = (sidecar.laser, sidecar.camera);
            scene.scale = Some(sidecar.photons_per_unit);
            scene.spots = sidecar.spots();
            // The layout's files have no other quantities that may be unknown.
            let of_spots = ["spots.normal", "spots.path", "camera"].into_iter();
            let unknown = of_spots.filter(|name| sidecar.missing.iter().any(|m| m == name));
            scene.missing.extend(unknown);
            scene.conversions.push(format!(
                "histograms divided by {}, spots taken from {SIDECAR}",
                sidecar.factor
            ));
        }
    }
    shadows(&path(SHADOWS), &mut scene, options, files)?;
    scene.missing.extend(["normal", "instance", "label", "rgb"]);
    debug_assert_eq!(scene.depth.len(), w * h);
    if !options.unchecked {
        let geometry = Geometry {
            shape: &scene.shape,
            transient: &scene.transient,
            depth: &scene.depth,
            of_range: options.depth == Some(DepthKind::Range),
            intrinsics,
            laser: scene.laser,
            spots: &scene.spots,
            visibility: Some(&scene.visibility),
            specular: &scene.specular,
        };
        let checked_files = CheckedFiles {
            histogram: &main,
            depth: &path(DEPTH),
            spots: &path(LIGHTS),
            visibility: &path(SHADOWS),
            hint: OPTIONS,
            polarity: "--visibility shadow (or lit, if that was given)",
        };
        scene.check = check(&geometry, &checked_files)?;
    }
    Ok(scene)
}

/// Divides by the factor of our own export. The division is exact, because the factor is a power of
/// two.
fn unscale(h: &mut [f32], sidecar: Option<&Sidecar>) {
    if let Some(sidecar) = sidecar {
        h.iter_mut().for_each(|h| *h /= sidecar.factor);
    }
}
