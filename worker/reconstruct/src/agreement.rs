//! Whether measurements agree with one another: times of several spots with one depth, spots with the surfaces around
//! them, shadows and light with what the camera looks through. Needs no true scene.

use picofarm_scene::Vec3;
use rayon::prelude::*;
use serde::Serialize;

use crate::{Depth, Measured, closed_form::smooth, paths::Paths};

/// Pixels whose paths are followed, at most about.
const PIXELS: usize = 2048;
/// Spots that a pixel's times need: fewer agree always.
const FEWEST_SPOTS: usize = 3;
/// Times of a spot below which nothing is said of it alone.
const FEWEST_TIMES: usize = 50;
/// Share of a spot's pixels below which the same holds.
const LEAST_LIT: f32 = 0.15;
/// Residuals beyond this do not count for the common offset, metres.
const FAR_M: f32 = 0.3;
/// Step along a path, metres.
const STEP_M: f32 = 0.03;
/// A place is in front of a surface, or behind it, from this distance on, metres.
const CLEAR_M: f32 = 0.06;
/// Neighbours whose depths differ by less than this share are one surface.
const SMOOTH: f32 = 0.04;

/// How well times agree with one depth a pixel, before spots are refined.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Times {
    /// Pairs of a pixel and a spot.
    pub pairs: usize,
    /// Median of the absolute residuals, metres.
    pub residual_m: f32,
    /// What all times have in common beyond geometry, metres: positive where they are late.
    pub offset_m: f32,
    /// Of each spot the median of its absolute residuals, metres; NaN where it has none.
    pub by_spot_m: Vec<f32>,
}

/// What follows from the figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Nothing contradicts.
    Agrees,
    /// Somebody should look.
    Doubtful,
    /// It cannot be right.
    Contradicts,
}

/// Whether measurements agree with one another, with the figures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Agreement {
    /// What follows.
    pub verdict: Verdict,
    /// Why they contradict one another, a sentence each.
    pub reasons: Vec<String>,
    /// Pairs of a pixel and a spot whose times are compared.
    pub times: usize,
    /// Median difference between a time and the depth that all spots' times give, metres of path.
    pub time_residual_m: Option<f32>,
    /// The spot with the largest such median, and that median.
    pub worst_spot: Option<(usize, f32)>,
    /// What all times have in common beyond geometry, metres of path.
    pub time_offset_m: Option<f32>,
    /// Median distance of spots from the surfaces that are seen around them, metres.
    pub spots_off_surface_m: Option<f32>,
    /// Share of the pixels that take part and are lit by no spot.
    pub unlit_pixels: Option<f32>,
    /// Share of shadowed paths that run through nothing but space that the camera looks through.
    pub shadows_without_cause: Option<f32>,
    /// Share of lit paths that run through a surface that the camera sees.
    pub light_through_surfaces: Option<f32>,
}

/// Residuals of times where depths along the rays are `range`.
pub(crate) fn times(measured: &Measured, range: &[f32]) -> Times {
    let pixels = measured.pixels();
    let foci: Vec<Vec3> = measured
        .spots
        .iter()
        .map(|s| s.point - measured.camera.origin)
        .collect();
    let mut by_spot: Vec<Vec<f32>> = vec![Vec::new(); foci.len()];
    let (mut across, mut square) = (0.0f64, 0.0f64);
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
        // What is orthogonal to a change of depth tells of an offset that all times share.
        let near = || found.iter().filter(|f| f.2.abs() < FAR_M);
        let (sum, squares) = near().fold((0.0f64, 0.0f64), |(a, b), f| {
            (a + f64::from(f.1), b + f64::from(f.1) * f64::from(f.1))
        });
        for &(_, slope, late) in near() {
            let beside = 1.0 - f64::from(slope) * sum / squares.max(1e-9);
            across += beside * f64::from(late);
            square += beside;
        }
    }
    let mut all: Vec<f32> = by_spot.iter().flatten().copied().collect();
    Times {
        pairs: all.len(),
        residual_m: median(&mut all),
        offset_m: if square > 0.0 {
            (across / square) as f32
        } else {
            f32::NAN
        },
        by_spot_m: by_spot
            .iter_mut()
            .zip(used)
            .map(|(all, used)| {
                // Of a spot that lights next to nothing, most times may be false returns.
                let enough = all.len() >= FEWEST_TIMES.max((LEAST_LIT * used as f32) as usize);
                if enough { median(all) } else { f32::NAN }
            })
            .collect(),
    }
}

