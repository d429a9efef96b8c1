//! Axes: round ticks, and powers of ten in labels.

use crate::number::{digits, short};

/// Returns round values from `low` to `high`, about `count` of them.
pub fn ticks(low: f64, high: f64, count: usize) -> Vec<f64> {
    let span = high - low;
    if !span.is_finite() || span <= 0.0 {
        return vec![];
    }
    let rough = span / count.max(1) as f64;
    let power = libm::pow(10.0, libm::floor(libm::log10(rough)));
    let step = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|s| s * power)
        .find(|s| *s >= rough * 0.7)
        .unwrap_or(rough);
    let first = libm::ceil(low / step - 1e-9) as i64;
    let last = libm::floor(high / step + 1e-9) as i64;
    (first..=last).take(50).map(|k| k as f64 * step).collect()
}

/// Returns the power of ten that values up to `high` are divided by: 0 for those that read well.
pub fn power(high: f64) -> i32 {
    if high <= 0.0 || !high.is_finite() {
        return 0;
    }
    match libm::floor(libm::log10(high)) as i32 {
        -2..=3 => 0,
        power => power,
    }
}

/// Returns a value divided by a power of ten, in three digits without insignificant zeros.
pub fn number(value: f64, power: i32) -> String {
    let scaled = value / libm::pow(10.0, f64::from(power));
    let rounded: f64 = digits(scaled, 3).parse().unwrap_or(scaled);
    short(rounded).replace('-', "\u{2212}")
}

/// Returns an axis label with unit and power of ten.
pub fn axis(name: &str, unit: &str, power: i32) -> String {
    let factor = match power {
        0 => String::new(),
        p => format!("10^{p} "),
    };
    match (unit, factor.is_empty()) {
        ("", true) => name.to_owned(),
        _ => format!("{name} ({})", (factor + unit).trim_end()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_within_the_limits() {
        assert_eq!(ticks(0.0, 10.0, 5), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        assert_eq!(ticks(0.72, 4.11, 3), [1.0, 2.0, 3.0, 4.0]);
        assert_eq!(ticks(20.0, 85.0, 3), [20.0, 40.0, 60.0, 80.0]);
        assert_eq!(ticks(1.0, 1.0, 3), [0.0; 0]);
        for (low, high) in [(-3.0, 1e-3), (1e-9, 3e-9), (5.0, 1e12)] {
            let ticks = ticks(low, high, 4);
            assert!((2..=9).contains(&ticks.len()), "{ticks:?}");
            let slack = 1e-6 * (high - low);
            assert!(
                ticks
                    .iter()
                    .all(|t| (low - slack..=high + slack).contains(t))
            );
        }
    }

    #[test]
    fn small_numbers_share_a_power_of_ten() {
        let power = power(3.21e-5);
        assert_eq!(number(3.21e-5, power), "3.21");
        assert_eq!(axis("light", "1/(m² sr)", power), "light (10^-5 1/(m² sr))");
        assert_eq!(axis("z-depth", "m", 0), "z-depth (m)");
        assert_eq!(axis("spots", "", 0), "spots");
    }
}
