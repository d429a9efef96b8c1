//! Random numbers that depend only on a seed and a stream. They are the same on every machine, in
//! every order and for any number of threads.

/// SplitMix64 over a seed and a stream (Steele, Lea, Flood 2014): one sequence for each pair.
#[derive(Debug, Clone)]
pub struct Random(u64);

impl Random {
    /// Returns the sequence of a stream of a seed.
    pub fn new(seed: u64, stream: &[u64]) -> Self {
        let mut state = mix(seed ^ 0x9E37_79B9_7F4A_7C15);
        for part in stream {
            state = mix(state ^ mix(part.wrapping_add(0xD1B5_4A32_D192_ED03)));
        }
        Self(state)
    }

    /// Returns 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        mix(self.0)
    }

    /// Returns a uniform integer in 0..n; n must be positive.
    pub fn below(&mut self, n: u64) -> u64 {
        // Multiply-shift; the bias is below n / 2^64.
        ((u128::from(self.bits()) * u128::from(n)) >> 64) as u64
    }

    /// Returns a uniform number in [0, 1) with 24 bits.
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1u64 << 24) as f32
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

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}
