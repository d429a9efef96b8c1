//! The agreement of times with one depth a pixel, and the offset that all of them share.

use picofarm_scene::Vec3;

use super::{FEWEST_SPOTS, FEWEST_TIMES, OFFSET, median, sample};
use crate::Measured;

/// The least share of lit pixels for judging a single spot.
const LEAST_LIT: f32 = 0.15;
/// Residuals beyond this are excluded from the common offset, metres.
const FAR_M: f32 = 0.3;
/// The rows and columns of the parts of the image whose offsets are compared.
const PARTS: usize = 2;
/// The least weight of a pixel's own offset: the sum of squares of what a change of depth cannot
/// explain. Less than this tells no offset.
const LEAST_WEIGHT: f64 = 0.05;

/// The agreement of times with one depth a pixel, before spots are refined.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Times {
    /// The number of pairs of a pixel and a spot.
    pub pairs: usize,
    /// The median of the absolute residuals, metres.
    pub residual_m: f32,
    /// The mean offset of times beyond geometry, metres: positive if they are late, 0 if the median
    /// of a part of the image is below the limit. A shifted clock moves all times; light of three
    /// bounces and wrong walls move those of some parts.
    pub offset_m: f32,
    /// Each spot's median of its absolute residuals, metres; NaN if it has none.
    pub by_spot_m: Vec<f32>,
}

/// Returns the residuals of times if depths along the rays are `range`.
pub(crate) fn times(measured: &Measured, range: &[f32]) -> Times {
    let pixels = measured.pixels();
    let foci: Vec<Vec3> = measured
        .spots
        .iter()
        .map(|s| s.point - measured.camera.origin)
        .collect();
    let mut by_spot: Vec<Vec<f32>> = vec![Vec::new(); foci.len()];
    let mut parts: [Vec<(f32, f32)>; 1 + PARTS * PARTS] = Default::default();
    let mut found: Vec<(usize, f32, f32)> = Vec::with_capacity(foci.len());
    let mut used = vec![0usize; foci.len()];
    for p in sample(pixels) {
        let (r, x) = (measured.ray(p), range[p]);
        found.clear();
        if !x.is_finite() {
            continue;
        }
        for (i, &l) in foci.iter().enumerate() {
            let q = i * pixels + p;
            used[i] += usize::from(measured.used[q] != 0);
            if measured.lit[q] == 0 || measured.used[q] == 0 {
                continue;
            }
            let way = r * x - l;
            let length = way.length();
            let slope = 1.0 + way.dot(r) / length.max(1e-3);
            let late = measured.tau[q] - measured.spots[i].path_m - x - length;
            found.push((i, slope, late));
        }
        if found.len() < FEWEST_SPOTS {
            continue;
        }
        for &(i, _, late) in &found {
            by_spot[i].push(late.abs());
        }
        // The component orthogonal to a change of depth shows an offset that all times share.
        let near = || found.iter().filter(|f| f.2.abs() < FAR_M);
        let (sum, squares) = near().fold((0.0f64, 0.0f64), |(a, b), f| {
            (a + f64::from(f.1), b + f64::from(f.1) * f64::from(f.1))
        });
        let (mut across, mut square) = (0.0f64, 0.0f64);
        for &(_, slope, late) in near() {
            let rest = 1.0 - f64::from(slope) * sum / squares.max(1e-9);
            across += rest * f64::from(late);
            square += rest;
        }
        if square > LEAST_WEIGHT {
            let own = ((across / square) as f32, square as f32);
            parts[0].push(own);
            parts[1 + part(measured, p)].push(own);
        }
    }
    let mut all: Vec<f32> = by_spot.iter().flatten().copied().collect();
    Times {
        pairs: all.len(),
        residual_m: median(&mut all),
        offset_m: shared_offset(parts, OFFSET.doubtful(measured.bin_width_m)),
        by_spot_m: by_spot
            .iter_mut()
            .zip(used)
            .map(|(all, used)| {
                // If a spot lights almost nothing, most of its times may be false returns.
                let enough = all.len() >= FEWEST_TIMES.max((LEAST_LIT * used as f32) as usize);
                if enough { median(all) } else { f32::NAN }
            })
            .collect(),
    }
}

/// Returns the part of the image that has a pixel, of a grid of [`PARTS`] by [`PARTS`].
fn part(measured: &Measured, pixel: usize) -> usize {
    let i = &measured.camera.intrinsics;
    let (width, height) = (i.width as usize, i.height as usize);
    let (u, v) = (pixel % width, pixel / width);
    v * PARTS / height * PARTS + u * PARTS / width
}

/// Returns the mean offset, from the offset of each pixel and its weight in the whole image and in
/// its parts; 0 if the median of one part has another sign or is below `least`, NaN without any
/// pixel. Parts with few pixels do not count.
fn shared_offset(parts: [Vec<(f32, f32)>; 1 + PARTS * PARTS], least: f32) -> f32 {
    let [whole, parts @ ..] = parts;
    let weight = |own: &[(f32, f32)]| own.iter().map(|o| f64::from(o.1)).sum::<f64>();
    let sum: f64 = whole.iter().map(|o| f64::from(o.0) * f64::from(o.1)).sum();
    let mean = (sum / weight(&whole)) as f32;
    let shared = |mut own: Vec<(f32, f32)>| {
        if own.is_empty() || own.len() * 10 < whole.len() {
            return true;
        }
        own.sort_by(|a, b| a.0.total_cmp(&b.0));
        let half = 0.5 * weight(&own);
        let mut sum = 0.0;
        let middle = own.iter().find(|o| {
            sum += f64::from(o.1);
            sum >= half
        });
        middle.is_some_and(|o| o.0 * mean > 0.0 && o.0.abs() >= least)
    };
    match mean.is_nan() || parts.into_iter().all(shared) {
        true => mean,
        false => 0.0,
    }
}
