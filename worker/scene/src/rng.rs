//! The generators' random numbers: PCG-XSH-RR 64/32, seeded through SplitMix64.
//!
//! It is implemented here because the same seed must always give the same scene: no dependency may
//! change the stream, and every derived number uses only integer or IEEE arithmetic.

use picofarm_settings::random::{GOLDEN, mix};

/// A stream of random numbers (O'Neill 2014, PCG-XSH-RR 64/32).
#[derive(Debug, Clone)]
pub(crate) struct Rng {
    state: u64,
    increment: u64,
}

/// Spreads neighbouring seeds far apart.
fn spread(seed: u64) -> u64 {
    mix(seed.wrapping_add(GOLDEN))
}

impl Rng {
    /// Returns stream number `stream` of `seed`; different pairs give unrelated streams.
    pub(crate) fn new(seed: u64, stream: u64) -> Self {
        let mut rng = Self {
            state: spread(seed ^ spread(stream)),
            increment: (spread(stream.wrapping_add(seed.rotate_left(32))) << 1) | 1,
        };
        rng.next_u32();
        rng
    }

    /// Returns 32 uniform bits.
    pub(crate) fn next_u32(&mut self) -> u32 {
        let old = self.state;
        self.state = old
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(self.increment);
        let xorshifted = (((old >> 18) ^ old) >> 27) as u32;
        xorshifted.rotate_right((old >> 59) as u32)
    }

    /// Returns a uniform number in [0, 1), a multiple of 2⁻²⁴.
    pub(crate) fn unit(&mut self) -> f32 {
        (self.next_u32() >> 8) as f32 * (1.0 / 16_777_216.0)
    }

    /// Returns a uniform number in [lo, hi).
    pub(crate) fn range(&mut self, lo: f32, hi: f32) -> f32 {
        lo + (hi - lo) * self.unit()
    }

    /// Returns a uniform integer in 0..n by multiply and shift; `n` must be positive. The bias is
    /// below n/2³².
    pub(crate) fn below(&mut self, n: usize) -> usize {
        debug_assert!(n > 0, "a choice needs at least one option");
        ((u64::from(self.next_u32()) * n as u64) >> 32) as usize
    }

    /// Returns one of `options`, which must not be empty.
    pub(crate) fn pick<'a, T>(&mut self, options: &'a [T]) -> &'a T {
        &options[self.below(options.len())]
    }

    /// Returns true with probability `p`.
    pub(crate) fn chance(&mut self, p: f32) -> bool {
        self.unit() < p
    }
}

#[cfg(test)]
mod tests {
    use super::Rng;

    #[test]
    fn the_stream_never_changes() {
        let mut rng = Rng::new(7, 3);
        let first: Vec<u32> = (0..4).map(|_| rng.next_u32()).collect();
        insta::assert_debug_snapshot!(first);
    }

    #[test]
    fn streams_and_seeds_differ_and_ranges_hold() {
        let (mut a, mut b, mut c) = (Rng::new(1, 0), Rng::new(1, 1), Rng::new(2, 0));
        let (x, y, z) = (a.next_u32(), b.next_u32(), c.next_u32());
        assert!(x != y && x != z && y != z);
        let mut mean = 0.0;
        for _ in 0..10_000 {
            let v = a.range(-1.0, 3.0);
            assert!((-1.0..3.0).contains(&v) && a.below(5) < 5);
            mean += v / 10_000.0;
        }
        assert!((mean - 1.0).abs() < 0.05, "{mean}");
    }
}
