//! Floats rounded to a share of the photon noise, so that they compress well. The stored values are
//! h itself and need no decoding formula.

use crate::coding::squareroot::ErrorSums;

/// Rounds h to a multiple of the largest power of two with an error within a share of σ =
/// √max(N, 1), N = h·scale photons.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rounding {
    /// Twice the share, in units of h.
    width: f32,
    scale: f32,
}

impl Rounding {
    /// Rounds to `share` of σ, at `scale` photons per unit of h.
    pub fn new(share: f32, scale: f32) -> Self {
        let width = 2.0 * share / scale;
        Self { width, scale }
    }

    fn round(self, h: f32) -> f32 {
        let sigma = (h * self.scale).max(1.0).sqrt();
        // Only the exponent remains: a power of two, so division by it is exact.
        let step = f32::from_bits((sigma * self.width).to_bits() & 0x7f80_0000);
        if !step.is_normal() {
            return h;
        }
        let rounded = (h / step).round_ties_even() * step;
        if rounded.is_finite() { rounded } else { h }
    }

    /// Rounds the valid values `h` into `to`, and adds the errors to `error`.
    pub fn run(self, h: &[f32], to: &mut [f32], error: &mut ErrorSums) {
        for (h, to) in h.iter().zip(to) {
            *to = self.round(*h);
            error.add_value(h * self.scale, *to * self.scale);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_stays_within_its_share_of_sigma() {
        for scale in [1.0f32, 6.1e4, 3e-5] {
            let rounding = Rounding::new(0.25, scale);
            for k in 0..100_000 {
                let n = libm::expf(k as f32 * 3e-4 - 5.0);
                let h = n / scale;
                let r = rounding.round(h);
                let error = (f64::from(r) - f64::from(h)).abs() * f64::from(scale);
                let sigma = (f64::from(h) * f64::from(scale)).max(1.0).sqrt();
                assert!(error <= 0.250_001 * sigma, "{n} photons: {error}");
            }
        }
        for h in [0.0, f32::MIN_POSITIVE, 1e-44, f32::MAX] {
            assert!(Rounding::new(0.25, 1.0).round(h).is_finite());
            assert!(Rounding::new(0.25, f32::MIN_POSITIVE).round(h).is_finite());
            assert!(Rounding::new(0.25, 1e38).round(h).is_finite());
        }
    }
}
