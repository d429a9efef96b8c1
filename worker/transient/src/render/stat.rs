//! Sums of a pixel for the error estimate.

use serde::{Deserialize, Serialize};

/// A pixel's sums for the error estimate.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Stat {
    /// Σ over bins of h².
    pub norm2: f64,
    /// Σ over bins of the two-bounce part's variance.
    pub two_variance: f64,
    /// Σ over bins of the 3+ part's variance.
    pub multi_variance: f64,
    /// Σ over bins of h.
    pub total: f64,
}

impl Stat {
    /// Returns ‖standard error‖ / ‖h‖, or `None` for a pixel without light.
    pub fn error(&self) -> Option<f64> {
        relative(self.norm2, self.two_variance + self.multi_variance)
    }
}

/// Returns ‖standard error‖ / ‖h‖ of a pixel, or `None` for a pixel without light. The measured
/// ‖h‖² contains the variance, so the variance is subtracted, down to a tenth.
pub(crate) fn relative(norm2: f64, variance: f64) -> Option<f64> {
    let clean = (norm2 - variance).max(0.1 * norm2);
    (norm2 > 0.0).then(|| (variance / clean).sqrt())
}

pub(crate) fn quantile(sorted: &[f64], q: f64) -> f64 {
    match sorted.len() {
        0 => 0.0,
        n => sorted[((n - 1) as f64 * q).round() as usize],
    }
}

pub(crate) fn sorted(stats: impl Iterator<Item = Stat>) -> Vec<f64> {
    let mut all: Vec<f64> = stats.filter_map(|s| s.error()).collect();
    all.sort_by(f64::total_cmp);
    all
}

/// Returns the median of the pixels' relative standard errors.
pub(crate) fn relative_median(stats: impl Iterator<Item = Stat>) -> f64 {
    quantile(&sorted(stats), 0.5)
}
