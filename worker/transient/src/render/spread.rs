//! Variance of an energy over passes.

use serde::{Deserialize, Serialize};

/// Variance of an energy's mean over passes, and the variance of that variance in excess of its
/// value for normally distributed passes (2/n of its square).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Spread {
    pub variance: f64,
    pub of_variance: f64,
}

impl Spread {
    /// Returns the spread of the mean of `passes`. The variance of a single pass is its square.
    pub fn of(passes: &[f64]) -> Self {
        let n = passes.len() as f64;
        if passes.len() < 2 {
            let variance = passes.iter().map(|x| x * x).sum();
            return Self {
                variance,
                of_variance: variance * variance,
            };
        }
        let mean = passes.iter().sum::<f64>() / n;
        let shares = || {
            let share = |x: &f64| (x - mean).powi(2) / (n * (n - 1.0));
            passes.iter().map(share)
        };
        let variance: f64 = shares().sum();
        let square: f64 = shares().map(|s| s * s).sum();
        Self {
            variance,
            of_variance: (square - 3.0 * variance * variance / n).max(0.0),
        }
    }

    /// Returns the spread of the energy times `factor`.
    pub fn scaled(self, factor: f64) -> Self {
        let square = factor * factor;
        Self {
            variance: self.variance * square,
            of_variance: self.of_variance * square * square,
        }
    }

    /// Returns the spread of a sum of two independent energies.
    pub fn plus(self, other: Self) -> Self {
        Self {
            variance: self.variance + other.variance,
            of_variance: self.of_variance + other.of_variance,
        }
    }

    /// Returns the spread of the mean over `n` passes, which `self` describes, and over `m` more,
    /// which `other` describes. The difference of the means contributes to the estimate as well as
    /// the passes of each.
    pub fn joined(self, (n, mean): (f64, f64), other: Self, (m, other_mean): (f64, f64)) -> Self {
        if n == 0.0 || m == 0.0 {
            return if n == 0.0 { other } else { self };
        }
        let difference2 = (mean - other_mean).powi(2);
        // A single pass has no variance of its own.
        let of = |s: Self, n: f64| if n > 1.0 { s.of_variance } else { 0.0 };
        let part = |s: Self, k: f64| of(s, k) * (k / (n + m)).powi(4);
        Self {
            variance: joined_variance((n, m), (self.variance, other.variance), difference2),
            of_variance: part(self, n) + part(other, m),
        }
    }

    /// Returns the relative standard error of the variance.
    pub fn uncertainty(self) -> f64 {
        match self.variance > 0.0 {
            true => self.of_variance.sqrt() / self.variance,
            false => 0.0,
        }
    }
}

/// Returns the variance of the mean of `n` and `m` passes together, from the `variances` of the
/// mean of each and the squared difference of these means (Chan, Golub and LeVeque 1979). A single
/// pass has no variance of its own.
pub(crate) fn joined_variance((n, m): (f64, f64), variances: (f64, f64), difference2: f64) -> f64 {
    if n == 0.0 || m == 0.0 {
        return if n == 0.0 { variances.1 } else { variances.0 };
    }
    let scatter = |n: f64, variance: f64| variance * n * (n - 1.0);
    let within = scatter(n, variances.0) + scatter(m, variances.1);
    let all = n + m;
    (within + difference2 * n * m / all) / (all * (all - 1.0))
}
