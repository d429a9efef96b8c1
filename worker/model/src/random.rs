//! Random numbers that depend only on a seed and a stream. They are the same on every machine, in
//! every order and for any number of threads.

use picofarm_settings::random::{GOLDEN, SplitMix64, mix};

/// The random numbers of a seed and a stream: one sequence for each pair.
#[derive(Debug, Clone)]
pub struct Random(SplitMix64);

impl Random {
    /// Returns the sequence of a stream of a seed.
    pub fn new(seed: u64, stream: &[u64]) -> Self {
        let mut state = mix(seed ^ GOLDEN);
        for part in stream {
            state = mix(state ^ mix(part.wrapping_add(0xD1B5_4A32_D192_ED03)));
        }
        Self(SplitMix64(state))
    }

    /// Returns 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0.bits()
    }

    /// Returns a uniform integer in 0..n; n must be positive.
    pub fn below(&mut self, n: u64) -> u64 {
        self.0.below(n)
    }

    /// Returns a uniform number in [0, 1) with 24 bits.
    pub fn unit(&mut self) -> f32 {
        self.0.unit()
    }

    /// Returns a normal number with mean 0 and variance 1 (Box and Muller 1958). It has the same
    /// bits on every machine.
    pub fn normal(&mut self) -> f32 {
        // In (0, 1], so that its logarithm is finite.
        let open = 1.0 - f64::from(self.unit());
        let angle = std::f64::consts::TAU * f64::from(self.unit());
        (libm::sqrt(-2.0 * libm::log(open)) * libm::cos(angle)) as f32
    }

    /// Returns a permutation of 0..n (Fisher and Yates).
    pub fn permutation(&mut self, n: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..n).collect();
        for i in (1..n).rev() {
            order.swap(i, self.below(i as u64 + 1) as usize);
        }
        order
    }
}
