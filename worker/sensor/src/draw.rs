//! Random counts: a separate generator for each (seed, scene, pixel, bin), and exact Poisson and
//! binomial draws.

use picofarm_settings::random::{GOLDEN, mix};

use crate::alias::{SplitRate, TABLED};

/// The purpose of a stream of numbers.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Purpose {
    Counts = 1,
    Peak = 2,
    Roll = 3,
    Afterpulses = 4,
    FreeRunning = 5,
}

/// The key of one pixel's numbers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PixelKey(u64);

impl PixelKey {
    pub fn new(seed: u64, purpose: Purpose, scene: u64, pixel: u64) -> Self {
        let parts = [purpose as u64, scene, pixel];
        Self(parts.into_iter().fold(mix(seed ^ GOLDEN), |key, part| {
            mix(key.rotate_left(17) ^ mix(part.wrapping_add(GOLDEN)))
        }))
    }

    #[inline(always)]
    pub fn bin(self, bin: u64) -> Draws {
        Draws {
            state: mix(self.0.wrapping_add(bin.wrapping_mul(GOLDEN))),
            first: true,
        }
    }
}

/// Uniform numbers of one (seed, scene, pixel, bin): SplitMix64 from a hashed start.
#[derive(Debug, Clone)]
pub struct Draws {
    state: u64,
    first: bool,
}

impl Draws {
    /// Returns the numbers that the sensor draws its counts from.
    pub fn new(seed: u64, scene: u64, pixel: u64, bin: u64) -> Self {
        PixelKey::new(seed, Purpose::Counts, scene, pixel).bin(bin)
    }

    /// Returns 64 uniform bits.
    #[inline(always)]
    fn bits(&mut self) -> u64 {
        // The hashed start is as good as any later number, and most bins need only one.
        if self.first {
            self.first = false;
            self.state
        } else {
            self.state = self.state.wrapping_add(GOLDEN);
            mix(self.state)
        }
    }

    /// Returns a uniform number in [0, 1), 53 bits.
    #[inline(always)]
    pub fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// Returns a standard normal number (Marsaglia's polar method).
    pub(crate) fn normal(&mut self) -> f64 {
        loop {
            let (x, y) = (2.0 * self.uniform() - 1.0, 2.0 * self.uniform() - 1.0);
            let r2 = x * x + y * y;
            if r2 > 0.0 && r2 < 1.0 {
                return x * (-2.0 * libm::log(r2) / r2).sqrt();
            }
        }
    }
}

/// Expected successes from which binomial counts use rejection instead of inversion.
const LARGE: f64 = 10.0;

/// Returns a Poisson count, exact for rates up to 10¹². It uses tables below a rate of 1024, and
/// from there Hörmann's transformed rejection (PTRS; W. Hörmann, "The transformed rejection method
/// for generating Poisson random variables", Insurance: Mathematics and Economics 12, 1993).
/// Returns 0 if the rate is not above 0.
///
/// # Panics
/// Panics if the rate is above 10¹².
///
/// # Examples
/// ```
/// use picofarm_sensor::{Draws, poisson};
///
/// // Seed 1, scene 0, pixel 5, bin 9: the same count on every machine.
/// let count = poisson(40.0, &mut Draws::new(1, 0, 5, 9));
/// assert_eq!(count, poisson(40.0, &mut Draws::new(1, 0, 5, 9)));
/// ```
#[inline(always)]
pub fn poisson(rate: f64, draws: &mut Draws) -> u64 {
    if rate.is_nan() || rate <= 0.0 {
        return 0;
    }
    if rate < TABLED {
        let cut = SplitRate::new(rate);
        let count = cut.count(|| draws.bits());
        let u = draws.uniform();
        // 1 − rest ≤ exp(−rest): most bins need no exponential.
        if u < 1.0 - cut.rest {
            return count;
        }
        return count + poisson_inverse(cut.rest, u);
    }
    assert!(rate <= 1e12, "a rate of {rate} is beyond exact counting");
    poisson_ptrs(rate, draws)
}

/// Returns the smallest k with P(K ≤ k) > u.
fn poisson_inverse(rate: f64, mut u: f64) -> u64 {
    let mut p = libm::exp(-rate);
    let mut k = 0.0;
    // A uniform number of 53 bits cannot resolve probabilities below 10⁻²⁰.
    while u >= p && (p > 1e-20 || k < rate) {
        u -= p;
        k += 1.0;
        p *= rate / k;
    }
    k as u64
}

