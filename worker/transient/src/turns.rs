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

/// Where in a pixel its camera path `k` begins, over all passes: spread evenly, as much of the light in a bin depends on it. Points of
/// Sobol's sequence, whose digits each pixel scrambles by itself (Owen 1995, by the hash of Burley, JCGT 2020). The steps of an R₂
/// sequence are all alike: where what a pixel sees repeats itself seven times along it, each began where the last one had, and passes
/// that agree for that reason state an error that is a seventh of the true one. Scrambled points do no worse than random ones
/// whatever is seen.
#[inline]
pub(crate) fn place(seed: u64, pixel: u64, k: u64) -> (f32, f32) {
    let mut rng = Rng::new(seed, Stream::Place, pixel, 0);
    // Casting cuts: the sequence begins again after 2³² paths.
    let k = k as u32;
    let x = scrambled(k.reverse_bits(), rng.next_u32());
    let y = scrambled(sobol(k), rng.next_u32());
    let unit = |x: u32| (x >> 8) as f32 * (1.0 / 16_777_216.0);
    (unit(x), unit(y))
}

/// The second dimension of Sobol's sequence; the first is the index with its bits reversed.
#[inline]
fn sobol(mut k: u32) -> u32 {
    let (mut x, mut column) = (0, 1u32 << 31);
    while k != 0 {
        if k & 1 == 1 {
            x ^= column;
        }
        column ^= column >> 1;
        k >>= 1;
    }
    x
}

/// Flips each binary digit, or not, by a hash of those before it.
#[inline]
fn scrambled(x: u32, seed: u32) -> u32 {
    let mut x = x.reverse_bits().wrapping_add(seed);
    for factor in [0x6c50_b47c, 0xb82f_1e52, 0xc7af_e638, 0x8d22_f6e6] {
        x ^= x.wrapping_mul(factor);
    }
    x.reverse_bits()
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

    /// Variance of the mean over passes of what pixels see, over what passes that are compared with each other state for it.
    fn true_over_stated(passes: u64, sees: impl Fn((f32, f32), (f32, f32)) -> f32) -> f64 {
        const PIXELS: u64 = 1000;
        let (mut found, mut stated) = (0.0, 0.0);
        for pixel in 0..PIXELS {
            let phase = place(77, pixel, 0);
            let see = |at| f64::from(sees(at, phase));
            let each: Vec<f64> = (0..passes).map(|k| see(place(1, pixel, k))).collect();
            let n = passes as f64;
            let mean = each.iter().sum::<f64>() / n;
            let square = each.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
            stated += square / (n * (n - 1.0));
            let grid = |i: u64| (i as f32 + 0.5) / 64.0;
            let all = (0..64).flat_map(|i| (0..64).map(move |j| see((grid(i), grid(j)))));
            found += (mean - all.sum::<f64>() / 4096.0).powi(2);
        }
        found / stated
    }

    #[test]
    fn passes_over_stripes_and_squares_of_any_width_state_no_less_than_their_error() {
        let odd = |x: f32| x.rem_euclid(2.0) >= 1.0;
        for times in [3.0f32, 4.0, 6.0, 7.0] {
            for passes in [2, 4, 8, 13] {
                let stripes = true_over_stated(passes, |at, phase| {
                    f32::from(odd(2.0 * (at.1 * times + phase.1)))
                });
                let squares = true_over_stated(passes, |at, phase| {
                    let (x, y) = (at.0 * times + phase.0, at.1 * times + phase.1);
                    f32::from(odd(2.0 * x) != odd(2.0 * y))
                });
                println!("{times} times, {passes} passes: {stripes:.2} {squares:.2}");
                // With the R₂ sequence stripes came to 40 to 50 at seven times, squares to 2 to 3 at three.
                assert!(
                    stripes < 2.5 && squares < 2.5,
                    "{times} times, {passes} passes"
                );
            }
        }
    }

    #[test]
    fn pixels_and_seeds_begin_elsewhere() {
        let all = [(1, 0), (1, 1), (2, 0)].map(|(seed, pixel)| place(seed, pixel, 0));
        assert!(all[0] != all[1] && all[0] != all[2] && all[1] != all[2]);
    }
}
