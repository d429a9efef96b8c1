//! Computes error estimates from variances, and the number of passes from error estimates.

use serde::{Deserialize, Serialize};

use super::{
    draws::{Draw, likely},
    region::Region,
};
use crate::api::ErrorEstimate;

/// The number of bins on either side over which the variance of the 3+ part and of the two-bounce
/// part is pooled.
pub(super) const MULTI_REACH: usize = 3;
pub(super) const TWO_REACH: usize = 1;
/// Fraction of a pixel's mean variance added to every bin.
const FLOOR: f32 = 0.003;
/// Weight of a bin's own sample variance, because edges and peaks differ from their neighbours.
/// Without it the brightest bins deviate by 1.25 to 1.4 of the stored error.
const OWN: f32 = 0.5;

/// Pools variances in place, half of each, over 3×3 pixels and a few bins, within a region's
/// `[row][col][slot]`.
///
/// The sample variance of a bin that few paths reach is mostly chance, and often nearly zero. Its
/// neighbours have nearly the same true variance, so their mean is a better estimate. The floor
/// accounts for paths that might have arrived and did not. Over many seeds the rms of (h − mean) /
/// error is then 1 within a few percent, whereas with single sample variances it is arbitrary.
pub(super) fn pool(
    variance: &mut [f32],
    region: &Region,
    slots: usize,
    reach: usize,
    rows: &mut Pool,
) {
    let (height, width) = (region.rows as usize, region.cols as usize);
    let size = width * slots;
    let Pool { bins, smooth } = rows;
    bins.resize(size, 0.0);
    for row in smooth.iter_mut() {
        row.resize(size, 0.0);
    }
    // Pixel rows are processed in turn and three are buffered, because a large region would not
    // stay in the cache.
    let mut done = 0;
    for row in 0..height {
        while done < height && done <= row + 1 {
            let v = &variance[done * size..(done + 1) * size];
            for (out, v) in bins.chunks_mut(slots).zip(v.chunks(slots)) {
                along_bins(out, v, reach);
            }
            let smooth = &mut smooth[done % 3];
            for (col, out) in smooth.chunks_mut(slots).enumerate() {
                let near = col.max(1) - 1..(col + 2).min(width);
                mean(out, near.map(|c| &bins[c * slots..(c + 1) * slots]));
            }
            done += 1;
        }
        let near = row.max(1) - 1..done;
        mean(&mut bins[..], near.map(|r| &smooth[r % 3][..]));
        let own = &mut variance[row * size..(row + 1) * size];
        for (v, pooled) in own.iter_mut().zip(&*bins) {
            *v = pooled + OWN * (*v - pooled);
        }
    }
}

/// Work buffers of [`pool`]: a row of pixels after the mean over bins, and the latest three rows
/// after the mean over columns.
#[derive(Debug, Default)]
pub(super) struct Pool {
    bins: Vec<f32>,
    smooth: [Vec<f32>; 3],
}

/// Writes the means of a pixel's bins and their neighbours, with the floor.
fn along_bins(out: &mut [f32], v: &[f32], reach: usize) {
    let slots = v.len();
    let floor = FLOOR * v.iter().sum::<f32>() / slots as f32;
    let width = 2 * reach + 1;
    let edge = reach.min(slots);
    for k in (0..edge).chain((slots - edge).max(edge)..slots) {
        let near = &v[k.saturating_sub(reach)..(k + reach + 1).min(slots)];
        out[k] = near.iter().sum::<f32>() / near.len() as f32 + floor;
    }
    // All other bins, with SIMD.
    if slots > 2 * reach {
        let inner = &mut out[reach..slots - reach];
        inner.copy_from_slice(&v[..inner.len()]);
        for j in 1..width {
            for (o, x) in inner.iter_mut().zip(&v[j..]) {
                *o += x;
            }
        }
        for o in inner {
            *o = *o / width as f32 + floor;
        }
    }
}

/// Writes the mean of one to three items.
fn mean<'a>(out: &mut [f32], mut items: impl ExactSizeIterator<Item = &'a [f32]>) {
    let share = 1.0 / items.len() as f32;
    if let Some(first) = items.next() {
        out.copy_from_slice(first);
    }
    for item in items {
        for (o, x) in out.iter_mut().zip(item) {
            *o += x;
        }
    }
    for o in out {
        *o *= share;
    }
}

/// Excludes light outside the gate from the pool: the slots before and after the gate take the
/// value of the adjacent bin.
pub(super) fn shut_out(variance: &mut [f32], slots: usize) {
    for v in variance.chunks_mut(slots) {
        v[0] = v[1];
        v[slots - 1] = v[slots - 2];
    }
}

/// The exponent with which error² × passes of the 3+ part rises with the passes in the median over
/// pixels, stated or true. After few passes, most pixels have not yet received rare bright paths.
/// From 4 to 64 passes the exponent was 0.08 to 0.16 in rooms of 1 to 100 spots. The rise is
/// extrapolated up to `RISES` times the passes: with 4 times, one class of rooms ended at 8.5 %
/// with a target of 10 %; without a bound, at 7.4 %.
const RISE: f64 = 0.13;
const RISES: f64 = 2.0;

/// A pixel's sums for the error estimate.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Stat {
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

fn sorted(stats: impl Iterator<Item = Stat>) -> Vec<f64> {
    let mut all: Vec<f64> = stats.filter_map(|s| s.error()).collect();
    all.sort_by(f64::total_cmp);
    all
}

/// Returns the median of the pixels' relative standard errors.
pub(super) fn relative_median(stats: impl Iterator<Item = Stat>) -> f64 {
    quantile(&sorted(stats), 0.5)
}

/// Variance of an energy's mean over passes, and the variance of that variance in excess of its
/// value for normally distributed passes (2/n of its square).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Spread {
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
    fn uncertainty(self) -> f64 {
        match self.variance > 0.0 {
            true => self.of_variance.sqrt() / self.variance,
            false => 0.0,
        }
    }
}

/// Returns the variance of the mean of `n` and `m` passes together, from the `variances` of the
/// mean of each and the squared difference of these means (Chan, Golub and LeVeque 1979). A single
/// pass has no variance of its own.
pub(super) fn joined_variance((n, m): (f64, f64), variances: (f64, f64), difference2: f64) -> f64 {
    if n == 0.0 || m == 0.0 {
        return if n == 0.0 { variances.1 } else { variances.0 };
    }
    let scatter = |n: f64, variance: f64| variance * n * (n - 1.0);
    let within = scatter(n, variances.0) + scatter(m, variances.1);
    let all = n + m;
    (within + difference2 * n * m / all) / (all * (all - 1.0))
}

/// The errors of a whole image.
#[derive(Debug, Clone)]
pub(super) struct Errors {
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
pub(super) fn median_after(stats: &[Stat], passes: u32, n: u32, two: &impl Fn(u32) -> f64) -> f64 {
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
pub(super) fn passes_for(
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

    use super::{FLOOR, OWN, Pool, Region, Stat, median_after, passes_for, pool};

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
