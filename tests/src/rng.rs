//! Reproducible random numbers, for choosing the instants of kills.

use picofarm_settings::random::SplitMix64;

/// A stream of random numbers.
pub struct Rng(SplitMix64);

impl Rng {
    /// Creates the stream of `seed`.
    pub fn new(seed: u64) -> Self {
        Self(SplitMix64(seed))
    }

    /// Returns the next number.
    pub fn number(&mut self) -> u64 {
        self.0.bits()
    }

    /// Returns a number in [0, 1).
    pub fn unit(&mut self) -> f64 {
        self.0.uniform()
    }
}
