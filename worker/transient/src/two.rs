//! Exactly two bounces: stratified sub-pixel samples, each connected to every spot. No random walk.

use picofarm_scene::Vec3;

use crate::{
    api::{Gate, Overflow},
    bvh::Stack,
    emitter::Emitters,
    film::{Pixel, Unit},
    rng::Rng,
    truth::Centres,
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

/// Buffers reused between pixels.
#[derive(Debug)]
pub(crate) struct Scratch {
    pub stack: Stack,
    pub weights: Vec<f32>,
    pub unit: Unit,
}

impl Scratch {
    pub fn new(world: &World, emitters: &Emitters, gate: &Gate) -> Self {
        Self {
            stack: world.bvh.stack(),
            weights: vec![0.0; emitters.list.len()],
            unit: Unit::new(gate.bins),
        }
    }
}

impl Sampling {
    pub fn plan(world: &World, emitters: &Emitters, centres: &Centres) -> Self {
        let i = world.camera.intrinsics;
        // 4×4 where a pixel is 1/128 wide at unit distance (256 pixels over 90°), finer as the root of
        // its width: wider pixels straddle more bins.
        let pixel = 1.0 / i.fx.min(i.fy);
        let base = 4.0 * (pixel * 128.0).sqrt();
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
    /// camera paths so that neither part of the histogram is much noisier than the other; `paths` = 0
    /// is a render of two bounces only.
    pub fn sides(&self, paths: u32) -> (u32, u32) {
        let paths = if paths == 0 { 256 } else { paths };
        let side = self.base * (paths as f32 / 64.0).sqrt().sqrt();
        let side = 2 * (0.5 * side).round().clamp(1.0, 16.0) as u32;
        (side, (4 * side).min(64))
    }
}

/// Adds one pixel's two-bounce samples to `pixel`; returns how many there were.
pub(crate) fn sample_pixel(
    world: &World,
    emitters: &Emitters,
    gate: &Gate,
    (row, col, side): (u32, u32, u32),
    rng: &mut Rng,
    scratch: &mut Scratch,
    (pixel, overflow): (&mut Pixel, &mut Overflow),
) -> u32 {
    let count = side * side;
    for stratum in 0..count {
        let (a, b) = ((stratum % side) as f32, (stratum / side) as f32);
        let (a, b) = (a + rng.uniform(), b + rng.uniform());
        let d = world
            .camera
            .ray(col as f32 + a / side as f32, row as f32 + b / side as f32);
        let odd = stratum % 2 == 1;
        let sign = if odd { -1.0 } else { 1.0 };
        connect(world, emitters, gate, (d, sign), scratch, pixel);
        if odd {
            scratch.unit.finish(pixel);
        }
    }
    overflow.take(&mut scratch.unit, count);
    count
}

fn connect(
    world: &World,
    emitters: &Emitters,
    gate: &Gate,
    (d, sign): (Vec3, f32),
    scratch: &mut Scratch,
    pixel: &mut Pixel,
) {
    let Scratch {
        stack,
        weights,
        unit,
    } = scratch;
    let Some(h) = world.closest(stack, Vec3::ZERO, d) else {
        return;
    };
    if h.surface.strength == 0.0 {
        return;
    }
    let range = h.p.length();
    emitters.weights(h.p, h.n, -h.p / range, &h.surface, weights);
    let to_camera = world.metres(range);
    for (e, &w) in emitters.list.iter().zip(weights.iter()) {
        if w > 0.0 && world.free(stack, h.p, h.n, e.p, e.n) {
            let path = e.path_m + world.metres((e.p - h.p).length()) + to_camera;
            unit.add(gate, path, w, sign, pixel);
        }
    }
}
