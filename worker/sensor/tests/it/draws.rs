//! Poisson and binomial draws against their exact probabilities, by chi-square.

use picofarm_sensor::{Draws, binomial, poisson};

/// Returns the chi-square of `samples` draws against the probabilities of the counts `first..`,
/// grouped into cells with enough expected draws, converted to a standard normal number (Wilson &
/// Hilferty 1931).
fn deviation(
    samples: usize,
    first: u64,
    probabilities: &[f64],
    mut draw: impl FnMut(u64) -> u64,
) -> f64 {
    let mut seen = vec![0u32; probabilities.len()];
    let (mut below, mut above) = (0u32, 0u32);
    for i in 0..samples {
        let k = draw(i as u64);
        match k.checked_sub(first).map(|k| seen.get_mut(k as usize)) {
            Some(Some(seen)) => *seen += 1,
            Some(None) => above += 1,
            None => below += 1,
        }
    }
    // The probability of counts outside the range is less than 10⁻⁹.
    assert_eq!((below, above), (0, 0));
    let n = samples as f64;
    let cell = if probabilities.len() < 60 {
        20.0
    } else {
        n / 60.0
    };
    let (mut expected, mut observed) = (0.0, 0.0);
    let mut cells = vec![];
    for (p, seen) in probabilities.iter().zip(&seen) {
        expected += n * p;
        observed += f64::from(*seen);
        if expected >= cell {
            cells.push((expected, observed));
            (expected, observed) = (0.0, 0.0);
        }
    }
    match cells.last_mut() {
        Some(last) => {
            last.0 += expected;
            last.1 += observed;
        }
        None => panic!("no cells"),
    }
    let total: f64 = cells.iter().map(|c| c.0).sum();
    assert!(
        (total / n - 1.0).abs() < 1e-6,
        "probabilities sum to {}",
        total / n
    );
    assert!(cells.len() >= 2);
    let chi2: f64 = cells.iter().map(|(e, o)| (o - e).powi(2) / e).sum();
    let dof = (cells.len() - 1) as f64;
    ((chi2 / dof).cbrt() - (1.0 - 2.0 / (9.0 * dof))) / (2.0 / (9.0 * dof)).sqrt()
}

/// Returns the counts within 7 standard deviations of the mean, and some more.
fn range(mean: f64, sigma: f64) -> std::ops::RangeInclusive<u64> {
    (mean - 7.0 * sigma).max(0.0) as u64..=(mean + 7.0 * sigma + 12.0) as u64
}

#[test]
fn poisson_counts_follow_the_exact_probabilities_at_every_rate() {
    for rate in [
        0.01, 0.06, 0.0625, 0.5, 3.99, 4.0, 5.0, 9.99, 12.03, 30.0, 63.9, 64.0, 400.0, 1023.9,
        1024.0, 1e5, 4e7,
    ] {
        let range = range(rate, f64::sqrt(rate));
        let first = *range.start();
        let probabilities: Vec<f64> = range
            .map(|k| {
                let k = k as f64;
                (k * rate.ln() - rate - libm::lgamma(k + 1.0)).exp()
            })
            .collect();
        let z = deviation(300_000, first, &probabilities, |i| {
            poisson(rate, &mut Draws::new(11, 0, i, 7))
        });
        assert!(z.abs() < 4.0, "rate {rate}: {z} standard deviations");
    }
}

#[test]
fn binomial_counts_follow_the_exact_probabilities() {
    for (n, p) in [
        (1u64, 0.3),
        (20, 0.1),
        (20, 0.9),
        (40, 0.5),
        (300, 0.4),
        (1000, 0.97),
        (100_000, 1e-4),
        (100_000, 0.3),
        (10_000_000, 0.6),
    ] {
        let rate = -f64::ln_1p(-p);
        let trials = n as f64;
        let full = range(trials * p, (trials * p * (1.0 - p)).sqrt());
        let range = *full.start()..=(*full.end()).min(n);
        let first = *range.start();
        let choose = |k: f64| {
            libm::lgamma(trials + 1.0) - libm::lgamma(k + 1.0) - libm::lgamma(trials - k + 1.0)
        };
        let probabilities: Vec<f64> = range
            .map(|k| {
                let k = k as f64;
                (choose(k) + k * p.ln() + (trials - k) * f64::ln_1p(-p)).exp()
            })
            .collect();
        let z = deviation(200_000, first, &probabilities, |i| {
            binomial(n, rate, &mut Draws::new(12, i, 0, 0))
        });
        assert!(z.abs() < 4.0, "{n} trials of {p}: {z} standard deviations");
    }
}

#[test]
fn the_same_place_gives_the_same_count_for_ever() {
    // Stored data sets depend on these numbers. If they change, change SENSOR_VERSION.
    let draw = |rate, bin| poisson(rate, &mut Draws::new(1, 2, 3, bin));
    let got: Vec<u64> = [0.5, 5.0, 30.0, 400.0, 1e5, 4e7]
        .iter()
        .zip(0..)
        .map(|(rate, bin)| draw(*rate, bin))
        .collect();
    assert_eq!(got, [2, 9, 35, 376, 99_992, 40_006_501]);
}
