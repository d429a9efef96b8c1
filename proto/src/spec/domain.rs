//! The possible values of a sweep parameter, and random draws from them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

/// The possible values of a parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Domain {
    /// One of these values.
    OneOf(Vec<Value>),
    /// An interval.
    Within(Interval),
}

/// An interval, ends included: `{ range = [a, b] }`, `{ log = [a, b] }` or `{ int = [a, b] }`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Interval {
    /// Uniform over numbers.
    Range([f64; 2]),
    /// Uniform over orders of magnitude.
    Log([f64; 2]),
    /// Uniform over whole numbers.
    Int([i64; 2]),
}

/// Draws one combination. It depends only on the seed, the trial number and the parameters' names.
pub fn draw(over: &BTreeMap<String, Domain>, seed: u64, trial: u64) -> BTreeMap<String, Value> {
    over.iter()
        .map(|(parameter, domain)| {
            let mut hash = Sha256::new();
            hash.update(b"trial");
            hash.update(seed.to_le_bytes());
            hash.update(trial.to_le_bytes());
            hash.update(parameter.as_bytes());
            let digest = hash.finalize();
            let bits = u64::from_le_bytes(digest[..8].try_into().expect("a digest has 32 bytes"));
            (parameter.clone(), domain.at(bits))
        })
        .collect()
}

impl Domain {
    /// Returns the fault of the domain, if any.
    pub(super) fn fault(&self) -> Option<String> {
        let ordered = |a: f64, b: f64| a.is_finite() && b.is_finite() && a < b;
        match self {
            Self::OneOf(values) => values.is_empty().then(|| "lists no value".into()),
            Self::Within(Interval::Range([a, b])) => {
                (!ordered(*a, *b)).then(|| format!("{a} must lie below {b}"))
            }
            Self::Within(Interval::Log([a, b])) => (!ordered(*a, *b) || *a <= 0.0)
                .then(|| format!("{a} must lie above 0 and below {b}")),
            Self::Within(Interval::Int([a, b])) => {
                (a >= b || b.checked_sub(*a).is_none()).then(|| format!("{a} must lie below {b}"))
            }
        }
    }

    /// Returns whether the domain contains a value.
    pub fn contains(&self, value: &Value) -> bool {
        match self {
            Self::OneOf(_) => self.position(value).is_some(),
            Self::Within(Interval::Range([a, b]) | Interval::Log([a, b])) => {
                value.as_f64().is_some_and(|x| (*a..=*b).contains(&x))
            }
            Self::Within(Interval::Int([a, b])) => {
                value.as_i64().is_some_and(|n| (*a..=*b).contains(&n))
            }
        }
    }

    /// Returns the position of a value in a list; `None` for an interval, or if the list does not
    /// contain it.
    pub fn position(&self, value: &Value) -> Option<usize> {
        match self {
            Self::OneOf(values) => values.iter().position(|other| alike(other, value)),
            Self::Within(_) => None,
        }
    }

    /// Returns the value for random bits. Numbers of an interval have four digits, which are
    /// readable and the same on every machine.
    fn at(&self, bits: u64) -> Value {
        let share = (bits >> 11) as f64 / (1u64 << 53) as f64;
        let whole = |n: u64| ((u128::from(bits) * u128::from(n)) >> 64) as u64;
        match self {
            Self::OneOf(values) => values[whole(values.len() as u64) as usize].clone(),
            Self::Within(Interval::Int([a, b])) => {
                json!(a.wrapping_add_unsigned(whole((b.wrapping_sub(*a) as u64).saturating_add(1))))
            }
            Self::Within(interval) => interval.at(share),
        }
    }
}

impl Interval {
    /// Returns the value at a fraction of the interval, in [0, 1]: with four digits, or whole.
    pub fn at(&self, share: f64) -> Value {
        let four = |x: f64, [a, b]: [f64; 2]| {
            let rounded: f64 = format!("{x:.3e}").parse().expect("a number");
            json!(rounded.clamp(a, b))
        };
        match self {
            Self::Range(ends) => four(ends[0] + share * (ends[1] - ends[0]), *ends),
            Self::Log(ends) => {
                let [a, b] = ends.map(libm::log);
                four(libm::exp(a + share * (b - a)), *ends)
            }
            Self::Int([a, b]) => {
                let n = b.wrapping_sub(*a) as u64;
                let step = (share * (n as f64 + 1.0)) as u64;
                json!(a.wrapping_add_unsigned(step.min(n)))
            }
        }
    }

    /// Returns the fraction of the interval at which a value is, in [0, 1]. For a whole number it
    /// is the middle of its step. Returns `None` for a value other than a number.
    pub fn share(&self, value: &Value) -> Option<f64> {
        let share = match self {
            Self::Range([a, b]) => (value.as_f64()? - a) / (b - a),
            Self::Log(ends) => {
                let [a, b] = ends.map(libm::log);
                (libm::log(value.as_f64()?) - a) / (b - a)
            }
            Self::Int([a, b]) => {
                let n = b.wrapping_sub(*a) as u64;
                (value.as_i64()?.wrapping_sub(*a) as f64 + 0.5) / (n as f64 + 1.0)
            }
        };
        share.is_finite().then(|| share.clamp(0.0, 1.0))
    }
}

/// Returns whether two values are equal as numbers, for example 8 and 8.0.
fn alike(a: &Value, b: &Value) -> bool {
    a == b || matches!((a.as_f64(), b.as_f64()), (Some(a), Some(b)) if a == b)
}
