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

use std::path::{Path, PathBuf};

use picofarm_files::Opener;

use super::check::check;
use super::files::Files;
use super::profile::{Blame, Geometry};
use super::scene::{ImportedScene, Shape, clean, of_fov};
use super::{DepthKind, ImportError, ImportOptions, Item, Polarity, image, npy};
use crate::export::{ASIDE, Aside};
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
fn aside(item: &Item, files: &Files) -> Result<Option<Aside>, ImportError> {
    let path = item.folder.join(ASIDE);
    if !path.is_file() {
        return Ok(None);
    }
    let hint = "export the scene again, or remove the file and give the gate as options";
    let aside: Aside = serde_json::from_slice(&files.bytes(&path)?)
        .map_err(|e| ImportError::unreadable(&path, e, hint))?;
    if aside.format != Aside::FORMAT || !(aside.factor.is_normal() && aside.factor > 0.0) {
        let expected = format!("{}, with a positive factor", Aside::FORMAT);
        let found = format!("{} with {}", aside.format, aside.factor);
        return Err(ImportError::refused(path, "format", expected, found, hint));
    }
    Ok(Some(aside))
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
    let gate = aside(item, &files)?.map_or(PAPER, |a| a.gate);
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
    let aside = aside(item, files)?;
    let by = match &aside {
        Some(_) => format!("by {ASIDE} or the options"),
        None => "and camera and laser at the origin: by the paper or the options".into(),
    };
    let mut conversions = vec![format!(
        "gate from {} m in bins of {} m, {by}",
        shape.gate.start_m, shape.gate.bin_width_m
    )];
    let intrinsics = match (options.fov_deg, &aside) {
        (None, Some(aside)) => aside.intrinsics(),
        (fov, _) => of_fov(shape.width, shape.height, fov.unwrap_or(90.0)),
    };
    let main = lidar(&item.folder, shape.spots);
    let mut transient = histogram(&main, &shape, files, &mut conversions)?;
    unscale(&mut transient, aside.as_ref());
    let mut scene = ImportedScene::new(&item.name, shape, transient, intrinsics);
    for n in shape.subsets.sizes() {
        let file = lidar(&item.folder, n);
        let quantity = if n == 4 {
            Quantity::Transient4
        } else {
            Quantity::Transient25
        };
        let mut h = histogram(&file, &shape, files, &mut conversions)?;
        unscale(&mut h, aside.as_ref());
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
    match &aside {
        None => {
            scene.missing.push("camera");
            scene.set_spots(&lights);
            scene.judge_beams(options.straight_beams);
        }
        Some(aside) => {
            if aside.spots.len() != shape.spots as usize {
                let (expected, found) = (shape.spots.to_string(), aside.spots.len().to_string());
                let hint = "see whether the files belong together";
                return Err(ImportError::refused(
                    path(ASIDE),
                    "spots",
                    expected,
                    found,
                    hint,
                ));
            }
            (scene.laser, scene.camera) = (aside.laser, aside.camera);
            scene.scale = Some(aside.photons_per_unit);
            scene.spots = aside.spots();
            // The layout's files have no other quantities that may be unknown.
            let of_spots = ["spots.normal", "spots.path", "camera"].into_iter();
            let unknown = of_spots.filter(|name| aside.missing.iter().any(|m| m == name));
            scene.missing.extend(unknown);
            scene.conversions.push(format!(
                "histograms divided by {}, spots taken from {ASIDE}",
                aside.factor
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
        let blame = Blame {
            histogram: &main,
            depth: &path(DEPTH),
            spots: &path(LIGHTS),
            visibility: &path(SHADOWS),
            hint: OPTIONS,
            polarity: "--visibility shadow (or lit, if that was given)",
        };
        scene.check = check(&geometry, &blame)?;
    }
    Ok(scene)
}

/// Divides by the factor of our own export. The division is exact, because the factor is a power of
/// two.
fn unscale(h: &mut [f32], aside: Option<&Aside>) {
    if let Some(aside) = aside {
        h.iter_mut().for_each(|h| *h /= aside.factor);
    }
}

/// Reads the histograms of a `lidar_*.exr`.
fn histogram(
    file: &Path,
    shape: &Shape,
    files: &Files,
    conversions: &mut Vec<String>,
) -> Result<Vec<f32>, ImportError> {
    let mut exr = image::exr(file, &files.bytes(file)?)?;
    let (w, h) = (shape.width as usize, shape.height as usize);
    if exr.height != w * h {
        return Err(lines_differ(file, exr.height, w, h));
    }
    if exr.width != shape.gate.bins as usize {
        let (expected, found) = (format!("{} bins", shape.gate.bins), exr.width.to_string());
        return Err(ImportError::refused(
            file,
            "width",
            expected,
            found,
            "see whether the files belong together",
        ));
    }
    if exr.channels.len() != 1 {
        let names: Vec<&str> = exr.channels.iter().map(|c| c.name.as_str()).collect();
        let (expected, found) = ("one, Y", format!("{names:?}"));
        return Err(ImportError::refused(
            file,
            "channels",
            expected,
            found,
            "keep one channel",
        ));
    }
    let mut channel = exr.channels.remove(0);
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    conversions.push(format!(
        "{name}: {} channel {}, {} compression, to 32-bit floats",
        channel.stored, channel.name, exr.compression
    ));
    clean(
        file,
        &mut channel.values,
        shape.gate.bins as usize,
        conversions,
    )?;
    Ok(channel.values)
}

/// Checks that fewer spots have less light. They may have been rendered separately, so noise is
/// tolerated.
fn not_more(file: &Path, few: u32, h: &[f32], many: u32, all: &[f32]) -> Result<(), ImportError> {
    let sum = |h: &[f32]| h.iter().map(|x| f64::from(*x)).sum::<f64>();
    let (few_sum, all_sum) = (sum(h), sum(all));
    if few_sum <= all_sum {
        return Ok(());
    }
    Err(ImportError::refused(
        file,
        "energy",
        format!("less for {few} spots than for {many}, {all_sum:.4e}"),
        format!("{few_sum:.4e}"),
        format!("see whether the files belong together, or import one with --spots {few}"),
    ))
}

/// Reads depth from the only channel, or from one of several equal ones.
fn depth(file: &Path, files: &Files) -> Result<Vec<f32>, ImportError> {
    let mut exr = image::exr(file, &files.bytes(file)?)?;
    exr.channels
        .retain(|c| c.name != "A" && !c.name.ends_with(".A"));
    let Some(first) = exr.channels.first() else {
        return Err(ImportError::refused(
            file,
            "channels",
            "one of depth",
            "none",
            "save it again",
        ));
    };
    let same = |c: &image::Channel| {
        c.values
            .iter()
            .zip(&first.values)
            .all(|(a, b)| a.to_bits() == b.to_bits())
    };
    if !exr.channels.iter().all(same) {
        let names: Vec<&str> = exr.channels.iter().map(|c| c.name.as_str()).collect();
        let (expected, found) = (
            "one, or several that are equal",
            format!("{names:?}, which differ"),
        );
        return Err(ImportError::refused(
            file,
            "channels",
            expected,
            found,
            "keep the channel that holds depth",
        ));
    }
    Ok(exr.channels.swap_remove(0).values)
}

fn specular(file: &Path, scene: &mut ImportedScene, files: &Files) -> Result<(), ImportError> {
    let size = (scene.shape.width as usize, scene.shape.height as usize);
    let grey = image::png(file, &files.bytes(file)?, size)?;
    let between = grey.iter().filter(|g| !matches!(g, 0 | 255)).count();
    if between > 0 {
        scene.conversions.push(format!(
            "{SPECULAR}: {between} grey pixels thresholded at {MIRROR} of 255"
        ));
    }
    scene.specular = grey.into_iter().map(|g| u8::from(g >= MIRROR)).collect();
    Ok(())
}

/// Reads the positions of the scene's spots. The file contains those of the whole grid, or just
/// these.
fn lights(file: &Path, spots: u32, files: &Files) -> Result<Vec<[f32; 3]>, ImportError> {
    let array = npy::parse(file, &files.bytes(file)?)?;
    let n = array.shape.first().copied().unwrap_or(0);
    if array.shape.len() != 2 || array.shape[1] != 3 || (n != GRID && n != spots as usize) {
        let expected = format!("[{GRID}, 3], or as many as spots: [{spots}, 3]");
        let found = format!("{:?}", array.shape);
        return Err(ImportError::refused(
            file,
            "shape",
            expected,
            found,
            "see whether the files belong together",
        ));
    }
    let all: Vec<[f32; 3]> = array.values.as_chunks::<3>().0.to_vec();
    Ok(of_grid(spots, n).into_iter().map(|s| all[s]).collect())
}

/// Returns the indices of the spots among the `n` entries of a file.
fn of_grid(spots: u32, n: usize) -> Vec<usize> {
    let some = match (spots, n) {
        (4, GRID) => Quantity::Transient4.spots_of_100(),
        (25, GRID) => Quantity::Transient25.spots_of_100(),
        _ => return (0..n).collect(),
    };
    some.iter().map(|s| *s as usize).collect()
}

fn shadows(
    file: &Path,
    scene: &mut ImportedScene,
    options: &ImportOptions,
    files: &Files,
) -> Result<(), ImportError> {
    let (w, h, spots) = (
        scene.shape.width as usize,
        scene.shape.height as usize,
        scene.shape.spots,
    );
    let most = w * h * GRID.max(spots as usize) * 3;
    let array = npy::parse_npz(file, &files.bytes(file)?, "shadows", most)?;
    let (n, colours) = match array.shape[..] {
        [n, rows, columns] if (rows, columns) == (h, w) => (n, 1),
        [n, rows, columns, c @ (1 | 3)] if (rows, columns) == (h, w) => (n, c),
        _ => (0, 1),
    };
    if n != GRID && n != spots as usize {
        let expected =
            format!("[{GRID}, {h}, {w}] or [{spots}, {h}, {w}], also with three colours");
        let found = format!("{:?}", array.shape);
        return Err(ImportError::refused(
            file,
            "shadows",
            expected,
            found,
            "see whether the files belong together",
        ));
    }
    let white = array.values.iter().fold(0.0f32, |m, x| m.max(*x));
    let least = array.values.iter().fold(0.0f32, |m, x| m.min(*x));
    if !(least == 0.0 && (white <= 1.0 || white <= 255.0)) {
        let found = format!("{least} to {white}");
        return Err(ImportError::refused(
            file,
            "shadows",
            "values from 0 to 1, or from 0 to 255",
            found,
            "save them so",
        ));
    }
    let white = if white <= 1.0 { 1.0 } else { 255.0 };
    let turn = options.visibility == Some(Polarity::Shadow);
    let mut between = 0u64;
    let mut lit = Vec::with_capacity(spots as usize * w * h);
    for spot in of_grid(spots, n) {
        let mask = &array.values[spot * w * h * colours..][..w * h * colours];
        lit.extend(mask.chunks_exact(colours).map(|c| {
            let mean = c.iter().sum::<f32>() / colours as f32 / white;
            between += u64::from(mean > 0.05 && mean < 0.95);
            u8::from((mean >= 0.5) != turn)
        }));
    }
    scene.visibility = lit;
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    scene.conversions.push(format!(
        "{name}: values of {} thresholded at half of {white}, {between} of them between 5 % and 95 %{}",
        array.stored,
        if turn { ", turned round to 1 = lit" } else { "" }
    ));
    Ok(())
}
