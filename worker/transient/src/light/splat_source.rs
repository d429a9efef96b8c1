//! Light that is drawn into the image outside the tiles. Light paths cross tiles, so they are an
//! estimate separate from the tiles', with as many passes as the image.

use std::fmt::Debug;

use rayon::prelude::*;

use crate::{
    film::{pass_fraction::PassFraction, slots::Film, splat::Splat},
    light::light_context::LightContext,
    scene::bvh::tree::Stack,
};

/// Light paths, or pixels of camera paths, per random stream.
pub(crate) const CHUNK: u32 = 1024;

/// A technique that draws into the image outside the tiles.
pub(crate) trait SplatSource: Debug + Sync {
    /// Adds the contributions of a pass to `out`. Returns the number of rays traced.
    fn splats(&self, pass: &SplatPass<'_>, out: &mut Vec<Splat>) -> u64;

    /// Adds what the technique finds, and what it approximates, to the plan in words.
    fn describe(&self, _strategies: &mut Vec<String>, _approximations: &mut Vec<String>) {}
}

/// A pass over the image.
#[derive(Clone, Copy)]
pub(crate) struct SplatPass<'a> {
    pub context: LightContext<'a>,
    pub film: &'a Film,
    pub seed: u64,
    /// Size of the image, pixels.
    pub width: u32,
    pub height: u32,
    /// Number of the pass.
    pub pass: u32,
    pub fraction: PassFraction<'a>,
    /// Returns false if the render must stop.
    pub go_on: &'a (dyn Fn() -> bool + Sync),
}

impl SplatPass<'_> {
    /// Returns the number of light paths, for `per_pixel` of them in a whole pass.
    pub fn light_paths(&self, per_pixel: f64) -> u32 {
        let pixels = f64::from(self.width) * f64::from(self.height);
        let count = self.fraction.share() * pixels * per_pixel;
        count.clamp(f64::from(CHUNK), f64::from(1 << 22)) as u32
    }

    /// Runs `count` pieces of the pass on all threads and joins the results in order. Returns the
    /// number of rays traced.
    pub fn side_by_side(
        &self,
        count: u32,
        out: &mut Vec<Splat>,
        piece: impl Fn(&mut Stack, u32, &mut Vec<Splat>) + Sync,
    ) -> u64 {
        let stack = || self.context.world.bvh.stack();
        let piece = |stack: &mut Stack, k, splats: &mut Vec<Splat>| {
            let before = stack.rays;
            piece(stack, k, splats);
            stack.rays - before
        };
        joined(self.pieces(count, stack, piece), out)
    }

    /// Runs `count` pieces of the pass on all threads. Returns the results in order, each with the
    /// number of rays traced.
    pub fn pieces<B, T: Default + Send>(
        &self,
        count: u32,
        buffers: impl Fn() -> B + Sync + Send,
        piece: impl Fn(&mut B, u32, &mut T) -> u64 + Sync,
    ) -> Vec<(T, u64)> {
        let each = (0..count).into_par_iter();
        each.map_init(buffers, |buffers, k| {
            let mut found = T::default();
            let rays = match (self.go_on)() {
                true => piece(buffers, k, &mut found),
                false => 0,
            };
            (found, rays)
        })
        .collect()
    }
}

/// Joins the results and returns the number of rays traced.
pub(crate) fn joined(found: Vec<(Vec<Splat>, u64)>, out: &mut Vec<Splat>) -> u64 {
    let rays = found.iter().map(|f| f.1).sum();
    out.extend(found.into_iter().flat_map(|f| f.0));
    rays
}