impl Agreement {
    /// Of depths that were not found from times: distances along the rays, and spots; with `masks` their shadows too.
    pub fn of_depths(measured: &Measured, range: &[f32], masks: bool) -> Self {
        let depth = Depth {
            range: range.to_vec(),
            error: vec![UNKNOWN_M; range.len()],
            normal: vec![Vec3::ZERO; range.len()],
        };
        let depth = smooth(measured, &depth);
        judge(measured, figures(measured, &depth, None, masks))
    }
}

/// The verdict on measurements, with depths and normals that follow from them.
pub(crate) fn check(measured: &Measured, depth: &Depth, times: &Times) -> Agreement {
    judge(measured, figures(measured, depth, Some(times), true))
}

fn figures(measured: &Measured, depth: &Depth, times: Option<&Times>, masks: bool) -> Agreement {
    let known = |x: f32| x.is_finite().then_some(x);
    let by_spot = times.iter().flat_map(|t| t.by_spot_m.iter().copied());
    let worst = by_spot
        .enumerate()
        .filter(|(_, m)| m.is_finite())
        .max_by(|a, b| a.1.total_cmp(&b.1));
    let counts = match masks {
        true => paths(measured, depth),
        false => Vec::new(),
    };
    let whole = counts.iter().copied().fold(Count::default(), Count::and);
    let share = |[all, odd]: [usize; 2]| (all >= FEWEST_TIMES).then(|| odd as f32 / all as f32);
    Agreement {
        verdict: Verdict::Agrees,
        reasons: Vec::new(),
        times: times.map_or(0, |t| t.pairs),
        time_residual_m: times.and_then(|t| known(t.residual_m)),
        worst_spot: worst.map(|(i, m)| (measured.spots[i].beam, m)),
        time_offset_m: times.and_then(|t| known(t.offset_m)),
        spots_off_surface_m: off_surface(measured, depth),
        unlit_pixels: masks.then(|| unlit(measured)).flatten(),
        shadows_without_cause: share(whole.shadowed),
        light_through_surfaces: share(whole.lit),
    }
}

/// Adds what follows from the figures. Thresholds lie between those of consistent rooms and of wrong input; the example
/// `agreement` measures both, and docs/benchmarks.md has the figures.
fn judge(measured: &Measured, mut of: Agreement) -> Agreement {
    let bin = measured.bin_width_m;
    let mut say = |refused: bool, text: String| {
        of.verdict = match refused {
            true => Verdict::Contradicts,
            false => of.verdict.max(Verdict::Doubtful),
        };
        of.reasons.push(text);
    };
    if let Some(residual) = of.time_residual_m.filter(|r| *r > RESIDUAL.doubtful(bin)) {
        let text = format!(
            "times of a pixel's spots give different depths: they differ by {residual:.3} m of path (median); check which \
             spot each belongs to, their axes and units, and the image's axes"
        );
        say(residual > RESIDUAL.refused(bin), text);
    }
    let usual = of.time_residual_m.unwrap_or(0.0).max(0.5 * bin);
    if let Some((beam, residual)) = of
        .worst_spot
        .filter(|(_, r)| *r > SPOT.doubtful(bin) && *r > SPOT_TIMES * usual)
    {
        let text = format!(
            "times of spot {beam} are {residual:.3} m of path away from what the others give (median); is it exchanged for \
             another, or in another place?"
        );
        say(residual > SPOT.refused(bin), text);
    }
    let judged = measured.spots.len() >= OFFSET_SPOTS;
    if let Some(offset) = of
        .time_offset_m
        .filter(|o| judged && o.abs() > OFFSET.doubtful(bin))
    {
        let text = format!(
            "all times are {:.3} m of path too {}; check where the gate begins",
            offset.abs(),
            if offset > 0.0 { "late" } else { "early" }
        );
        say(offset.abs() > OFFSET.refused(bin), text);
    }
    if let Some(off) = of
        .spots_off_surface_m
        .filter(|o| *o > OFF_SURFACE.doubtful(0.0))
    {
        let text = format!(
            "spots lie {off:.3} m off the surfaces around them (median); check their units and axes, and the depths"
        );
        say(off > OFF_SURFACE.refused(0.0), text);
    }
    let unlit = of
        .unlit_pixels
        .filter(|_| measured.spots.len() >= FEWEST_SPOTS);
    if let Some(share) = unlit.filter(|s| *s > UNLIT.doubtful(0.0)) {
        let text = format!(
            "{:.0} % of the pixels are lit by none of {} spots; check the masks' polarity",
            100.0 * share,
            measured.spots.len()
        );
        say(share > UNLIT.refused(0.0), text);
    }
    if let Some(share) = of
        .shadows_without_cause
        .filter(|s| *s > SHADOWS.doubtful(0.0))
    {
        let text = format!(
            "{:.0} % of shadows have nothing that casts them; check the masks' polarity and their spots",
            100.0 * share
        );
        say(share > SHADOWS.refused(0.0), text);
    }
    if let Some(share) = of
        .light_through_surfaces
        .filter(|s| *s > LIGHT.doubtful(0.0))
    {
        let text = format!(
            "{:.0} % of lit paths go through a surface that the camera sees; check the masks' polarity, and the spots",
            100.0 * share
        );
        say(share > LIGHT.refused(0.0), text);
    }
    of
}

