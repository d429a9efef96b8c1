//! Which values a sweep should try next ([`tpe`]).
//!
//! All functions are pure functions of the trials' results: the same records give the same answers
//! on every machine. Random numbers are SHA-256 of a seed and of their purpose.
//!
//! The crates on crates.io (`tpe`, `optimizer`, `hyperopt`, `parzen`) do not fit: they have their
//! own random number generators or a study object that must observe each trial as it runs, and use
//! the platform's logarithm. Here, proposals must follow from stored records alone, in rounds of
//! any size, and be identical to the last digit everywhere.

mod parzen;
#[cfg(test)]
mod tests;
pub mod tpe;

use std::{cmp::Ordering, collections::BTreeMap};

use picofarm_proto::spec::Domain;
use serde_json::Value;
use sha2::{Digest, Sha256};

/// The possible values of each parameter, by its name.
pub type Space = BTreeMap<String, Domain>;
/// A trial's values, by the parameters' names.
pub type Values = BTreeMap<String, Value>;

/// A trial.
#[derive(Debug, Clone, PartialEq)]
pub struct Tried {
    /// Its values.
    pub values: Values,
    /// How it ended.
    pub outcome: Outcome,
}

/// How a trial ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// It finished, with this loss.
    Finished(f64),
    /// It was stopped because it had fallen behind other trials.
    Stopped {
        /// Number of epochs done.
        epochs: u64,
        /// Loss at that point.
        loss: f64,
    },
    /// It failed because its numbers diverged.
    Failed,
    /// It has not ended.
    Open,
}

impl Outcome {
    /// Orders outcomes from best to worst: finished trials by their loss, stopped trials by their
    /// epochs and then by their loss, and failed trials, as Optuna's `TPESampler` does. Open trials
    /// come last.
    fn order(&self, other: &Self) -> Ordering {
        let key = |outcome: &Self| match *outcome {
            Self::Finished(loss) => (0, 0, loss),
            Self::Stopped { epochs, loss } => (1, u64::MAX - epochs, loss),
            Self::Failed => (2, 0, 0.0),
            Self::Open => (3, 0, 0.0),
        };
        let (a, b) = (key(self), key(other));
        (a.0, a.1).cmp(&(b.0, b.1)).then(a.2.total_cmp(&b.2))
    }

    fn ended(&self) -> bool {
        *self != Self::Open
    }
}

/// Returns the trials that have ended, from best to worst. Of equal trials, the earlier one comes
/// first.
fn ranked(tried: &[Tried]) -> Vec<&Tried> {
    let mut ended: Vec<&Tried> = tried.iter().filter(|t| t.outcome.ended()).collect();
    ended.sort_by(|a, b| a.outcome.order(&b.outcome));
    ended
}

/// Returns random bits derived from their purpose.
fn bits(seed: u64, of: &str, numbers: [u64; 2]) -> u64 {
    let mut hash = Sha256::new();
    hash.update(seed.to_le_bytes());
    hash.update(numbers[0].to_le_bytes());
    hash.update(numbers[1].to_le_bytes());
    hash.update(of.as_bytes());
    let digest = hash.finalize();
    u64::from_le_bytes(digest[..8].try_into().expect("a digest has 32 bytes"))
}

/// Converts random bits to a number in [0, 1).
fn uniform(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1u64 << 53) as f64
}

/// Converts random bits to an integer below `n`.
fn below(n: usize, bits: u64) -> usize {
    ((u128::from(bits) * n as u128) >> 64) as usize
}
