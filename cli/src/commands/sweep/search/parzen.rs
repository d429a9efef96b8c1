//! Mixtures of kernels over a space, with one kernel for each trial and one for the prior.
//!
//! The mixture is multivariate: a kernel is a product over parameters, so that combinations of good
//! values are preserved (Falkner et al., ICML 2018; recommended by Watanabe 2023, arXiv
//! 2304.11127). Numbers of an interval are mapped to [0, 1], by their logarithm if the interval is
//! logarithmic. Their kernel is a truncated normal distribution, integrated over steps for
//! integers. In a list, a kernel prefers its trial's value to the others, which have equal weights.
//!
//! Widths are those of Optuna's `TPESampler(multivariate=True)`: 0.2 n^(−1/(d+4)) of the interval
//! (Scott's rule), but at least 1/min(100, n + 2) ("magic clipping"). The prior is a normal
//! distribution as wide as the interval, centred in it, and has the weight of one trial.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

use picofarm_proto::spec::{Domain, Interval};
use serde_json::Value;

use super::{Space, Values, below, bits, uniform};

/// A mixture of kernels.
pub(crate) struct Mixture<'a> {
    space: &'a Space,
    /// Centre of each kernel, by parameter. The last kernel is the prior, which has no centre.
    kernels: Vec<Vec<Option<Position>>>,
    /// Width of the trials' kernels.
    width: f64,
}

/// Position of a value in its domain.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Position {
    /// A share of an interval, and half of a step's width: 0 where there are no steps.
    At(f64, f64),
    /// Index in a list.
    Number(usize),
}

impl Position {
    /// Returns the position of a value, or `None` for one that has none.
    fn find(domain: &Domain, value: &Value) -> Option<Self> {
        match domain {
            Domain::OneOf(_) => domain.position(value).map(Self::Number),
            Domain::Within(interval) => {
                let half = match interval {
                    Interval::Int([a, b]) => 0.5 / (b.wrapping_sub(*a) as u64 as f64 + 1.0),
                    Interval::Range(_) | Interval::Log(_) => 0.0,
                };
                Some(Self::At(interval.share(value)?, half))
            }
        }
    }
}

impl<'a> Mixture<'a> {
    /// Creates the mixture of some trials.
    pub(crate) fn new<'v>(space: &'a Space, trials: impl Iterator<Item = &'v Values>) -> Self {
        let place = |values: &Values| -> Vec<Option<Position>> {
            let of = |(name, domain): (&String, &Domain)| Position::find(domain, values.get(name)?);
            space.iter().map(of).collect()
        };
        let mut kernels: Vec<_> = trials.map(place).collect();
        let n = kernels.len();
        let scott = 0.2 * libm::pow(n.max(1) as f64, -1.0 / (space.len() as f64 + 4.0));
        kernels.push(vec![None; space.len()]);
        Self {
            space,
            width: scott.clamp(1.0 / (n as f64 + 2.0).min(100.0), 1.0),
            kernels,
        }
    }

    /// Returns the logarithm of the density at some values.
    pub(crate) fn log_density(&self, values: &Values) -> f64 {
        let places: Vec<Option<Position>> = self
            .space
            .iter()
            .map(|(name, domain)| Position::find(domain, values.get(name)?))
            .collect();
        let logs: Vec<f64> = self
            .kernels
            .iter()
            .map(|kernel| {
                let of = |((domain, centre), place)| self.log_kernel(domain, centre, place);
                let domains = self.space.values().zip(kernel);
                domains.zip(&places).map(of).sum()
            })
            .collect();
        let most = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let sum: f64 = logs.iter().map(|log| libm::exp(log - most)).sum();
        most + libm::log(sum / logs.len() as f64)
    }

    /// Draws values from the mixture: draw number `number` for trial `trial`.
    pub(crate) fn draw(&self, seed: u64, trial: u64, number: u64) -> Values {
        let bits = |of: &str| bits(seed, of, [trial, number]);
        let kernel = &self.kernels[below(self.kernels.len(), bits("kernel"))];
        let of = |((name, domain), centre): ((&String, &Domain), &Option<Position>)| {
            // No parameter can have this name.
            let share = uniform(bits(&format!("value of {name}")));
            let value = match domain {
                Domain::OneOf(list) => {
                    let weights = (0..list.len()).map(|number| {
                        let hit = *centre == Some(Position::Number(number));
                        self.weight(list.len(), centre.is_some(), hit)
                    });
                    list[at_share(weights, share).min(list.len() - 1)].clone()
                }
                Domain::Within(interval) => interval.at(self.quantile(*centre, share)),
            };
            (name.clone(), value)
        };
        self.space.iter().zip(kernel).map(of).collect()
    }

    fn log_kernel(
        &self,
        domain: &Domain,
        centre: &Option<Position>,
        place: &Option<Position>,
    ) -> f64 {
        match (domain, place) {
            (Domain::OneOf(list), Some(Position::Number(number))) => {
                let hit = *centre == Some(Position::Number(*number));
                libm::log(self.weight(list.len(), centre.is_some(), hit))
            }
            (Domain::Within(_), Some(Position::At(share, half))) => {
                let (mean, width) = self.normal(*centre);
                let all = normal_below((1.0 - mean) / width) - normal_below(-mean / width);
                let here = match *half > 0.0 {
                    true => {
                        normal_below((share + half - mean) / width)
                            - normal_below((share - half - mean) / width)
                    }
                    false => {
                        let z = (share - mean) / width;
                        libm::exp(-0.5 * z * z) / (width * libm::sqrt(2.0 * PI))
                    }
                };
                libm::log((here / all).max(1e-300))
            }
            _ => 0.0,
        }
    }

    /// Returns centre and width of a kernel over an interval.
    fn normal(&self, centre: Option<Position>) -> (f64, f64) {
        match centre {
            Some(Position::At(share, _)) => (share, self.width),
            _ => (0.5, 1.0),
        }
    }

    /// Returns the weight that a kernel gives to a value of a list. The prior's weight of 1 is
    /// divided among all kernels.
    fn weight(&self, values: usize, somewhere: bool, hit: bool) -> f64 {
        let least = 1.0 / self.kernels.len() as f64;
        let sum = least * values as f64 + f64::from(u8::from(somewhere));
        (least + f64::from(u8::from(hit))) / sum
    }

    /// Returns the quantile of a kernel at a given share of its weight, as a fraction of the
    /// interval. Found by bisection to the last significant bit.
    fn quantile(&self, centre: Option<Position>, share: f64) -> f64 {
        let (mean, width) = self.normal(centre);
        let below = |x: f64| normal_below((x - mean) / width);
        let wanted = below(0.0) + share * (below(1.0) - below(0.0));
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            match below(middle) < wanted {
                true => low = middle,
                false => high = middle,
            }
        }
        0.5 * (low + high)
    }
}

