//! Random numbers that depend only on their purpose, not on the thread that draws them: SplitMix64
//! (Steele et al. 2014) of (seed, stream, index).

/// The purpose of a random number.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Stream {
    /// Candidates for planes.
    Planes = 1,
    /// The rays of an iteration and their offsets.
    Rays = 2,
    /// Noise on given times.
    Noise = 3,
    /// Points on surfaces.
    Surface = 4,
}

/// A generator of one stream.
#[derive(Debug, Clone)]
pub(crate) struct Rng(u64);

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

impl Rng {
    /// Returns the generator of (seed, stream, index).
    pub fn new(seed: u64, stream: Stream, index: u64) -> Self {
        Self(mix(mix(mix(seed) ^ (stream as u64)) ^ index))
    }

    /// Returns 64 uniform bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix(self.0)
    }

    /// Returns a uniform number in [0, 1), a multiple of 2⁻²⁴.
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 * (1.0 / 16_777_216.0)
    }

    /// Returns a uniform integer in 0..n, or 0 if n is 0.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.bits()) * n as u128) >> 64) as usize
    }

    /// Returns a standard normal number (Box and Muller 1958).
    pub fn normal(&mut self) -> f32 {
        let radius = libm::sqrtf(-2.0 * libm::logf(self.unit().max(1e-7)));
        radius * libm::cosf(std::f32::consts::TAU * self.unit())
    }
}
