//! Checks that two-bounce paths in the files fit depth and spots. With depth, the paths are
//! computed from it; without, the paths of a pixel's spots must give a single depth.

use std::path::Path;

use serde_json::{Value, json};

use super::{
    ImportError,
    scene::{ImportedScene, direction},
    vector::{distance, dot, norm},
};

/// Approximate maximum number of pixels in the sample.
const SAMPLE: usize = 2048;
/// Minimum number of spots per pixel if no depth is known, because fewer always give a single
/// depth.
const FEWEST_SPOTS: usize = 3;
/// Minimum number of paths for a verdict, over all spots and for one.
const FEWEST: usize = 50;
/// Median differences above this are errors: this number of bins, and at least this number of
/// metres.
const RESIDUAL: [f64; 2] = [2.0, 0.1];
/// The limit for a single spot's median difference, which must also be this multiple of the median
/// over all spots to be an error.
const SPOT: [f64; 2] = [3.0, 0.15];
const SPOT_TIMES: f64 = 4.0;
/// The limit for the common offset of all paths if depth is known.
const OFFSET: [f64; 2] = [1.5, 0.05];

/// Compares the paths of a scene with its geometry. Returns the results, or null if too few can be
/// compared.
///
/// # Errors
/// [`ImportError::Refused`] for paths that cannot be correct.
pub(super) fn check(scene: &ImportedScene, file: &Path) -> Result<Value, ImportError> {
    let found = compare(scene);
    let mut all: Vec<f64> = found.iter().flatten().copied().collect();
    if all.len() < FEWEST {
        return Ok(Value::Null);
    }
    let bin = scene.shape.gate.bin_width_m;
    let limit = |[bins, metres]: [f64; 2]| (bins * bin).max(metres);
    let offset = median(&mut all);
    let absolute = |late: &[f64]| {
        let mut all: Vec<f64> = late.iter().map(|x| libm::fabs(*x)).collect();
        median(&mut all)
    };
    let residual = absolute(&all);
    let by_spot = found.iter().enumerate();
    let by_spot = by_spot.filter(|(_, late)| late.len() >= FEWEST);
    let worst = by_spot
        .map(|(spot, late)| (spot, absolute(late)))
        .max_by(|a, b| a.1.total_cmp(&b.1));
    let refuse = |what: String, hint: &str| {
        let expected = format!(
            "paths from the laser by a spot and the surface to the camera, within {:.3} m of what the geometry gives",
            limit(RESIDUAL)
        );
        let hint = format!("{hint}; or import as they are with --unchecked");
        Err(ImportError::refused(file, "paths", expected, what, hint))
    };
    let usual = residual.max(0.5 * bin);
    if let Some((spot, off)) = worst.filter(|(_, r)| *r > limit(SPOT) && *r > SPOT_TIMES * usual) {
        return refuse(
            format!("those of spot {spot} {off:.3} m away (median)"),
            "see whether spots are exchanged",
        );
    }
    if !scene.depth.is_empty() && has_depth(scene) && libm::fabs(offset) > limit(OFFSET) {
        let late = if offset > 0.0 { "longer" } else { "shorter" };
        let off = libm::fabs(offset);
        return refuse(
            format!("all of them {off:.3} m {late} (median)"),
            "see from when times count, and whether units and depth are right",
        );
    }
    if residual > limit(RESIDUAL) {
        return refuse(
            format!("{residual:.3} m away (median)"),
            "see whether units, axes and the order of spots are right",
        );
    }
    Ok(json!({
        "pairs": all.len(), "residual_m": round(residual), "offset_m": round(offset),
        "worst_spot": worst.map(|(spot, off)| json!([spot, round(off)])),
    }))
}

fn has_depth(scene: &ImportedScene) -> bool {
    !scene.missing.contains(&"depth")
}

/// Returns, for each spot, how much longer its paths are than the geometry predicts.
fn compare(scene: &ImportedScene) -> Vec<Vec<f64>> {
    let shape = &scene.shape;
    let (w, h) = (shape.width as usize, shape.height as usize);
    let pixels = w * h;
    let masks = !scene.missing.contains(&"visibility");
    let stride = pixels.div_ceil(SAMPLE).max(1);
    let mut late: Vec<Vec<f64>> = vec![Vec::new(); scene.spots.len()];
    for pixel in (stride / 2..pixels).step_by(stride) {
        if scene.specular.get(pixel).is_some_and(|m| *m != 0) {
            continue;
        }
        let d = direction(scene.intrinsics, pixel / w, pixel % w);
        let ray = d.map(|c| c / norm(d));
        let lit: Vec<(usize, [f64; 3], f64)> = scene
            .spots
            .iter()
            .enumerate()
            .filter_map(|(s, spot)| {
                let at = s * pixels + pixel;
                let path = f64::from(*scene.two_bounce.get(at)?);
                let spot = spot.as_ref().filter(|_| path > 0.0)?;
                let lit = !masks || scene.visibility.get(at) == Some(&1);
                let place = spot.position.map(f64::from);
                lit.then(|| (s, place, path - f64::from(spot.path_m)))
            })
            .collect();
        let range = match has_depth(scene) {
            true => f64::from(scene.depth[pixel]) * norm(d),
            false if lit.len() >= FEWEST_SPOTS => {
                let mut each: Vec<f64> = lit
                    .iter()
                    .map(|(_, l, rest)| (rest * rest - dot(*l, *l)) / (2.0 * (rest - dot(ray, *l))))
                    .filter(|x| x.is_finite())
                    .collect();
                median(&mut each)
            }
            false => continue,
        };
        if !(range.is_finite() && range > 0.0) {
            continue;
        }
        let x = ray.map(|c| c * range);
        for (s, place, rest) in lit {
            late[s].push(rest - range - distance(x, place));
        }
    }
    late
}

/// Returns the upper median; NaN for an empty slice.
fn median(of: &mut [f64]) -> f64 {
    of.sort_by(f64::total_cmp);
    of.get(of.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Rounds to few digits, because people also read the manifest.
fn round(x: f64) -> f64 {
    libm::round(x * 1e6) / 1e6
}
