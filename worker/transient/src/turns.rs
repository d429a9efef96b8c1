//! Evenly spread draws of choices and directions.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    bsdf::{Surface, frame},
    rng::Rng,
};

/// Evenly spread draws: choices in strict turn, directions by the R₂ sequence (Roberts 2018), both from
/// a random start. What neighbours have in common then varies less from pass to pass.
pub(crate) struct Turns {
    count: f32,
    start: f32,
    u: f32,
    v: f32,
}

impl Turns {
    pub fn new(count: u32, rng: &mut Rng) -> Self {
        Self {
            count: count as f32,
            start: rng.uniform(),
            u: rng.uniform(),
            v: rng.uniform(),
        }
    }

    /// How many draws there are.
    pub fn count(&self) -> f32 {
        self.count
    }

    /// Which of `among` draw `j` is for.
    pub fn choice(&self, j: u32, among: usize) -> usize {
        let at = j as f32 / self.count + self.start;
        (((at - at.floor()) * among as f32) as usize).min(among - 1)
    }

    /// The direction of draw `j`, as [`Surface::sample`] gives it.
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
        let turn = |start: f32, step: f64| {
            let at = f64::from(start) + f64::from(j) * step;
            (at - at.floor()) as f32
        };
        let (u, v) = (
            turn(self.u, 0.754_877_666_246_69),
            turn(self.v, 0.569_840_290_998_05),
        );
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
