//! Which spots light what a pixel sees: by its light where there is some, and by what stands in
//! between.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::{
    geometry::{Rays, Source},
    light::{CARRIES, Share},
};

/// What an answer rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Ground {
    /// Its light, or that there is none.
    Light = 0,
    /// The cosines cannot carry light: only the depth map answers.
    Geometry = 1,
    /// Other spots' light comes at the same time: the histogram cannot tell.
    Ambiguous = 2,
    /// Its light would be too faint to be seen.
    Faint = 3,
}

/// Cosines below which spot and surface may be on one wall; one of the two normals may be five
/// times as wrong.
const ONE_WALL: f32 = 0.06;
/// Others' light over a spot's own from which on they share their bins,
const SHARED: f32 = 0.5;
/// and the share of all that light which is there where nobody can know whose it is.
const UNDECIDED: std::ops::Range<f32> = 0.15..0.9;
/// Expected light over noise from which on it counts as visible.
const VISIBLE: f32 = 3.0;

/// Steps of a ray through the depth map.
const STEPS: usize = 64;
/// A point this far behind a surface is hidden, as a share of its depth.
const BEHIND: f32 = 0.006;
/// A ray deeper than this behind a surface may pass behind it, metres.
const THIN_M: f32 = 0.4;

/// What the depth map knows of a segment from a spot to what a pixel sees.
#[derive(Debug, Clone, Copy, Default)]
pub struct Way {
    /// Share of steps behind the visible surface.
    pub behind: f32,
    /// Share of steps closely behind the visible surface.
    pub little: f32,
    /// Share of steps outside of the image.
    pub outside: f32,
    /// The most that a step is behind the visible surface, as a share of its depth; negative where
    /// all are before it.
    pub deepest: f32,
    /// The least distance from a step to the surface behind it along the view, likewise.
    pub clearance: f32,
    /// Where the first step behind is: 0 at the spot, 1 at the pixel; 2 where none is.
    pub first: f32,
}

/// Follows a segment through a depth map. Both ends are left out: the surfaces there are no
/// obstacles.
pub fn way(rays: &Rays, depth: &[f32], from: Vec3, to: Vec3) -> Way {
    let mut way = Way {
        deepest: -1.0,
        clearance: 1.0,
        first: 2.0,
        ..Way::default()
    };
    let share = 1.0 / STEPS as f32;
    for n in 0..STEPS {
        let t = 0.04 + 0.92 * n as f32 / (STEPS - 1) as f32;
        let q = from * (1.0 - t) + to * t;
        let Some(z) = farthest(rays, depth, q) else {
            way.outside += share;
            continue;
        };
        let deep = (q.z - z) / z;
        way.deepest = way.deepest.max(deep);
        if deep > BEHIND {
            way.behind += share;
            way.first = way.first.min(t);
            if q.z - z < THIN_M {
                way.little += share;
            }
        } else {
            way.clearance = way.clearance.min(-deep);
        }
    }
    way
}

/// The greatest depth of the four pixels about a point's image: a point is behind a surface only
/// where it is behind all of them, so that slants do not count.
#[inline]
fn farthest(rays: &Rays, depth: &[f32], q: Vec3) -> Option<f32> {
    if q.z <= 1e-3 {
        return None;
    }
    let u = q.x / q.z * rays.lens.fx + rays.lens.cx;
    let v = q.y / q.z * rays.lens.fy + rays.lens.cy;
    if !(u >= 0.0 && v >= 0.0 && u < rays.width as f32 && v < rays.height as f32) {
        return None;
    }
    let pair = |x: f32, most: usize| {
        let low = (x - 0.5).max(0.0) as usize;
        (low.min(most - 1), (low + 1).min(most - 1))
    };
    let ((u0, u1), (v0, v1)) = (pair(u, rays.width), pair(v, rays.height));
    let (top, bottom) = (v0 * rays.width, v1 * rays.width);
    let z = depth[top + u0].max(depth[top + u1]);
    Some(z.max(depth[bottom + u0]).max(depth[bottom + u1]))
}

/// All pixels of a source, judged one by one: `[pixel]`.
#[derive(Debug, Clone, Default)]
pub struct Judged {
    pub way: Vec<Way>,
    /// Log odds of being lit.
    pub logit: Vec<f32>,
    /// The same, smoothed over each surface.
    pub smooth: Vec<f32>,
    pub ground: Vec<Ground>,
}

