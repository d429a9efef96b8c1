//! The agreement of measurements with one another: times of several spots with one depth, spots
//! with the surrounding surfaces, and shadows and light with the space that the camera sees
//! through. No true scene is required.

mod times;

use picofarm_scene::Vec3;
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    Depth, Measured,
    closed_form::smooth,
    paths::Paths,
    scale::{in_room, lengths},
};

pub(crate) use times::{Times, times};

/// The approximate greatest number of pixels with evaluated paths.
const PIXELS: usize = 2048;
/// The least number of spots for comparing a pixel's times: fewer always agree.
const FEWEST_SPOTS: usize = 3;
/// The least number of times for judging a single spot.
const FEWEST_TIMES: usize = 50;
/// The step along a path, metres.
const STEP_M: f32 = 0.03;
/// The least distance of a position in front of a surface, or behind it, metres.
const CLEAR_M: f32 = 0.06;
/// Neighbours with a smaller relative difference in depth are one surface.
const SMOOTH: f32 = 0.04;

/// The verdict on the figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// No figure shows a contradiction.
    Agrees,
    /// The measurements should be examined.
    Doubtful,
    /// The measurements cannot be right.
    Contradicts,
}

/// The agreement of measurements with one another, with its figures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Agreement {
    /// The verdict.
    pub verdict: Verdict,
    /// The contradictions, a sentence each.
    pub reasons: Vec<String>,
    /// The number of compared pairs of a pixel and a spot; 0 where times were computed from depth.
    pub times: usize,
    /// The median difference between a time and the depth from all spots' times, metres of path;
    /// `None` where times were computed from depth.
    pub time_residual_m: Option<f32>,
    /// The spot with the largest such median, and that median.
    pub worst_spot: Option<(usize, f32)>,
    /// The mean offset of times beyond geometry, metres of path; 0 unless every part of the image
    /// is off by the limit, as with a shifted clock.
    pub time_offset_m: Option<f32>,
    /// The median distance of spots from the visible surfaces around them, metres.
    pub spots_off_surface_m: Option<f32>,
    /// The share of the pixels in use that no spot lights.
    pub unlit_pixels: Option<f32>,
    /// The share of shadowed paths that only pass through space that the camera sees through.
    pub shadows_without_cause: Option<f32>,
    /// The share of lit paths that pass through a surface that the camera sees.
    pub light_through_surfaces: Option<f32>,
}

impl Agreement {
    /// Computes the agreement of depths that do not come from times: distances along the rays, and
    /// spots; if `masks` is set, also their shadows.
    pub fn of_depths(measured: &Measured, range: &[f32], masks: bool) -> Self {
        let mut measured = measured.clone();
        in_room(&mut measured, |measured, factor| {
            let depth = Depth {
                range: lengths(range, factor),
                error: vec![UNKNOWN_M; range.len()],
                normal: vec![Vec3::ZERO; range.len()],
            };
            let depth = smooth(measured, &depth);
            judge(measured, figures(measured, &depth, None, masks), factor)
        })
    }
}

/// Computes the agreement of measurements with the depths and normals computed from them. The
/// lengths of the measurements are those of the scene times `factor`; those of the result are the
/// scene's.
pub(crate) fn check(measured: &Measured, depth: &Depth, times: &Times, factor: f32) -> Agreement {
    judge(
        measured,
        figures(measured, depth, Some(times), true),
        factor,
    )
}

