//! Evenly spread draws of choices and directions.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    numeric::{frame::frame, low_discrepancy::r2, rng::Rng},
    scene::surface::{ScatterSample, Surface},
};

/// Evenly spread draws: choices in strict turn, directions by the R₂ sequence (Roberts 2018), both
/// from a random start. The contribution shared by neighbouring pixels then varies less from pass
/// to pass.
pub(crate) struct EvenDraws {
    count: f32,
    start: f32,
    r2_start: (u32, u32),
}

impl EvenDraws {
    pub fn new(count: u32, rng: &mut Rng) -> Self {
        Self {
            count: count as f32,
            start: rng.uniform(),
            r2_start: (rng.next_u32(), rng.next_u32()),
        }
    }

    /// Returns the number of draws.
    pub fn count(&self) -> f32 {
        self.count
    }

    /// Returns which of `among` choices draw `j` takes.
    pub fn choice(&self, j: u32, among: usize) -> usize {
        let position = j as f32 / self.count + self.start;
        (((position - position.floor()) * among as f32) as usize).min(among - 1)
    }

    /// Returns the direction of draw `j`, in the form of [`Surface::sample`].
    pub fn direction(
        &self,
        j: u32,
        surface: &Surface,
        n: Vec3,
        wo: Vec3,
        rng: &mut Rng,
    ) -> Option<ScatterSample> {
        if !surface.diffuse() {
            return surface.sample(n, wo, rng);
        }
        let (u, v) = r2(self.r2_start, u64::from(j));
        // Cosine-distributed: uniform on the disc beneath (Malley's method).
        let angle = std::f32::consts::TAU * v;
        let (r, z) = (u.sqrt(), (1.0 - u).max(0.0).sqrt());
        let (t, b) = frame(n);
        let w = t * (r * libm::cosf(angle)) + b * (r * libm::sinf(angle)) + n * z;
        let w = w.normalized();
        let c = n.dot(w);
        (c > 0.0).then_some(ScatterSample {
            w,
            weight: surface.lambertian() * PI,
            pdf: c / PI,
        })
    }
}