/// From where on a figure is doubtful, and from where on it cannot be right: so many bins, and at least so much.
struct Limit {
    doubtful: [f32; 2],
    refused: [f32; 2],
}

impl Limit {
    fn doubtful(&self, bin: f32) -> f32 {
        (self.doubtful[0] * bin).max(self.doubtful[1])
    }

    fn refused(&self, bin: f32) -> f32 {
        (self.refused[0] * bin).max(self.refused[1])
    }
}

/// What a weak network predicts may be this wrong: it is stated, and not refused.
const NEVER: [f32; 2] = [0.0, f32::INFINITY];
/// Of the median difference of times.
const RESIDUAL: Limit = Limit {
    doubtful: [0.75, 0.03],
    refused: [2.0, 0.1],
};
/// Of the median difference of one spot's times,
const SPOT: Limit = Limit {
    doubtful: [1.5, 0.06],
    refused: [3.0, 0.15],
};
/// which is so many times that of all spots.
const SPOT_TIMES: f32 = 4.0;
/// Spots from which on an offset of all times is judged. With fewer, errors of single times pass for one: of 64 rooms with 4
/// spots, 32×32 pixels and bins of 0.077 m, one right room was off by 0.215 m.
const OFFSET_SPOTS: usize = 9;
/// Of what all times have in common.
const OFFSET: Limit = Limit {
    doubtful: [0.55, 0.01],
    refused: [1.5, 0.05],
};
/// Of the spots' distance from surfaces, metres.
const OFF_SURFACE: Limit = Limit {
    doubtful: [0.0, 0.1],
    refused: NEVER,
};
/// Of the share of pixels that no spot lights.
const UNLIT: Limit = Limit {
    doubtful: [0.0, 0.2],
    refused: [0.0, 0.9],
};
/// Of the share of shadows that nothing casts.
const SHADOWS: Limit = Limit {
    doubtful: [0.0, 0.3],
    refused: NEVER,
};
/// Of the share of light through surfaces.
const LIGHT: Limit = Limit {
    doubtful: [0.0, 0.08],
    refused: NEVER,
};
/// Standard error of depths of which none is known, metres.
const UNKNOWN_M: f32 = 0.01;

/// Pixels of a sample.
fn sample(pixels: usize) -> impl Iterator<Item = usize> {
    let stride = pixels.div_ceil(PIXELS).max(1);
    (stride / 2..pixels).step_by(stride)
}

fn median(all: &mut [f32]) -> f32 {
    all.sort_by(f32::total_cmp);
    all.get(all.len() / 2).copied().unwrap_or(f32::NAN)
}

/// The share of the pixels that take part for any spot and are lit by none.
fn unlit(measured: &Measured) -> Option<f32> {
    let pixels = measured.pixels();
    let (mut all, mut dark) = (0usize, 0usize);
    for p in sample(pixels) {
        let of = || (0..measured.spots.len()).map(|i| i * pixels + p);
        let mut used = of().filter(|&q| measured.used[q] != 0).peekable();
        if used.peek().is_some() {
            all += 1;
            dark += usize::from(!used.any(|q| measured.lit[q] != 0));
        }
    }
    (all > 0).then(|| dark as f32 / all as f32)
}

/// Where a place is in the image; `None` outside of it.
fn pixel_of(measured: &Measured, place: Vec3) -> Option<(i64, i64)> {
    let i = &measured.camera.intrinsics;
    let q = measured.camera.to_camera(place);
    let (u, v) = (i.fx * q.x / q.z + i.cx, i.fy * q.y / q.z + i.cy);
    let inside = q.z > 0.02 && u >= 0.0 && v >= 0.0 && u < i.width as f32 && v < i.height as f32;
    inside.then_some((u as i64, v as i64))
}

