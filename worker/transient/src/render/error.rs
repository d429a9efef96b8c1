//! Computes error estimates from variances, and the number of passes from error estimates.

use crate::{
    api::ErrorEstimate,
    render::{
        draws::{Draw, likely},
        spread::Spread,
        stat::{Stat, quantile, relative_median, sorted},
    },
};

/// The exponent with which error² × passes of the 3+ part rises with the passes in the median over
/// pixels, stated or true. After few passes, most pixels have not yet received rare bright paths.
/// From 4 to 64 passes the exponent was 0.08 to 0.16 in rooms of 1 to 100 spots. The rise is
/// extrapolated up to `RISES` times the passes: with 4 times, one class of rooms ended at 8.5 %
/// with a target of 10 %; without a bound, at 7.4 %.
const RISE: f64 = 0.13;
const RISES: f64 = 2.0;

/// The errors of a whole image.
#[derive(Debug, Clone)]
pub(crate) struct Errors {
    /// Sums by pixel.
    pub stats: Vec<Stat>,
    /// The watched pixels, and draws of their errors.
    pub draws: Vec<(usize, Draw)>,
    /// Spread of the whole energy.
    pub spread: Spread,
    /// The number of passes.
    pub samples: u32,
    /// The value that the two-bounce variance is proportional to.
    pub two_unit: f64,
}

impl Errors {
    /// Returns the ratio of the `q`-quantile of the errors over pixels to that of the standard
    /// errors.
    pub fn likely(&self, q: f64) -> f64 {
        likely(&self.stats, &self.draws, q)
    }

    /// Returns the error estimate of the image.
    pub fn estimate(&self) -> ErrorEstimate {
        let all = sorted(self.stats.iter().copied());
        let total: f64 = self.stats.iter().map(|s| s.total).sum();
        let relative = |q| (self.likely(q) * quantile(&all, q)) as f32;
        ErrorEstimate {
            median_relative: relative(0.5),
            p95_relative: relative(0.95),
            total_relative: if total > 0.0 {
                (self.spread.variance.sqrt() / total) as f32
            } else {
                0.0
            },
            total_uncertainty: self.spread.uncertainty() as f32,
            samples: self.samples,
        }
    }
}

/// Returns the median standard error after `n` passes, for pixels with sums `stats` after `passes`.
pub(crate) fn median_after(stats: &[Stat], passes: u32, n: u32, two: &impl Fn(u32) -> f64) -> f64 {
    let more = f64::from(n) / f64::from(passes);
    let scale = libm::pow(more.min(RISES), RISE) / more;
    let then = stats.iter().map(|s| {
        // The result of `sorted` after n passes: the present variance is subtracted from the
        // measured norm.
        let now = s.two_variance + s.multi_variance;
        let clean = (s.norm2 - now).max(0.1 * s.norm2);
        let two_variance = s.two_variance * two(n) / two(passes);
        let multi_variance = s.multi_variance * scale;
        Stat {
            norm2: clean + two_variance + multi_variance,
            two_variance,
            multi_variance,
            total: s.total,
        }
    });
    relative_median(then)
}

/// Returns the fewest passes, from `least` to `most`, that reduce the median standard error to
/// `target`, for pixels with sums `stats` after `passes`. `two` returns the relative two-bounce
/// variance after a number of passes.
pub(crate) fn passes_for(
    stats: &[Stat],
    passes: u32,
    target: f32,
    (least, most): (u32, u32),
    two: impl Fn(u32) -> f64,
) -> u32 {
    let enough = |n| median_after(stats, passes, n, &two) <= f64::from(target);
    let (mut below, mut n) = (least, least);
    while n < most && !enough(n) {
        below = n + 1;
        n = n.saturating_mul(2).min(most);
    }
    while below < n {
        let middle = below + (n - below) / 2;
        match enough(middle) {
            true => n = middle,
            false => below = middle + 1,
        }
    }
    n
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use crate::render::error::median_after;
    use crate::render::error::passes_for;
    use crate::render::pooling::FLOOR;
    use crate::render::pooling::OWN;
    use crate::render::pooling::Pool;
    use crate::render::pooling::pool;
    use crate::render::region::Region;
    use crate::render::stat::Stat;

    /// The definition, one bin at a time.
    fn plain(v: &[f32], (rows, cols, slots): (usize, usize, usize), reach: usize) -> Vec<f32> {
        let near =
            |k: usize, n: usize, reach: usize| k.saturating_sub(reach)..(k + reach + 1).min(n);
        let mean = |all: Vec<f32>| all.iter().sum::<f32>() / all.len() as f32;
        let bins = |row: usize, col: usize, slot: usize| {
            let pixel = &v[(row * cols + col) * slots..][..slots];
            let floor = FLOOR * pixel.iter().sum::<f32>() / slots as f32;
            mean(pixel[near(slot, slots, reach)].to_vec()) + floor
        };
        let along_rows = |row: usize, col: usize, slot: usize| {
            mean(near(col, cols, 1).map(|c| bins(row, c, slot)).collect())
        };
        let each = (0..rows * cols * slots).map(|k| {
            let (row, col, slot) = (k / slots / cols, k / slots % cols, k % slots);
            let pooled = mean(
                near(row, rows, 1)
                    .map(|r| along_rows(r, col, slot))
                    .collect(),
            );
            pooled + OWN * (v[k] - pooled)
        });
        each.collect()
    }

    proptest! {
        #[test]
        fn the_fewest_passes_that_reach_an_error_are_found(
            pixels in prop::collection::vec((0.1f64..10.0, 0.001f64..5.0, 0.001f64..5.0), 1..40),
            (passes, target) in (4u32..40, 0.02f32..0.6),
        ) {
            let stat = |&(norm2, two_variance, multi_variance): &(f64, f64, f64)| Stat {
                norm2: norm2 + two_variance + multi_variance,
                two_variance,
                multi_variance,
                total: 1.0,
            };
            let stats: Vec<Stat> = pixels.iter().map(stat).collect();
            let two = |n: u32| f64::from(n).powf(-1.2);
            let least = passes + 1;
            let n = passes_for(&stats, passes, target, (least, 1 << 16), two);
            let after = |n| median_after(&stats, passes, n, &two);
            let target = f64::from(target);
            prop_assert!(after(n) <= target || n == 1 << 16);
            prop_assert!(n == least || after(n - 1) > target);
        }

        #[test]
        fn pooled_variances_are_half_their_neighbours_mean(
            (rows, cols, slots) in (1usize..5, 1usize..5, 3usize..20),
            reach in 0usize..4,
            values in prop::collection::vec(0.0f32..1.0, 4 * 4 * 19),
        ) {
            let region = Region { row: 0, col: 0, rows: rows as u32, cols: cols as u32 };
            let before = &values[..rows * cols * slots];
            let mut after = before.to_vec();
            pool(&mut after, &region, slots, reach, &mut Pool::default());
            let expected = plain(before, (rows, cols, slots), reach);
            for (a, b) in after.iter().zip(&expected) {
                prop_assert!((a - b).abs() < 1e-6, "{a} instead of {b}");
            }
        }
    }
}
