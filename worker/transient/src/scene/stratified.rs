//! Evenly spread draws of choices and directions.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    numeric::{frame::frame, low_discrepancy::r2, rng::Rng},
    scene::surface::Surface,
};

/// Evenly spread draws: choices in strict turn, directions by the R₂ sequence (Roberts 2018), both
/// from a random start. The contribution shared by neighbouring pixels then varies less from pass
/// to pass.
pub(crate) struct Turns {
    count: f32,
    start: f32,
    at: (u32, u32),
}

impl Turns {
    pub fn new(count: u32, rng: &mut Rng) -> Self {
        Self {
            count: count as f32,
            start: rng.uniform(),
            at: (rng.next_u32(), rng.next_u32()),
        }
    }

    /// Returns the number of draws.
    pub fn count(&self) -> f32 {
        self.count
    }

    /// Returns which of `among` choices draw `j` takes.
    pub fn choice(&self, j: u32, among: usize) -> usize {
        let at = j as f32 / self.count + self.start;
        (((at - at.floor()) * among as f32) as usize).min(among - 1)
    }

    /// Returns the direction of draw `j`, in the form of [`Surface::sample`].
    pub fn direction(
        &self,
        j: u32,
        surface: &Surface,
        n: Vec3,
        wo: Vec3,
        rng: &mut Rng,
    ) -> Option<(Vec3, f32, f32)> {
        if !surface.diffuse() {
            return surface.sample(n, wo, rng);
        }
        let (u, v) = r2(self.at, u64::from(j));
        // Cosine-distributed: uniform on the disc beneath (Malley's method).
        let angle = std::f32::consts::TAU * v;
        let (r, z) = (u.sqrt(), (1.0 - u).max(0.0).sqrt());
        let (t, b) = frame(n);
        let w = t * (r * libm::cosf(angle)) + b * (r * libm::sinf(angle)) + n * z;
        let w = w.normalized();
        let c = n.dot(w);
        (c > 0.0).then_some((w, surface.lambertian() * PI, c / PI))
    }
}