fn poisson_ptrs(rate: f64, draws: &mut Draws) -> u64 {
    let b = 0.931 + 2.53 * rate.sqrt();
    let a = -0.059 + 0.02483 * b;
    let inverse_alpha = 1.1239 + 1.1328 / (b - 3.4);
    let quick = 0.9277 - 3.6224 / (b - 2.0);
    loop {
        let u = draws.uniform() - 0.5;
        let v = draws.uniform();
        let us = 0.5 - u.abs();
        let x = (2.0 * a / us + b) * u + rate + 0.43;
        if us >= 0.07 && v <= quick {
            return x as u64;
        }
        if x < 0.0 || (us < 0.013 && v > us) {
            continue;
        }
        // A cast truncates, at a fraction of the cost of `floor`.
        let k = x as i64 as f64;
        if libm::log(v * inverse_alpha / (a / (us * us) + b)) <= ln_poisson(k, rate) {
            return k as u64;
        }
    }
}

/// Returns ln P(K = k) = −(k ln(k/λ) − (k − λ)) − ½ ln(2πk) − (ln k! − Stirling). This form avoids
/// the cancellation of k ln λ against ln k!, which would cost seven digits at 4·10⁷.
fn ln_poisson(k: f64, rate: f64) -> f64 {
    if k == 0.0 {
        return -rate;
    }
    let root = 0.5 * libm::log(2.0 * std::f64::consts::PI * k);
    -(k * libm::log(k / rate) - (k - rate)) - root - stirling_rest(k)
}

/// Returns ln k! − (k ln k − k + ½ ln 2πk), for integer k.
fn stirling_rest(k: f64) -> f64 {
    const EXACT: [f64; 10] = [
        0.0,
        0.081_061_466_795_327_26,
        0.041_340_695_955_409_3,
        0.027_677_925_684_998_34,
        0.020_790_672_103_765_093,
        0.016_644_691_189_821_193,
        0.013_876_128_823_070_748,
        0.011_896_709_945_891_77,
        0.010_411_265_261_972_096,
        0.009_255_462_182_712_733,
    ];
    if k < 10.0 {
        return EXACT[k as usize];
    }
    let r = 1.0 / (k * k);
    (1.0 / 12.0 - (1.0 / 360.0 - (1.0 / 1260.0 - r / 1680.0) * r) * r) / k
}

/// Returns a binomial count of `n` trials with success probability 1 − exp(−`rate`); exact for n up
/// to 2⁴⁰. It uses inversion below 10 expected counts, and from there Hörmann's BTRS ("The
/// generation of binomial random variates", Journal of Statistical Computation and Simulation 46,
/// 1993). Returns 0 if the rate is not above 0.
pub fn binomial(n: u64, rate: f64, draws: &mut Draws) -> u64 {
    if n == 0 || rate.is_nan() || rate <= 0.0 {
        return 0;
    }
    let (p, q) = (-libm::expm1(-rate), libm::exp(-rate));
    // Failures are drawn if they are rarer than successes.
    if p > 0.5 {
        let failures = binomial_rare(n, q, libm::log1p(-q), draws);
        return n - failures;
    }
    binomial_rare(n, p, -rate, draws)
}

/// Returns a binomial count for p ≤ ½; `ln_q` = ln(1 − p).
fn binomial_rare(n: u64, p: f64, ln_q: f64, draws: &mut Draws) -> u64 {
    if p <= 0.0 {
        return 0;
    }
    let trials = n as f64;
    if trials * p < LARGE {
        let mut u = draws.uniform();
        let mut mass = libm::exp(trials * ln_q);
        let odds = p / (1.0 - p);
        let mut k = 0.0;
        while u >= mass && k < trials && (mass > 1e-20 || k < trials * p) {
            u -= mass;
            mass *= odds * (trials - k) / (k + 1.0);
            k += 1.0;
        }
        return k as u64;
    }
    binomial_btrs(trials, p, draws) as u64
}

