//! Axes: the positions of values on them, and their ticks.

/// An axis over values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scale {
    low: f64,
    high: f64,
    log: bool,
}

impl Scale {
    /// Creates an axis over all values that can be drawn, or `None` if there are none. If `log` is
    /// set, only positive values can be drawn.
    pub(super) fn over(values: impl Iterator<Item = f64>, log: bool) -> Option<Self> {
        let fits = |v: &f64| v.is_finite() && v.abs() < 1e300 && (!log || *v > 1e-300);
        let mut range: Option<(f64, f64)> = None;
        for v in values.filter(fits) {
            let (low, high) = range.unwrap_or((v, v));
            range = Some((low.min(v), high.max(v)));
        }
        let (low, high) = range?;
        let (mut low, mut high) = match log {
            true => (libm::log10(low), libm::log10(high)),
            false => (low, high),
        };
        // An empty range, or one within rounding errors, is widened to a readable one.
        let least = if log {
            0.3
        } else {
            (low.abs().max(high.abs()) * 0.02).max(1e-9)
        };
        if high - low < least {
            let middle = low / 2.0 + high / 2.0;
            (low, high) = (middle - least / 2.0, middle + least / 2.0);
        }
        let rim = 0.06 * (high - low);
        Some(Self {
            low: low - rim,
            high: high + rim,
            log,
        })
    }

    /// Extends a linear axis to 0 if no value is below 0.
    pub(super) fn with_zero(mut self) -> Self {
        let rim = (self.high - self.low) * 0.06 / 1.12;
        if !self.log && self.low + 1.001 * rim >= 0.0 {
            self.low = 0.0;
        }
        self
    }

    /// Returns a value's position, 0 at the low end and 1 at the high end, or `None` if it cannot
    /// be drawn.
    pub(super) fn at(&self, value: f64) -> Option<f64> {
        let value = match self.log {
            true if value > 0.0 => libm::log10(value),
            true => return None,
            false => value,
        };
        let at = (value - self.low) / (self.high - self.low);
        (-1e-6..=1.0 + 1e-6).contains(&at).then_some(at)
    }

    /// Returns about `count` values for ticks, ascending.
    pub(super) fn ticks(&self, count: usize) -> Vec<f64> {
        if !self.log {
            return linear(self.low, self.high, count);
        }
        let power = |p: f64| libm::pow(10.0, p);
        let span = self.high - self.low;
        if span < 0.8 {
            return linear(power(self.low), power(self.high), count);
        }
        let every = (span / count as f64).ceil().max(1.0) as i32;
        let within: &[f64] = if span < 2.5 { &[1.0, 2.0, 5.0] } else { &[1.0] };
        let decades =
            (self.low.floor() as i32..=self.high.ceil() as i32).filter(|p| p % every == 0);
        let all = decades.flat_map(|p| within.iter().map(move |m| m * power(f64::from(p))));
        all.filter(|v| self.at(*v).is_some()).collect()
    }
}

/// Returns ticks at distances of 1, 2 or 5 times a power of ten.
fn linear(low: f64, high: f64, count: usize) -> Vec<f64> {
    let rough = (high - low) / count.max(1) as f64;
    if !(rough > 0.0 && rough.is_finite()) {
        return Vec::new();
    }
    let power = libm::pow(10.0, libm::floor(libm::log10(rough)));
    let step = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|m| m * power)
        .find(|s| *s >= rough);
    let step = step.unwrap_or(10.0 * power);
    let first = (low / step).ceil();
    (0..=2 * count)
        .map(|i| (first + i as f64) * step)
        .map(|v| if v.abs() < step * 1e-9 { 0.0 } else { v })
        .take_while(|v| *v <= high + step * 1e-9)
        .collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::Scale;

    proptest! {
        #[test]
        fn ticks_lie_on_their_axis_in_order_and_there_are_some(
            values in prop::collection::vec(prop::num::f64::ANY, 0..6), log: bool,
        ) {
            if let Some(scale) = Scale::over(values.iter().copied(), log) {
                let ticks = scale.ticks(5);
                prop_assert!(ticks.len() <= 12, "{:?}", ticks);
                prop_assert!(ticks.windows(2).all(|w| w[0] < w[1]), "{:?}", ticks);
                prop_assert!(ticks.iter().all(|t| t.is_finite()));
            } else {
                prop_assert!(!values.iter().any(|v| v.is_normal() && *v > 1e-300 && *v < 1e300));
            }
        }
    }

    #[test]
    fn one_value_has_an_axis_around_it() {
        for (value, log) in [(0.0, false), (5.0, false), (5.0, true), (-2.0, false)] {
            let scale = Scale::over([value].into_iter(), log).unwrap();
            assert!((scale.at(value).unwrap() - 0.5).abs() < 1e-6);
            assert!(!scale.ticks(5).is_empty(), "{value} {log}");
        }
    }
}
