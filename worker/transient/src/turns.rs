//! Evenly spread draws of choices and directions.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    bsdf::{Surface, frame},
    rng::{Rng, Stream},
};

/// Evenly spread draws: choices in strict turn, directions by the R₂ sequence (Roberts 2018), both from
/// a random start. What neighbours have in common then varies less from pass to pass.
pub(crate) struct Turns {
    count: f32,
    start: f32,
    at: (u32, u32),
}

/// Point `k` of the R₂ sequence (Roberts 2018) in the unit square, from a start in units of 2⁻³².
#[inline]
fn r2(start: (u32, u32), k: u64) -> (f32, f32) {
    // 1/g and 1/g² in units of 2⁻⁶⁴, g³ = g + 1.
    const STEPS: (u64, u64) = (0xc13f_a9a9_02a6_328f, 0x91e1_0da5_c79e_7b1d);
    let turn = |start: u32, step: u64| {
        let at = (u64::from(start) << 32).wrapping_add(k.wrapping_mul(step));
        (at >> 40) as f32 * (1.0 / 16_777_216.0)
    };
    (turn(start.0, STEPS.0), turn(start.1, STEPS.1))
}

/// Where in a pixel its camera path `k` begins, over all passes: spread evenly, as much of the light in a bin depends on it.
#[inline]
pub(crate) fn place(seed: u64, pixel: u64, k: u64) -> (f32, f32) {
    let mut rng = Rng::new(seed, Stream::Place, pixel, 0);
    r2((rng.next_u32(), rng.next_u32()), k)
}

impl Turns {
    pub fn new(count: u32, rng: &mut Rng) -> Self {
        Self {
            count: count as f32,
            start: rng.uniform(),
            at: (rng.next_u32(), rng.next_u32()),
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::place;

    proptest! {
        #[test]
        fn places_of_a_pixel_are_spread_evenly_from_any_pass_on(
            seed in any::<u64>(), pixel in 0u64..1 << 24, first in 0u64..1 << 40,
        ) {
            const COUNT: u64 = 256;
            let mut cells = [[0u32; 4]; 4];
            let (mut rows, mut columns) = ([0i32; 16], [0i32; 16]);
            for k in first..first + COUNT {
                let (x, y) = place(seed, pixel, k);
                prop_assert!((0.0..1.0).contains(&x) && (0.0..1.0).contains(&y));
                cells[(4.0 * y) as usize][(4.0 * x) as usize] += 1;
                rows[(16.0 * y) as usize] += 1;
                columns[(16.0 * x) as usize] += 1;
            }
            // Sixteen each. Random numbers would be off by more than three in a third of the 32 rows and columns.
            prop_assert!(cells.as_flattened().iter().all(|c| (11..=22).contains(c)), "{cells:?}");
            prop_assert!(rows.iter().chain(&columns).all(|c| (c - 16).abs() <= 3), "{rows:?} {columns:?}");
        }
    }

    #[test]
    fn pixels_and_seeds_begin_elsewhere() {
        let all = [(1, 0), (1, 1), (2, 0)].map(|(seed, pixel)| place(seed, pixel, 0));
        assert!(all[0] != all[1] && all[0] != all[2] && all[1] != all[2]);
    }
}