fn binomial_btrs(n: f64, p: f64, draws: &mut Draws) -> f64 {
    let deviation = (n * p * (1.0 - p)).sqrt();
    let b = 1.15 + 2.53 * deviation;
    let a = -0.0873 + 0.0248 * b + 0.01 * p;
    let quick = 0.92 - 4.2 / b;
    let alpha = (2.83 + 5.1 / b) * deviation;
    let mode = ((n + 1.0) * p).floor();
    loop {
        let u = draws.uniform() - 0.5;
        let v = draws.uniform();
        let us = 0.5 - u.abs();
        let x = (2.0 * a / us + b) * u + n * p + 0.5;
        let k = x as i64 as f64;
        if us >= 0.07 && v <= quick {
            return k;
        }
        if x < 0.0 || k > n {
            continue;
        }
        let ln_v = libm::log(v * alpha / (a / (us * us) + b));
        if ln_v <= ln_binomial(k, n, p) - ln_binomial(mode, n, p) {
            return k;
        }
    }
}

/// Returns ln P(K = k) in the saddle-point form (C. Loader, "Fast and accurate computation of
/// binomial probabilities", 2000), which has no cancellation of large terms.
fn ln_binomial(k: f64, n: f64, p: f64) -> f64 {
    let q = 1.0 - p;
    if k == 0.0 {
        return n * libm::log1p(-p);
    }
    if k == n {
        return n * libm::log(p);
    }
    let deviance = |x: f64, mean: f64| x * libm::log(x / mean) + mean - x;
    let rest = stirling_rest(n) - stirling_rest(k) - stirling_rest(n - k);
    let root = 0.5 * libm::log(n / (2.0 * std::f64::consts::PI * k * (n - k)));
    rest - deviance(k, n * p) - deviance(n - k, n * q) + root
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_of_probabilities_are_right() {
        let ln_factorial = |k: u32| (1..=k).map(|i| libm::log(f64::from(i))).sum::<f64>();
        for (k, rate) in [
            (0, 12.0),
            (1, 10.0),
            (7, 11.5),
            (9, 10.0),
            (10, 10.0),
            (25, 30.0),
            (170, 160.0),
        ] {
            let exact = f64::from(k) * libm::log(rate) - rate - ln_factorial(k);
            assert!(
                (ln_poisson(f64::from(k), rate) - exact).abs() < 1e-11,
                "{k} {rate}"
            );
        }
        for (k, n, p) in [
            (0, 40, 0.3),
            (3, 40, 0.3),
            (12, 40, 0.3),
            (40, 40, 0.4),
            (150, 300, 0.5),
        ] {
            let exact = ln_factorial(n) - ln_factorial(k) - ln_factorial(n - k)
                + f64::from(k) * libm::log(p)
                + f64::from(n - k) * libm::log(1.0 - p);
            assert!(
                (ln_binomial(f64::from(k), f64::from(n), p) - exact).abs() < 1e-11,
                "{k} {n} {p}"
            );
        }
    }

    #[test]
    fn keys_differ_by_every_part() {
        let draw = |a, b, c, d| Draws::new(a, b, c, d).uniform().to_bits();
        let all = [
            draw(0, 0, 0, 0),
            draw(1, 0, 0, 0),
            draw(0, 1, 0, 0),
            draw(0, 0, 1, 0),
            draw(0, 0, 0, 1),
        ];
        for i in 0..all.len() {
            for j in 0..i {
                assert_ne!(all[i], all[j], "{i} {j}");
            }
        }
        let pixel = |p| PixelKey::new(0, p, 0, 0).bin(0).uniform().to_bits();
        assert_ne!(pixel(Purpose::Peak), pixel(Purpose::Roll));
        assert_eq!(pixel(Purpose::Counts), all[0]);
    }

    #[test]
    fn extreme_rates_end() {
        let mut draws = Draws::new(1, 2, 3, 4);
        assert_eq!(poisson(0.0, &mut draws), 0);
        assert_eq!(poisson(-1.0, &mut draws), 0);
        assert_eq!(poisson(f64::NAN, &mut draws), 0);
        assert_eq!(poisson(1e-300, &mut draws), 0);
        let n = poisson(1e12, &mut draws) as f64;
        assert!((n - 1e12).abs() < 6e6, "{n}");
        assert!(poisson_inverse(0.0624, 1.0 - f64::EPSILON / 2.0) < 20);
        assert_eq!(binomial(5, 1e9, &mut draws), 5);
        assert_eq!(binomial(0, 1.0, &mut draws), 0);
        assert_eq!(binomial(7, 0.0, &mut draws), 0);
        let n = binomial(1 << 40, 0.5, &mut draws) as f64;
        let mean = (1u64 << 40) as f64 * (1.0 - (-0.5f64).exp());
        assert!((n - mean).abs() < 3.6e6, "{n} {mean}");
    }
}