/// Returns the index at which the cumulative weight reaches a share of the total, which is 1.
fn at_share(weights: impl Iterator<Item = f64>, mut share: f64) -> usize {
    let passed = |weight: &f64| {
        share -= weight;
        share >= 0.0
    };
    weights.take_while(passed).count()
}

/// Returns the share of a standard normal distribution below x.
fn normal_below(x: f64) -> f64 {
    0.5 * libm::erfc(-x * FRAC_1_SQRT_2)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    fn space() -> Space {
        let space = json!({
            "lr": {"log": [1e-4, 1e-1]}, "width": {"int": [2, 9]}, "kind": ["a", "b", "c"], "x": {"range": [-1, 3]},
        });
        serde_json::from_value(space).unwrap()
    }

    fn values(lr: f64, width: i64, kind: &str, x: f64) -> Values {
        let values = json!({"lr": lr, "width": width, "kind": kind, "x": x});
        serde_json::from_value(values).unwrap()
    }

    #[test]
    fn a_density_is_one_in_sum() {
        let trials = [values(1e-2, 3, "b", 0.5), values(2e-2, 9, "c", -1.0)];
        for trials in [&trials[..], &trials[..1], &[]] {
            for (name, domain) in space() {
                let space = Space::from([(name.clone(), domain.clone())]);
                let mixture = Mixture::new(&space, trials.iter());
                let density = |value: Value| {
                    libm::exp(mixture.log_density(&Values::from([(name.clone(), value)])))
                };
                let sum: f64 = match &domain {
                    Domain::OneOf(list) => list.iter().map(|v| density(v.clone())).sum(),
                    Domain::Within(Interval::Int([a, b])) => {
                        (*a..=*b).map(|n| density(json!(n))).sum()
                    }
                    Domain::Within(interval) => {
                        let n = 4000;
                        let at = |i| density(interval.at((f64::from(i) + 0.5) / f64::from(n)));
                        (0..n).map(at).sum::<f64>() / f64::from(n)
                    }
                };
                assert!((sum - 1.0).abs() < 2e-3, "{name}: {sum}");
            }
        }
    }

    #[test]
    fn draws_follow_the_density() {
        let space = space();
        let trials = vec![values(1e-2, 3, "b", 0.5); 8];
        let mixture = Mixture::new(&space, trials.iter());
        let draws: Vec<Values> = (0..2000).map(|i| mixture.draw(7, 1, i)).collect();
        // The density of one parameter, for any values of the others.
        let density = |name: &str, value: Value| {
            let one = Space::from([(name.to_owned(), space[name].clone())]);
            let alone = Mixture {
                kernels: Mixture::new(&one, trials.iter()).kernels,
                space: &one,
                width: mixture.width,
            };
            libm::exp(alone.log_density(&Values::from([(name.to_owned(), value)])))
        };
        let share = |of: &dyn Fn(&Values) -> bool| {
            draws.iter().filter(|d| of(d)).count() as f64 / draws.len() as f64
        };
        let width = density("width", json!(3));
        assert!(
            (share(&|d| d["width"] == 3) - width).abs() < 0.03,
            "{width}"
        );
        let kind = density("kind", json!("b"));
        assert!((share(&|d| d["kind"] == "b") - kind).abs() < 0.03, "{kind}");
        // A tenth of x's interval: 0.1 times the mean density there.
        let near = (0..100).map(|i| density("x", json!(0.3 + 0.004 * (f64::from(i) + 0.5))));
        let near = near.sum::<f64>() / 100.0 * 0.1;
        let found = share(&|d| (0.3..0.7).contains(&d["x"].as_f64().unwrap()));
        assert!((found - near).abs() < 0.03, "{found} {near}");
    }

    proptest! {
        #[test]
        fn draws_lie_in_their_domains(seed: u64, trial: u64, number: u64, n in 0usize..5) {
            let space = space();
            let trials = vec![values(1e-4, 9, "c", 3.0); n];
            let drawn = Mixture::new(&space, trials.iter()).draw(seed, trial, number);
            prop_assert_eq!(drawn.len(), 4);
            for (name, value) in &drawn {
                prop_assert!(space[name].contains(value), "{name}: {value}");
            }
            prop_assert!(Mixture::new(&space, trials.iter()).log_density(&drawn).is_finite());
        }
    }
}
