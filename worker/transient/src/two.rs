//! Exactly two bounces: stratified sub-pixel samples, each connected to every spot. No random walk.

use picofarm_scene::Vec3;

use crate::{
    emitter::Emitters,
    film::{Film, Pairs},
    rng::Rng,
    truth::Centres,
    walk::{Scratch, Walk},
    world::World,
};

/// How finely pixels are sampled.
#[derive(Debug, Clone)]
pub(crate) struct Sampling {
    /// Strata a side in an ordinary pixel beside 64 camera paths, before rounding.
    base: f32,
    /// Row-major: the pixel or one of its neighbours shows a mirror or stands in a mirror spot's beam.
    /// Decided from the centres alone, hence independent of the samples: no bias.
    pub refined: Vec<bool>,
}

impl Sampling {
    pub fn plan(world: &World, emitters: &Emitters, centres: &Centres) -> Self {
        let i = world.camera.intrinsics;
        // 4×4 where a pixel is 1/128 wide at unit distance (256 pixels over 90°), finer as the root of
        // its width: wider pixels straddle more bins.
        let pixel = 1.0 / i.fx.min(i.fy);
        let base = std::env::var("E_TWO")
            .ok()
            .and_then(|v| v.parse().ok())
            .unwrap_or(4.0f32)
            * (pixel * 128.0).sqrt();
        let narrow = |k: usize| {
            centres.hits[k].as_ref().is_some_and(|h| {
                h.surface.specular
                    || emitters.on_mirror.iter().any(|&e| {
                        let e = &emitters.list[e];
                        e.intensity((h.p - e.p).normalized()) > 0.0
                    })
            })
        };
        let (width, height) = (i.width as usize, i.height as usize);
        let marked: Vec<bool> = (0..width * height).map(narrow).collect();
        let refined = (0..width * height)
            .map(|k| {
                let (row, col) = (k / width, k % width);
                let rows = row.saturating_sub(1)..=(row + 1).min(height - 1);
                rows.into_iter().any(|r| {
                    let cols = col.saturating_sub(1)..=(col + 1).min(width - 1);
                    cols.into_iter().any(|c| marked[r * width + c])
                })
            })
            .collect();
        Self { base, refined }
    }

    /// Strata a side (even) in ordinary pixels and where a narrow lobe may be seen. They grow with the
    /// passes so that neither part of the histogram is much noisier than the other; `passes` = 0
    /// is a render of two bounces only.
    pub fn sides(&self, passes: u32) -> (u32, u32) {
        let passes = if passes == 0 { 64 } else { passes };
        let side = self.base * libm::powf(passes as f32 / 16.0, 0.4);
        let side = 2 * (0.5 * side).round().clamp(1.0, 16.0) as u32;
        (side, (4 * side).min(64))
    }

    /// How the two-bounce variance falls with the passes: as n^(−3/2) for n strata, since half of it
    /// lies on edges between bins.
    pub fn variance(&self, passes: u32) -> f64 {
        let side = f64::from(self.sides(passes).0);
        1.0 / (side * side * side)
    }
}

/// Adds one pixel's two-bounce samples to `pairs`; returns how many there were.
pub(crate) fn sample_pixel(
    walk: &Walk,
    film: &Film,
    (row, col, side): (u32, u32, u32),
    rng: &mut Rng,
    scratch: &mut Scratch,
    (pairs, outside): (&mut Pairs, &mut u64),
) -> u32 {
    let count = side * side;
    for stratum in 0..count {
        let (a, b) = ((stratum % side) as f32, (stratum / side) as f32);
        let (a, b) = (a + rng.uniform(), b + rng.uniform());
        let d = walk
            .world
            .camera
            .ray(col as f32 + a / side as f32, row as f32 + b / side as f32);
        let odd = stratum % 2 == 1;
        let sign = if odd { -1.0 } else { 1.0 };
        connect(walk, film, (d, sign), scratch, (pairs, outside));
        if odd {
            pairs.finish();
        }
    }
    count
}

fn connect(
    walk: &Walk,
    film: &Film,
    (d, sign): (Vec3, f32),
    scratch: &mut Scratch,
    (pairs, outside): (&mut Pairs, &mut u64),
) {
    let (world, emitters) = (walk.world, walk.emitters);
    let Scratch { stack, weights, .. } = scratch;
    let Some(h) = world.closest(stack, Vec3::ZERO, d) else {
        return;
    };
    if h.surface.strength == 0.0 {
        return;
    }
    let range = h.p.length();
    emitters.weights(h.p, h.n, -h.p / range, &h.surface, weights);
    let to_camera = world.metres(range);
    for (spot, (e, &w)) in emitters.list.iter().zip(weights.iter()).enumerate() {
        if w > 0.0 && world.free(stack, h.p, h.n, e.p, e.n) {
            let path = e.path_m + world.metres((e.p - h.p).length()) + to_camera;
            let slot = film.slot(path);
            *outside += u64::from(film.outside(slot));
            pairs.add(film, slot, w, sign, spot);
        }
    }
}
