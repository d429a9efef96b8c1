//! The companion image: the view of a colour camera under a soft ceiling light. It is not
//! radiometric, but shows the right shapes, colours, shadows and reflections, from few rays.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::{
    api::{RenderError, Stop},
    numeric::{
        frame::frame,
        rng::{Rng, Stream},
    },
    scene::{bvh::tree::Stack, intersection::lift, world::World},
};

/// Sub-pixel samples per side.
const SIDE: u32 = 3;

/// The maximum number of mirror reflections that are followed.
const REFLECTIONS: u32 = 2;

/// The minimum distance from the camera used to place the lamp, render units, because squares of
/// much smaller lengths underflow.
const NEAREST: f32 = 1e-9;

/// A disc of light below the ceiling and parallel to it, so that no part of it extends above the
/// ceiling.
struct Lamp {
    centre: Vec3,
    /// Unit vectors that span the disc's plane.
    plane: (Vec3, Vec3),
    radius: f32,
    /// Distance at which a surface facing the lamp receives full light.
    reach: f32,
}

/// Returns linear RGB in [0, 1], `[row][col][3]`, and the number of rays traced.
pub(crate) fn photo(world: &World, seed: u64, stop: Stop) -> Result<(Vec<f32>, u64), RenderError> {
    let i = world.camera.intrinsics;
    let (width, height) = (i.width as usize, i.height as usize);
    let mut rgb = vec![0.0f32; 3 * width * height];
    let lamp = lamp(world);
    let rays = rgb
        .par_chunks_mut(3 * width)
        .enumerate()
        .map(|(row, out)| match stop.asked() {
            true => 0,
            false => draw(world, &lamp, (row, seed), out),
        })
        .sum();
    stop.check()?;
    Ok((rgb, rays))
}

/// Returns the approximate number of rays of the image, from every `step`-th row.
pub(crate) fn rays(world: &World, seed: u64, step: usize) -> u64 {
    let i = world.camera.intrinsics;
    let lamp = lamp(world);
    let rows: Vec<usize> = (0..i.height as usize).step_by(step).collect();
    let some: u64 = rows
        .into_par_iter()
        .map(|row| {
            draw(
                world,
                &lamp,
                (row, seed),
                &mut vec![0.0; 3 * i.width as usize],
            )
        })
        .sum();
    some * step as u64
}

/// Draws a row and returns the number of rays traced.
fn draw(world: &World, lamp: &Lamp, (row, seed): (usize, u64), out: &mut [f32]) -> u64 {
    let mut stack = world.bvh.stack();
    let width = out.len() / 3;
    for (col, pixel) in out.chunks_mut(3).enumerate() {
        let mut rng = Rng::new(seed, Stream::Photo, (row * width + col) as u64, 0);
        let mut sum = [0.0f32; 3];
        for s in 0..SIDE * SIDE {
            let (a, b) = ((s % SIDE) as f32 + 0.5, (s / SIDE) as f32 + 0.5);
            let (x, y) = (col as f32 + a / SIDE as f32, row as f32 + b / SIDE as f32);
            let d = world.camera.ray(x, y).normalized();
            let light = lamp.point(&mut rng, s);
            let c = shade(world, lamp, light, &mut stack, d);
            for k in 0..3 {
                sum[k] += c[k];
            }
        }
        for k in 0..3 {
            pixel[k] = (sum[k] / (SIDE * SIDE) as f32).clamp(0.0, 1.0);
        }
    }
    stack.rays
}

/// Places the lamp over the space in front of the camera, below any surface above that space.
fn lamp(world: &World) -> Lamp {
    let mut stack = world.bvh.stack();
    let up = -world.camera.down;
    let ahead = world
        .closest(&mut stack, Vec3::ZERO, world.camera.forward)
        .map_or(2.0, |h| h.p.length())
        .max(NEAREST);
    let under = world.camera.forward * (0.4 * ahead);
    let (above, normal) = world
        .closest(&mut stack, under, up)
        .map_or((ahead, -up), |h| ((h.p - under).length(), h.n));
    let rise = (0.75 * above).min(ahead);
    Lamp {
        centre: under + up * rise,
        plane: frame(normal),
        radius: 0.08 * ahead,
        reach: 0.45 * ahead + rise,
    }
}

impl Lamp {
    /// Returns a point of the disc for sub-pixel sample `s`, stratified in angle and radius over
    /// the samples of a pixel.
    fn point(&self, rng: &mut Rng, s: u32) -> Vec3 {
        let strata = (SIDE * SIDE) as f32;
        // A golden-angle spiral, rotated and shifted at random for each pixel's sample.
        let turn = (s as f32 * 0.618_034 + rng.uniform() / strata) * std::f32::consts::TAU;
        let r = self.radius * ((s as f32 + rng.uniform()) / strata).sqrt();
        let (t, b) = self.plane;
        self.centre + t * (r * libm::cosf(turn)) + b * (r * libm::sinf(turn))
    }
}

fn shade(world: &World, lamp: &Lamp, light: Vec3, stack: &mut Stack, d: Vec3) -> [f32; 3] {
    let (mut from, mut d, mut tint) = (Vec3::ZERO, d, [1.0f32; 3]);
    for reflection in 0..=REFLECTIONS {
        let Some(h) = world.closest(stack, from, d) else {
            return tint.map(|t| 0.6 * t);
        };
        let albedo = world.albedo(&h);
        let glass = world.tint(stack, from, lift(h.p, h.n));
        for k in 0..3 {
            tint[k] *= albedo[k] * glass[k];
        }
        if h.surface.specular() && reflection < REFLECTIONS {
            d = (d - h.n * (2.0 * h.n.dot(d))).normalized();
            from = lift(h.p, h.n);
            continue;
        }
        let to = light - h.p;
        let far = to.length();
        let cos = h.n.dot(to) / far;
        let direct = if far > 0.0 && cos > 0.0 {
            let near = lamp.reach * lamp.reach / (to.dot(to) + 0.25 * lamp.reach * lamp.reach);
            0.8 * cos * near * world.free(stack, h.p, h.n, light, Vec3::ZERO)
        } else {
            0.0
        };
        // A sky-like fill light keeps shadows readable.
        let fill = 0.22 + 0.08 * h.n.dot(-world.camera.down);
        return tint.map(|t| t * (direct + fill));
    }
    [0.0; 3]
}
