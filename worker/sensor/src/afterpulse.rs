//! Afterpulses of a pixel without dead time: expected and drawn counts.
//!
//! The time of a detection is uniform within its bin. With x = bin width / time constant, an
//! afterpulse is in the same bin with probability 1 − (1 − e^−x)/x, and j bins later with
//! probability (1 − e^−x)²/x · e^−(j−1)x.

use picofarm_settings::{Afterpulsing, Sensor};

use crate::draw::{PixelKey, binomial};

/// Afterpulses on bins of one width.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Afterpulses {
    probability: f64,
    /// Time constant, bins.
    decay: f64,
}

impl Afterpulses {
    pub fn new(sensor: &Sensor, width_ps: f64) -> Option<Self> {
        let of = |a: Afterpulsing| Self {
            probability: a.probability,
            decay: a.decay_ps / width_ps,
        };
        sensor.afterpulsing.map(of)
    }

    /// Adds the expected afterpulses to the expected detections.
    pub fn expect(&self, rate: &mut [f64]) {
        let x = 1.0 / self.decay;
        let gone = -libm::expm1(-x);
        let same = self.probability * (1.0 - gone / x);
        let next = self.probability * gone * gone / x;
        let kept = libm::exp(-x);
        // Afterpulses of earlier bins in this one.
        let mut waiting = 0.0;
        for r in rate {
            *r = (*r + waiting) / (1.0 - same);
            waiting = waiting * kept + next * *r;
        }
    }

    /// Adds drawn afterpulses to drawn counts. Those after the last bin are lost.
    pub fn draw(&self, key: PixelKey, counts: &mut [u64]) {
        // `binomial` takes −ln(1 − p).
        let rate = -libm::log1p(-self.probability);
        for bin in 0..counts.len() {
            let mut draws = key.bin(bin as u64);
            let mut fresh = counts[bin];
            while fresh > 0 {
                let made = binomial(fresh, rate, &mut draws);
                fresh = 0;
                for _ in 0..made {
                    let at = draws.uniform() - self.decay * libm::log(1.0 - draws.uniform());
                    // A cast saturates, so that a long delay stays beyond the last bin.
                    let to = bin.saturating_add(at as usize);
                    if let Some(count) = counts.get_mut(to) {
                        *count += 1;
                        fresh += u64::from(to == bin);
                    }
                }
            }
        }
    }
}
