//! Reads the files of a scene: histograms, depth, mirrors, spots and shadows.

use std::path::Path;

use super::super::files::Files;
use super::super::scene::{ImportedScene, Shape, clean};
use super::super::{ImportError, ImportOptions, Polarity, image, npy};
use super::{GRID, MIRROR, SPECULAR, lines_differ};
use picofarm_dataset::Quantity;

/// Reads the histograms of a `lidar_*.exr`.
pub(super) fn histogram(
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
pub(super) fn not_more(
    file: &Path,
    few: u32,
    h: &[f32],
    many: u32,
    all: &[f32],
) -> Result<(), ImportError> {
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
pub(super) fn depth(file: &Path, files: &Files) -> Result<Vec<f32>, ImportError> {
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

pub(super) fn specular(
    file: &Path,
    scene: &mut ImportedScene,
    files: &Files,
) -> Result<(), ImportError> {
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
pub(super) fn lights(file: &Path, spots: u32, files: &Files) -> Result<Vec<[f32; 3]>, ImportError> {
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
    Ok(grid_indices(spots, n).into_iter().map(|s| all[s]).collect())
}

/// Returns the indices of the spots among the `n` entries of a file.
fn grid_indices(spots: u32, n: usize) -> Vec<usize> {
    let some = match (spots, n) {
        (4, GRID) => Quantity::Transient4.spots_of_100(),
        (25, GRID) => Quantity::Transient25.spots_of_100(),
        _ => return (0..n).collect(),
    };
    some.iter().map(|s| *s as usize).collect()
}

pub(super) fn shadows(
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
    for spot in grid_indices(spots, n) {
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
