//! Random numbers: PCG-XSH-RR 64/32 (O'Neill 2014), seeded by SplitMix64 from (seed, stream,
//! index), so that a number depends on its purpose and never on the thread that draws it.

use picofarm_settings::random::{GOLDEN, mix};

/// A small, fast generator of one stream.
#[derive(Debug, Clone)]
pub(crate) struct Rng {
    state: u64,
    increment: u64,
}

/// The purpose of a stream. Separate streams make the parts of a render independent of each other.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Stream {
    /// Sub-pixel samples of the two-bounce part.
    Two = 1,
    /// Camera paths, and the vertices that they share.
    Paths = 2,
    /// The companion image.
    Photo = 3,
    /// Offsets of the grid of tiles that share vertices.
    Grid = 4,
    /// Light paths via near-mirrors.
    Caustic = 5,
    /// Light paths in the zones of spots close to other surfaces.
    Contact = 7,
    /// Light paths via glass, and camera paths via glass.
    Glass = 8,
    ByGlass = 9,
    /// Positions in a pixel at which its camera paths begin, and those via glass.
    Place = 10,
    GlassPlace = 11,
    /// The extent that the camera and the light reach.
    Extent = 6,
}

/// Spreads neighbouring seeds far apart.
fn spread(seed: u64) -> u64 {
    mix(seed.wrapping_add(GOLDEN))
}

impl Rng {
    /// Returns the generator of pixel `pixel` in pass `pass` of `stream`.
    pub fn new(seed: u64, stream: Stream, pixel: u64, pass: u64) -> Self {
        let key = [stream as u64, pixel, pass]
            .into_iter()
            .fold(spread(seed), |key, part| {
                spread(key.rotate_left(17) ^ spread(part))
            });
        let mut rng = Self {
            state: key,
            increment: spread(key) | 1,
        };
        rng.next_u32();
        rng
    }

    #[inline(always)]
    pub fn next_u32(&mut self) -> u32 {
        let s = self.state;
        self.state = s
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(self.increment);
        let x = (((s >> 18) ^ s) >> 27) as u32;
        x.rotate_right((s >> 59) as u32)
    }

    /// Returns a uniform number in [0, 1), 24 bits.
    #[inline(always)]
    pub fn uniform(&mut self) -> f32 {
        (self.next_u32() >> 8) as f32 * (1.0 / 16_777_216.0)
    }

    /// Returns a uniform point in the unit disc and its squared radius. Drawn by rejection: no
    /// trigonometry, so the same bits everywhere.
    #[inline(always)]
    pub fn disc(&mut self) -> (f32, f32, f32) {
        loop {
            let (x, y) = (2.0 * self.uniform() - 1.0, 2.0 * self.uniform() - 1.0);
            let r2 = x * x + y * y;
            if r2 < 1.0 {
                return (x, y, r2);
            }
        }
    }

    /// Returns a uniform direction on the unit circle.
    #[inline(always)]
    pub fn circle(&mut self) -> (f32, f32) {
        loop {
            let (x, y, r2) = self.disc();
            if r2 > 1e-6 {
                let k = 1.0 / r2.sqrt();
                return (x * k, y * k);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_pixels_and_passes_differ_and_repeat() {
        let draw = |a, b, c, d| Rng::new(a, b, c, d).next_u32();
        let all = [
            draw(1, Stream::Two, 0, 0),
            draw(2, Stream::Two, 0, 0),
            draw(1, Stream::Paths, 0, 0),
            draw(1, Stream::Two, 1, 0),
            draw(1, Stream::Two, 0, 1),
        ];
        for i in 0..all.len() {
            for j in 0..i {
                assert_ne!(all[i], all[j]);
            }
        }
        assert_eq!(all[0], draw(1, Stream::Two, 0, 0));
    }

    #[test]
    fn uniform_numbers_have_the_right_moments() {
        let mut rng = Rng::new(7, Stream::Paths, 3, 5);
        let n = 100_000;
        let (mut m, mut v) = (0.0f64, 0.0f64);
        for _ in 0..n {
            let x = f64::from(rng.uniform());
            assert!((0.0..1.0).contains(&x));
            m += x;
            v += x * x;
        }
        let (m, v) = (m / f64::from(n), v / f64::from(n));
        assert!((m - 0.5).abs() < 0.004 && (v - 1.0 / 3.0).abs() < 0.004);
    }
}
