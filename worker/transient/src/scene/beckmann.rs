//! Samples the visible facets of Beckmann's distribution (Heitz and d'Eon, EGSR 2014) without
//! inverting a distribution function.
//!
//! Seen under the angle θ, a facet of slope (x, y)·α, with x towards the direction, has the
//! weight (a + x)·e^(−x²−y²) if a + x > 0, with a = 1/(α·tan θ). So y is normally distributed. For
//! x, the pair ±r has the total weight 2a·e^(−r²) if r < a; beyond a only +r counts, with the
//! weight (a + r)·e^(−r²).

use crate::numeric::{exponential::exp_minus, rng::Rng};

/// √π.
const ROOT: f32 = 1.772_453_9;

/// Value of a above which directions count as normal to the surface.
const NORMAL: f32 = 1e15;

/// Returns a of a direction with the cosine `c`.
#[inline]
fn ratio(alpha: f32, c: f32) -> f32 {
    let sin = (1.0 - c * c).max(0.0).sqrt();
    (c / (alpha * sin)).min(NORMAL)
}

/// Returns the total weights of the visible facets, without the factor of the normally distributed
/// y: of those with |x| < a, and of those beyond.
#[inline]
fn counts(a: f32) -> (f32, f32) {
    let e = exp_minus(a * a);
    let beyond = e * erfc_over(a);
    let within = a * ROOT * (1.0 - beyond);
    (within, 0.5 * (a * ROOT * beyond + e))
}

/// Returns the complementary error function over e^(−a²), with an error of 1.5·10⁻⁷ relative to 1
/// after multiplication by e^(−a²) (Abramowitz and Stegun, 7.1.26).
#[inline]
fn erfc_over(a: f32) -> f32 {
    let t = 1.0 / (1.0 + 0.327_591_1 * a);
    let p = 1.061_405_4;
    let p = p * t - 1.453_152;
    let p = p * t + 1.421_413_7;
    let p = p * t - 0.284_496_74;
    let p = p * t + 0.254_829_6;
    p * t
}

/// Returns Smith's G₁ over the cosine `c` of the direction.
#[inline]
pub(crate) fn seen(alpha: f32, c: f32) -> f32 {
    let a = ratio(alpha, c);
    let (within, beyond) = counts(a);
    let seen = a * ROOT / ((within + beyond) * c);
    if seen.is_finite() { seen } else { 0.0 }
}

/// Returns a half vector among those visible from `i`, in the surface's frame and of any length.
#[inline]
pub(crate) fn visible(alpha: f32, i: [f32; 3], rng: &mut Rng) -> [f32; 3] {
    let flat = (i[0] * i[0] + i[1] * i[1]).sqrt();
    let toward = match flat > 0.0 {
        true => [i[0] / flat, i[1] / flat],
        false => [1.0, 0.0],
    };
    let x = slope(ratio(alpha, i[2]), rng);
    let (sign, _) = rng.circle();
    let y = sign * exponential(rng).sqrt();
    [
        alpha * (x * toward[0] - y * toward[1]),
        alpha * (x * toward[1] + y * toward[0]),
        1.0,
    ]
}

/// Draws a number of density e^(−t).
#[inline]
fn exponential(rng: &mut Rng) -> f32 {
    -libm::logf(1.0 - rng.uniform())
}

/// Draws x in proportion to its weight.
#[inline]
fn slope(a: f32, rng: &mut Rng) -> f32 {
    let (within, beyond) = counts(a);
    if rng.uniform() * (within + beyond) < within {
        let r = loop {
            // Draws a number below a with density e^(−r²) by rejection. For small a, the proposals
            // are uniform below a, because few normally distributed ones would be below it.
            if a < 0.5 {
                let r = a * rng.uniform();
                if rng.uniform() < exp_minus(r * r) {
                    break r;
                }
            } else {
                let (x, _) = rng.circle();
                let r = x.abs() * exponential(rng).sqrt();
                if r < a {
                    break r;
                }
            }
        };
        return if rng.uniform() < 0.5 * (1.0 + r / a) {
            r
        } else {
            -r
        };
    }
    loop {
        // Proposals have the density 2r·e^(a²−r²); a share (a + r)/2r of them, at least half, is
        // accepted.
        let r = (a * a + exponential(rng)).sqrt();
        if rng.uniform() * 2.0 * r < a + r {
            return r;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::rng::Stream;

    #[test]
    fn slopes_have_the_moments_of_what_is_seen() {
        for a in [1e-6f32, 0.05, 0.3, 0.499, 0.501, 0.9, 1.7, 3.0, 8.0, 1e4] {
            let (mut rng, n) = (Rng::new(5, Stream::Paths, 1, 1), 200_000);
            let mut sums = [0.0f64; 3];
            for _ in 0..n {
                let x = f64::from(slope(a, &mut rng));
                assert!(x >= f64::from(-a));
                for (sum, v) in sums.iter_mut().zip([x, x * x, (-x * x).exp()]) {
                    *sum += v / f64::from(n);
                }
            }
            let all = moments(f64::from(a), |_| 1.0);
            for (k, found) in sums.into_iter().enumerate() {
                let power = |x: f64| [x, x * x, (-x * x).exp()][k];
                let mean = moments(f64::from(a), power) / all;
                let square = moments(f64::from(a), |x| power(x).powi(2)) / all;
                let error = ((square - mean * mean) / f64::from(n)).sqrt();
                assert!(
                    (found - mean).abs() < 4.0 * error,
                    "{a} {k}: {found} {mean}"
                );
            }
            let (within, beyond) = counts(a);
            assert!((f64::from(within + beyond) / all - 1.0).abs() < 1e-5, "{a}");
        }
    }

    /// Returns the weighted sum of f over slopes.
    fn moments(a: f64, f: impl Fn(f64) -> f64) -> f64 {
        let (low, high, steps) = ((-a).max(-9.0), 9.0, 200_000);
        let step = (high - low) / f64::from(steps);
        let midpoint = |k: i32| low + (f64::from(k) + 0.5) * step;
        let count = |x: f64| f(x) * (a + x) * (-x * x).exp();
        (0..steps).map(|k| count(midpoint(k))).sum::<f64>() * step
    }

    #[test]
    fn masking_is_walters_within_what_he_states() {
        for c in [1e-3f32, 0.05, 0.2, 0.5, 0.9, 0.999, 1.0] {
            for alpha in [0.001f32, 0.1, 0.5, 1.0] {
                let tan = (1.0 - c * c).sqrt() / c;
                let walter = crate::scene::lobe::beckmann_masking(1.0 / (alpha * tan)) / c;
                let found = seen(alpha, c);
                assert!(
                    (found / walter - 1.0).abs() < 4e-3,
                    "{alpha} {c}: {found} {walter}"
                );
            }
        }
        assert_eq!(seen(0.3, 0.0), 0.0);
    }
}
