//! From variances to error estimates, and from a pilot to a number of paths.

use super::round::{PILOT_PATHS, Stat};
use crate::api::ErrorEstimate;

/// ‖standard error‖ / ‖h‖ of a pixel; `None` for a pixel without light. The measured ‖h‖² contains the
/// variance; it is taken off, down to a tenth.
fn relative(norm2: f64, variance: f64) -> Option<f64> {
    let clean = (norm2 - variance).max(0.1 * norm2);
    (norm2 > 0.0).then(|| (variance / clean).sqrt())
}

fn quantile(sorted: &[f64], q: f64) -> f64 {
    match sorted.len() {
        0 => 0.0,
        n => sorted[((n - 1) as f64 * q).round() as usize],
    }
}

/// The estimate for a whole image after `samples` paths a pixel.
pub(super) fn estimate(stats: &[Stat], samples: u32) -> ErrorEstimate {
    let mut all: Vec<f64> = stats
        .iter()
        .filter_map(|s| relative(s.norm2, s.two_variance + s.multi_variance))
        .collect();
    all.sort_by(f64::total_cmp);
    let total: f64 = stats.iter().map(|s| s.total).sum();
    let variance: f64 = stats.iter().map(|s| s.total_variance).sum();
    ErrorEstimate {
        median_relative: quantile(&all, 0.5) as f32,
        p95_relative: quantile(&all, 0.95) as f32,
        total_relative: if total > 0.0 {
            (variance.sqrt() / total) as f32
        } else {
            0.0
        },
        samples,
    }
}

/// The fewest paths per pixel, on a ladder of steps of about √2, with which the pilot's median error
/// comes down to `target`. The two-bounce strata grow with the root of the paths, and their variance
/// falls with the power 3/2 of their number (half of it lies on edges between bins).
pub(super) fn paths_for(pilot: &[Stat], target: f32, most: u32) -> u32 {
    let median = |n: u32| {
        let scale = f64::from(PILOT_PATHS) / f64::from(n);
        let two_scale = scale.sqrt() * scale.sqrt().sqrt();
        let mut all: Vec<f64> = pilot
            .iter()
            .filter_map(|s| {
                let v = s.two_variance + s.multi_variance;
                let clean = (s.norm2 - v).max(0.1 * s.norm2);
                let then = s.two_variance * two_scale + s.multi_variance * scale;
                (s.norm2 > 0.0).then(|| (then / clean).sqrt())
            })
            .collect();
        all.sort_by(f64::total_cmp);
        quantile(&all, 0.5)
    };
    let mut n = 4;
    while n < most && median(n) > f64::from(target) {
        // 4, 6, 8, 12, 16, 24, …
        n = if n.is_power_of_two() {
            n + n / 2
        } else {
            n / 3 * 4
        };
    }
    n.min(most)
}
