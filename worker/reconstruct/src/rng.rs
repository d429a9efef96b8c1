//! Random numbers that depend on what they are drawn for and never on who draws them: SplitMix64 (Steele et al. 2014) of
//! (seed, stream, index).

/// What a number is drawn for.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Stream {
    /// Candidates of planes.
    Planes = 1,
    /// Rays of an iteration and their offsets.
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
    /// The generator of (seed, stream, index).
    pub fn new(seed: u64, stream: Stream, index: u64) -> Self {
        Self(mix(mix(mix(seed) ^ (stream as u64)) ^ index))
    }

    /// 64 uniform bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix(self.0)
    }

    /// Uniform in [0, 1), a multiple of 2⁻²⁴.
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 * (1.0 / 16_777_216.0)
    }

    /// Uniform in 0..n; 0 where n is 0.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.bits()) * n as u128) >> 64) as usize
    }

    /// Standard normal (Box and Muller 1958).
    pub fn normal(&mut self) -> f32 {
        let radius = libm::sqrtf(-2.0 * libm::logf(self.unit().max(1e-7)));
        radius * libm::cosf(std::f32::consts::TAU * self.unit())
    }
}
