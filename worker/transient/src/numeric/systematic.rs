//! Systematic sampling.

/// Systematic sampling: draws `count` times in proportion to `weights`, from one random number, and
/// calls `each` once for every entry drawn, with its share of the sum. Unbiased for the sum.
#[inline]
pub(crate) fn draw(weights: &[f32], count: u32, u: f32, mut each: impl FnMut(usize, f32)) {
    let total: f32 = weights.iter().sum();
    // Below the smallest normal number, a step could be 0.
    if !(total > 1e-30 && total.is_finite()) {
        return;
    }
    let step = total / count as f32;
    let (mut sum, mut next) = (0.0, u * step);
    for (i, &w) in weights.iter().enumerate() {
        sum += w;
        let mut times = 0;
        while next < sum {
            times += 1;
            next += step;
        }
        if times > 0 {
            each(i, times as f32 * step);
        }
    }
}
