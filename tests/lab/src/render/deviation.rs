//! Errors of a render against a converged one. The noise of the converged render is known and
//! subtracted in quadrature.

use serde::Serialize;

/// A converged reference. One-bounce peaks are left out.
pub struct Truth {
    pub bins: usize,
    /// `[row][column][bin]`.
    pub value: Vec<f32>,
    /// Its own expected squared error, summed over the bins of each pixel.
    pub noise: Vec<f64>,
    /// Description of its origin.
    pub source: String,
}

/// Errors of a render against the reference.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Deviation {
    /// Median over pixels of |h - r| / |r|, norms over the bins.
    pub median: f64,
    /// |h - r| / |r| over all bins of all pixels.
    pub rmse: f64,
    /// Sum of h / sum of r.
    pub energy_ratio: f64,
}

impl Truth {
    /// Returns the median over pixels of the reference's own relative noise.
    pub fn median_noise(&self) -> f64 {
        let relative = self
            .value
            .chunks_exact(self.bins)
            .zip(&self.noise)
            .filter_map(|(r, n)| share(*n, square(r)));
        median(relative.collect())
    }

    /// Returns the errors of `h`.
    pub fn deviation(&self, h: &[f32]) -> Deviation {
        let (mut all, mut of) = (0.0, 0.0);
        let mut each = Vec::with_capacity(self.noise.len());
        let pixels = h
            .chunks_exact(self.bins)
            .zip(self.value.chunks_exact(self.bins));
        for ((h, r), noise) in pixels.zip(&self.noise) {
            let distance: f64 = h
                .iter()
                .zip(r)
                .map(|(&h, &r)| (f64::from(h) - f64::from(r)).powi(2))
                .sum();
            let norm = square(r);
            all += distance - noise;
            of += norm;
            each.extend(share((distance - noise).max(0.0), norm));
        }
        let sum = |values: &[f32]| values.iter().map(|&v| f64::from(v)).sum::<f64>();
        Deviation {
            median: median(each),
            rmse: share(all.max(0.0), of).unwrap_or(0.0),
            energy_ratio: sum(h) / sum(&self.value),
        }
    }
}

fn square(values: &[f32]) -> f64 {
    values.iter().map(|&v| f64::from(v).powi(2)).sum()
}

/// Returns the root of the ratio of two squares; `None` if the denominator is 0.
fn share(of: f64, whole: f64) -> Option<f64> {
    (whole > 0.0).then(|| (of / whole).sqrt())
}

/// Returns the median; 0 for no values.
fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth(value: Vec<f32>, noise: Vec<f64>) -> Truth {
        Truth {
            bins: 2,
            value,
            noise,
            source: String::new(),
        }
    }

    #[test]
    fn the_median_counts_pixels_that_hold_light() {
        let t = truth(vec![3.0, 4.0, 0.0, 0.0, 6.0, 8.0, 1.0, 0.0], vec![0.0; 4]);
        let d = t.deviation(&[3.0, 4.5, 7.0, 7.0, 6.0, 8.0, 1.5, 0.0]);
        assert!((d.median - 0.1).abs() < 1e-12, "of 0, 0.1 and 0.5: {d:?}");
        assert!((d.energy_ratio - 37.0 / 22.0).abs() < 1e-12);
    }

    #[test]
    fn the_truths_own_noise_is_taken_off() {
        let t = truth(vec![10.0, 0.0], vec![16.0]);
        let d = t.deviation(&[15.0, 0.0]);
        assert!(
            (d.median - 0.3).abs() < 1e-12,
            "root of 25 - 16, of 10: {d:?}"
        );
        assert!((d.rmse - 0.3).abs() < 1e-12);
        assert!((t.median_noise() - 0.4).abs() < 1e-12);
    }
}
