//! Which values a sweep should try next ([`tpe`]).
//!
//! Pure functions of what trials have found: the same records give the same answers, on every machine. Randomness is
//! SHA-256 of a seed and of what is drawn.
//!
//! Written here rather than taken from crates.io: the crates there (`tpe`, `optimizer`, `hyperopt`, `parzen`) have generators
//! of random numbers of their own or a study that must hear of each trial as it goes, and use the platform's logarithm.
//! Here proposals must follow from records in a store alone, in rounds of any number, to the same digits everywhere.

mod parzen;
pub mod tpe;

use std::{cmp::Ordering, collections::BTreeMap};

use picofarm_proto::model::Domain;
use serde_json::Value;
use sha2::{Digest, Sha256};

/// The values that each parameter may have, by its name.
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
    /// It came to its end: how bad it is.
    Finished(f64),
    /// It fell behind others.
    Stopped {
        /// Epochs done.
        epochs: u64,
        /// How bad it was then.
        loss: f64,
    },
    /// Its numbers broke.
    Failed,
    /// It has not ended.
    Open,
}

impl Outcome {
    /// From the best to the worst: those that came to their end by their loss, those that stopped by how far they came and
    /// then by their loss, and those that failed. (So does Optuna's `TPESampler`.) Open ones come last.
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

/// Those that have ended, from the best to the worst; of equals the earlier one first.
fn ranked(tried: &[Tried]) -> Vec<&Tried> {
    let mut ended: Vec<&Tried> = tried.iter().filter(|t| t.outcome.ended()).collect();
    ended.sort_by(|a, b| a.outcome.order(&b.outcome));
    ended
}

/// Random bits that follow from what they are for.
fn bits(seed: u64, of: &str, numbers: [u64; 2]) -> u64 {
    let mut hash = Sha256::new();
    hash.update(seed.to_le_bytes());
    hash.update(numbers[0].to_le_bytes());
    hash.update(numbers[1].to_le_bytes());
    hash.update(of.as_bytes());
    let digest = hash.finalize();
    u64::from_le_bytes(digest[..8].try_into().expect("a digest has 32 bytes"))
}

/// A number in [0, 1) of random bits.
fn uniform(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1u64 << 53) as f64
}

/// A whole number below `n` of random bits.
fn below(n: usize, bits: u64) -> usize {
    ((u128::from(bits) * n as u128) >> 64) as usize
}
