//! Random numbers that depend only on their purpose, not on the thread that draws them: those
//! of (seed, stream, index).

use picofarm_settings::random::{SplitMix64, mix};

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
pub(crate) struct Rng(SplitMix64);

impl Rng {
    /// Returns the generator of (seed, stream, index).
    pub fn new(seed: u64, stream: Stream, index: u64) -> Self {
        Self(SplitMix64(mix(mix(mix(seed) ^ (stream as u64)) ^ index)))
    }

    /// Returns a uniform number in [0, 1), a multiple of 2⁻²⁴.
    pub fn unit(&mut self) -> f32 {
        self.0.unit()
    }

    /// Returns a uniform integer in 0..n, or 0 if n is 0.
    pub fn below(&mut self, n: usize) -> usize {
        self.0.below(n as u64) as usize
    }

    /// Returns a standard normal number (Box and Muller 1958).
    pub fn normal(&mut self) -> f32 {
        let radius = libm::sqrtf(-2.0 * libm::logf(self.unit().max(1e-7)));
        radius * libm::cosf(std::f32::consts::TAU * self.unit())
    }
}