/// Judges all pairs: `[source]`.
pub fn shadows(rays: &Rays, depth: &[f32], sources: &[Source], shares: &[Share]) -> Vec<Judged> {
    let n = sources.len();
    let of = |i: usize| {
        let mut judged = Judged::default();
        for p in 0..rays.len() {
            let x = rays.unit[p] * (depth[p] * rays.slant[p]);
            let way = way(rays, depth, sources[i].point, x);
            let (logit, ground) = judge(&shares[p * n + i], &way);
            judged.way.push(way);
            judged.logit.push(logit);
            judged.ground.push(ground);
        }
        judged.smooth = spread(rays, depth, &judged.logit);
        judged
    };
    (0..n).into_par_iter().map(of).collect()
}

/// Whether two pixels may be of one surface.
pub fn alike(depth: &[f32], p: usize, q: usize) -> bool {
    (depth[q] - depth[p]).abs() < 0.05 * depth[p]
}

/// Log odds of being lit. The numbers are a logistic regression's over the pairs of six furnished
/// rooms, seeds 92001 to 92006.
fn judge(share: &Share, way: &Way) -> (f32, Ground) {
    let [at_spot, own] = share.cosines;
    let facing = at_spot.min(own);
    if share.expected <= 0.0 {
        let seen = match way.behind > 0.0 {
            true => 1.0 - 2.0 * (way.little * 8.0).min(1.0) - (way.behind * 4.0).min(1.0),
            false => 2.5,
        };
        // On the spot's own wall, within the error of normals, nothing but what stands on it casts
        // a shadow.
        let (low, high) = (at_spot.abs().min(own.abs()), at_spot.abs().max(own.abs()));
        let one_wall = high < ONE_WALL || (low < 0.5 * ONE_WALL && high < 5.0 * ONE_WALL);
        let logit = match facing < -CARRIES && !one_wall {
            true => -4.0,
            false => seen,
        };
        return (logit, Ground::Geometry);
    }
    // Neither too little for any nor enough for all that share its bins.
    let ambiguous = share.others > SHARED && UNDECIDED.contains(&share.pooled);
    let clear = share.clear / (4.0 + share.clear);
    let alone = 1.0 / (1.0 + share.others);
    let bound = share.bound.min(1.2);
    let found = if ambiguous { share.pooled } else { share.found }.min(1.2);
    let light = clear * (-2.6 + 3.9 * bound - 2.8 * bound.min(0.3) + 0.6 * bound.min(0.6))
        + clear * alone * (0.3 + 5.1 * found + 2.3 * found.min(0.4))
        - 1.8 * alone
        - 0.8 * (1.0 - clear) * bound;
    let seen = match way.behind > 0.0 {
        true => -0.3 - 1.9 * (way.little * 8.0).min(1.0) + 0.5 * (way.behind * 4.0).min(1.0),
        false => 2.9 - 1.8 * clear,
    };
    let logit = -0.6 + light + seen + 3.8 * facing.min(0.3) - 0.6 * (way.outside * 3.0).min(1.0);
    let ground = match (ambiguous, share.clear < VISIBLE) {
        (true, _) => Ground::Ambiguous,
        (_, true) => Ground::Faint,
        _ => Ground::Light,
    };
    (logit, ground)
}

/// Mean log odds over neighbours of alike depth.
fn spread(rays: &Rays, depth: &[f32], logit: &[f32]) -> Vec<f32> {
    let (width, height, step) = (rays.width, rays.height, rays.step());
    (0..rays.len())
        .map(|p| {
            let (column, row) = (p % width, p / width);
            let (mut sum, mut weight) = (0.0, 0.0);
            for v in row.saturating_sub(step)..(row + step + 1).min(height) {
                for u in column.saturating_sub(step)..(column + step + 1).min(width) {
                    let q = v * width + u;
                    let w = if q == p { 2.0 } else { 1.0 };
                    if alike(depth, p, q) {
                        sum += w * logit[q];
                        weight += w;
                    }
                }
            }
            if weight > 0.0 { sum / weight } else { logit[p] }
        })
        .collect()
}