/// The median over spots in view of the least distance to the planes of surfaces seen around them.
fn off_surface(measured: &Measured, depth: &Depth) -> Option<f32> {
    let i = &measured.camera.intrinsics;
    let (width, height) = (i64::from(i.width), i64::from(i.height));
    let reach = i64::from(i.width / 10 + 2);
    let of = |spot: &crate::MeasuredSpot| -> Option<f32> {
        let (u, v) = pixel_of(measured, spot.point)?;
        let mut best: Option<f32> = None;
        for dv in -reach..=reach {
            for du in -reach..=reach {
                let (a, b) = (u + du, v + dv);
                if a < 0 || b < 0 || a >= width || b >= height {
                    continue;
                }
                let p = (b * width + a) as usize;
                let normal = depth.normal[p];
                if normal == Vec3::ZERO || !depth.range[p].is_finite() {
                    continue;
                }
                let x = measured.camera.origin + measured.ray(p) * depth.range[p];
                let far = normal.dot(spot.point - x).abs();
                best = Some(best.map_or(far, |b| b.min(far)));
            }
        }
        best
    };
    let mut all: Vec<f32> = measured.spots.iter().filter_map(of).collect();
    let middle = median(&mut all);
    middle.is_finite().then_some(middle)
}

/// Paths of one spot, or of all: how many there are, and how many contradict what the camera sees.
#[derive(Debug, Clone, Copy, Default)]
struct Count {
    shadowed: [usize; 2],
    lit: [usize; 2],
}

impl Count {
    fn and(self, other: Self) -> Self {
        let sum = |a: [usize; 2], b: [usize; 2]| [a[0] + b[0], a[1] + b[1]];
        Self {
            shadowed: sum(self.shadowed, other.shadowed),
            lit: sum(self.lit, other.lit),
        }
    }
}

/// Shadowed paths through free space alone, and lit ones through a surface, of each spot.
fn paths(measured: &Measured, depth: &Depth) -> Vec<Count> {
    let (near, far) = extremes(measured, depth);
    let paths = Paths::new(measured, depth);
    let width = i64::from(measured.camera.intrinsics.width);
    let follow = |spot: usize, pixel: usize| -> Count {
        let Some(path) = paths.get(spot, pixel) else {
            return Count::default();
        };
        let (here, there) = paths.normals(spot, pixel);
        let end = measured.spots[spot].point;
        let (mut free, mut through, mut before) = (here != Vec3::ZERO, false, false);
        let mut at = path.span.0;
        while at < path.span.1 {
            let place = path.origin + path.direction * at;
            let seen = pixel_of(measured, place).map(|(u, v)| (v * width + u) as usize);
            let away = (place - measured.camera.origin).length();
            let (mut front, mut behind) = (false, false);
            if let Some(p) = seen.filter(|&p| near[p].is_finite()) {
                front = away < near[p] - CLEAR_M;
                let smooth = far[p] - near[p] < SMOOTH * near[p];
                behind = smooth && away > far[p] + CLEAR_M && away < far[p] + 4.0 * CLEAR_M;
            }
            // Next to the surfaces at its ends a path is not clear of them.
            let low = |normal: Vec3, foot: Vec3| normal.dot(place - foot) < CLEAR_M;
            let ends = low(here, path.origin) || (there != Vec3::ZERO && low(there, end));
            free &= front || ends;
            through |= before && behind && !ends;
            before = front || (before && !behind);
            at += STEP_M;
        }
        match path.lit {
            false => Count {
                shadowed: [1, usize::from(free)],
                ..Count::default()
            },
            true => Count {
                lit: [1, usize::from(through)],
                ..Count::default()
            },
        }
    };
    let of = |spot: usize| {
        let pixels: Vec<usize> = sample(paths.pixels()).collect();
        let counts = pixels.into_par_iter().map(|p| follow(spot, p));
        counts.reduce(Count::default, Count::and)
    };
    (0..paths.spots()).map(of).collect()
}

/// Least and greatest range of each pixel and its eight neighbours; NaN where one is not known.
fn extremes(measured: &Measured, depth: &Depth) -> (Vec<f32>, Vec<f32>) {
    let i = &measured.camera.intrinsics;
    let (width, height) = (i.width as usize, i.height as usize);
    let of = |p: usize| -> (f32, f32) {
        let (u, v) = (p % width, p / width);
        let (mut low, mut high) = (f32::INFINITY, 0.0f32);
        for b in v.saturating_sub(1)..(v + 2).min(height) {
            for a in u.saturating_sub(1)..(u + 2).min(width) {
                let range = depth.range[b * width + a];
                if !range.is_finite() {
                    return (f32::NAN, f32::NAN);
                }
                (low, high) = (low.min(range), high.max(range));
            }
        }
        (low, high)
    };
    (0..measured.pixels()).into_par_iter().map(of).unzip()
}