fn figures(measured: &Measured, depth: &Depth, times: Option<&Times>, masks: bool) -> Agreement {
    let known = |x: f32| x.is_finite().then_some(x);
    // Times that were computed from one depth agree by construction, which says nothing.
    let times = times.filter(|_| !measured.computed);
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

/// Adds the verdict on the figures. The thresholds are between the figures of consistent rooms and
/// those of wrong input; the example `agreement` measures both, and docs/benchmarks.md has the
/// figures. Lengths are those of the scene times `factor`; those of the result are the scene's.
fn judge(measured: &Measured, mut of: Agreement, factor: f32) -> Agreement {
    let bin = measured.bin_width_m;
    let metres = |m: f32| format!("{:.3} m", m / factor);
    let mut say = |refused: bool, text: String| {
        of.verdict = match refused {
            true => Verdict::Contradicts,
            false => of.verdict.max(Verdict::Doubtful),
        };
        of.reasons.push(text);
    };
    if let Some(residual) = of.time_residual_m.filter(|r| *r > RESIDUAL.doubtful(bin)) {
        let text = format!(
            "times of a pixel's spots give different depths: they differ by {} of path (median); check which \
             spot each belongs to, their axes and units, and the image's axes",
            metres(residual)
        );
        say(residual > RESIDUAL.refused(bin), text);
    }
    let usual = of.time_residual_m.unwrap_or(0.0).max(0.5 * bin);
    if let Some((beam, residual)) = of
        .worst_spot
        .filter(|(_, r)| *r > SPOT.doubtful(bin) && *r > SPOT_TIMES * usual)
    {
        let text = format!(
            "times of spot {beam} are {} of path away from what the others give (median); is it exchanged for \
             another, or in another place?",
            metres(residual)
        );
        say(residual > SPOT.refused(bin), text);
    }
    let judged = measured.spots.len() >= OFFSET_SPOTS;
    if let Some(offset) = of
        .time_offset_m
        .filter(|o| judged && o.abs() > OFFSET.doubtful(bin))
    {
        let text = format!(
            "all times are {} of path too {}; check where the gate begins",
            metres(offset.abs()),
            if offset > 0.0 { "late" } else { "early" }
        );
        say(offset.abs() > OFFSET.refused(bin), text);
    }
    if let Some(off) = of
        .spots_off_surface_m
        .filter(|o| *o > OFF_SURFACE.doubtful(0.0))
    {
        let text = format!(
            "spots lie {} off the surfaces around them (median); check their units and axes, and the depths",
            metres(off)
        );
        say(off > OFF_SURFACE.refused(0.0), text);
    }
    let unlit = of
        .unlit_pixels
        .filter(|_| measured.spots.len() >= FEWEST_SPOTS);
    if let Some(share) = unlit.filter(|s| *s > UNLIT.doubtful(0.0)) {
        let text = format!(
            "{:.0} % of the pixels are lit by none of {} spots; check the masks' polarity, or light the room with more spots",
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
            "{:.0} % of lit paths go through a surface that the camera sees; check the masks' polarity, the spots, and mirrors that were not found",
            100.0 * share
        );
        say(share > LIGHT.refused(0.0), text);
    }
    of.scale(1.0 / factor);
    of
}

/// The limits from which a figure is doubtful, and from which it cannot be right: a number of bins,
/// and a minimum.
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

/// The predictions of a weak network may be this wrong: this is reported, but not refused.
const NEVER: [f32; 2] = [0.0, f32::INFINITY];
/// The limit of the median difference of times.
const RESIDUAL: Limit = Limit {
    doubtful: [0.75, 0.03],
    refused: [2.0, 0.1],
};
/// The limit of the median difference of one spot's times,
const SPOT: Limit = Limit {
    doubtful: [1.5, 0.06],
    refused: [3.0, 0.15],
};
/// which must also exceed that of all spots by this factor.
const SPOT_TIMES: f32 = 4.0;
/// The number of spots from which an offset of all times is judged. With fewer, errors of single
/// times resemble an offset: of 64 rooms with 4 spots, 32×32 pixels and bins of 0.077 m, one right
/// room had an offset of 0.215 m.
const OFFSET_SPOTS: usize = 9;
/// The limit of the offset that all times have in common.
const OFFSET: Limit = Limit {
    doubtful: [0.55, 0.01],
    refused: [1.5, 0.05],
};
/// The limit of the spots' distance from surfaces, metres.
const OFF_SURFACE: Limit = Limit {
    doubtful: [0.0, 0.1],
    refused: NEVER,
};
/// The limit of the share of pixels that no spot lights.
const UNLIT: Limit = Limit {
    doubtful: [0.0, 0.2],
    refused: [0.0, 0.9],
};
/// The limit of the share of shadows without a cause.
const SHADOWS: Limit = Limit {
    doubtful: [0.0, 0.3],
    refused: NEVER,
};
/// The limit of the share of light through surfaces.
const LIGHT: Limit = Limit {
    doubtful: [0.0, 0.08],
    refused: NEVER,
};
/// The standard error of depths if it is unknown, metres.
const UNKNOWN_M: f32 = 0.01;

/// Returns the pixels of a sample.
fn sample(pixels: usize) -> impl Iterator<Item = usize> {
    let stride = pixels.div_ceil(PIXELS).max(1);
    (stride / 2..pixels).step_by(stride)
}

fn median(all: &mut [f32]) -> f32 {
    all.sort_by(f32::total_cmp);
    all.get(all.len() / 2).copied().unwrap_or(f32::NAN)
}

/// Returns the share of the pixels in use for any spot that no spot lights.
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

/// Returns the pixel of a position, or `None` outside the image.
fn pixel_of(measured: &Measured, place: Vec3) -> Option<(i64, i64)> {
    let i = &measured.camera.intrinsics;
    let q = measured.camera.to_camera(place);
    let (u, v) = (i.fx * q.x / q.z + i.cx, i.fy * q.y / q.z + i.cy);
    let inside = q.z > 0.02 && u >= 0.0 && v >= 0.0 && u < i.width as f32 && v < i.height as f32;
    inside.then_some((u as i64, v as i64))
}

/// Returns the median over visible spots of the least distance to the planes of surrounding
/// surfaces.
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

/// The paths of one spot, or of all: their number, and the number that contradict the camera's
/// view.
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

/// Counts shadowed paths that only pass through free space, and lit ones through a surface, for
/// each spot.
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
            // Next to the surfaces at its ends, a path cannot be clear of them.
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

/// Returns the least and greatest range of each pixel and its eight neighbours; NaN if one is
/// unknown.
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
