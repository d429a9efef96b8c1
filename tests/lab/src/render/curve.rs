//! Curves of error over time: the time at which they reach a given error, and growth exponents.

use serde::Serialize;

/// The time at which a curve reaches an error.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Crossing {
    /// CPU seconds.
    pub cpu_s: f64,
    pub how: How,
}

/// Method by which a crossing was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum How {
    /// Between two rungs, linearly in the logarithms.
    Interpolated,
    /// Beyond the last rung, with error ~ time^-1/2.
    Extrapolated,
    /// The cheapest rung is already better.
    AtMost,
}

impl std::fmt::Display for Crossing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mark = match self.how {
            How::Interpolated => "",
            How::Extrapolated => "~",
            How::AtMost => "<",
        };
        f.pad(&format!("{mark}{}", three_digits(self.cpu_s)))
    }
}

/// Formats three digits: 0.123, 1.23, 12.3, 123, 1234.
pub fn three_digits(v: f64) -> String {
    let decimals = match v.abs() {
        x if x < 0.9995 => 3,
        x if x < 9.995 => 2,
        x if x < 99.95 => 1,
        _ => 0,
    };
    format!("{v:.decimals$}")
}

/// Returns the CPU seconds to `target` on a curve of (CPU seconds, error). `None` without points.
pub fn crossing(points: &[(f64, f64)], target: f64) -> Option<Crossing> {
    let mut points = points.to_vec();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (first, last) = (*points.first()?, *points.last()?);
    if first.1 <= target {
        return Some(Crossing {
            cpu_s: first.0,
            how: How::AtMost,
        });
    }
    for pair in points.windows(2) {
        let [(t0, e0), (t1, e1)] = [pair[0], pair[1]];
        if e1 <= target {
            let share = (e0 / target).ln() / (e0 / e1.max(f64::MIN_POSITIVE)).ln();
            return Some(Crossing {
                cpu_s: t0 * (t1 / t0).powf(share),
                how: How::Interpolated,
            });
        }
    }
    Some(Crossing {
        cpu_s: last.0 * (last.1 / target).powi(2),
        how: How::Extrapolated,
    })
}

/// Returns the exponent k of y ~ x^k by least squares in the logarithms; `None` with fewer than two
/// different x.
pub fn exponent(points: &[(f64, f64)]) -> Option<f64> {
    let n = points.len() as f64;
    let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
    let mean = |f: fn(&(f64, f64)) -> f64| logs.iter().map(f).sum::<f64>() / n;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    let across: f64 = logs.iter().map(|(x, y)| (x - mx) * (y - my)).sum();
    let along: f64 = logs.iter().map(|(x, _)| (x - mx).powi(2)).sum();
    (along > 0.0).then(|| across / along)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_is_straight_in_the_logarithms() {
        let points = [(16.0, 0.05), (1.0, 0.2), (4.0, 0.1)];
        let at = |e| crossing(&points, e).expect("points");
        let is = |c: Crossing, t: f64, how| (c.cpu_s / t - 1.0).abs() < 1e-9 && c.how == how;
        assert!(is(at(0.1), 4.0, How::Interpolated), "{:?}", at(0.1));
        assert!(is(
            at(0.2f64.sqrt() * 0.05f64.sqrt()),
            4.0,
            How::Interpolated
        ));
        assert!(is(at(0.025), 64.0, How::Extrapolated), "{:?}", at(0.025));
        assert!(is(at(0.3), 1.0, How::AtMost));
        assert_eq!(crossing(&[], 0.1), None);
    }

    #[test]
    fn growth_is_found() {
        let cube: Vec<_> = (1..5)
            .map(f64::from)
            .map(|x| (x, 7.0 * x.powi(3)))
            .collect();
        assert!((exponent(&cube).expect("four points") - 3.0).abs() < 1e-12);
        assert_eq!(exponent(&cube[..1]), None);
    }

    #[test]
    fn times_have_three_digits() {
        let shown = [0.0123, 1.234, 12.34, 123.4, 1234.0].map(three_digits);
        assert_eq!(shown, ["0.012", "1.23", "12.3", "123", "1234"]);
    }
}
