//! Early stopping of trials in a sweep: the rules, and the epochs after which a trial is checked.
//! The earlier results of other trials are in the store, and the training worker compares with them
//! (`worker/tasks`, `trial/verdict.rs`).
//!
//! - **Halving** is the stopping variant of ASHA (Li et al., "A System for Massively Parallel
//!   Hyperparameter Tuning", MLSys 2020). A trial that reaches a rung continues if it is among the
//!   best 1/factor of the trials that have reached the rung by then.
//! - **Median** is the rule of Optuna's `MedianPruner`, after Vizier's (Golovin et al., KDD 2017).
//!   A trial stops at a check if its best value so far is worse than the median of the others'
//!   values at that epoch. Vizier compares with running averages over epochs instead. The error of
//!   a network falls so fast at first that such an average describes mostly the first epochs, and
//!   hardly any trial would stop. Other trials count once they have come as far; they need not have
//!   ended.
//! - **Hyperband** (Li et al., JMLR 2018), asynchronous as in the first paper. Trials are dealt to
//!   brackets by their number, and each bracket is a separate halving, compared within itself.
//!   Bracket 0 has all rungs, each further bracket lacks one more of the first, and the last has
//!   none. A bracket gets about the fraction of trials that Hyperband gives it, so that each may
//!   use as many epochs. It suits sweeps with misleading early errors.

use serde::{Deserialize, Serialize};

use super::spec_error::SpecError;

/// The rule that stops inferior trials.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stop {
    /// At rungs, only the best trials continue.
    Halving(Halving),
    /// Stops trials that are worse than the median of the others.
    Median(Median),
    /// Several halvings in parallel, which begin at increasing epochs.
    Hyperband(Halving),
}

/// The rungs, and the fraction of trials that continues.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Halving {
    /// Epochs until the first rung.
    pub first: u32,
    /// Ratio of the epochs of consecutive rungs. At each rung, one in this many trials continues.
    #[serde(default = "three")]
    pub factor: u32,
}

/// The checks, and the number of other trials required.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Median {
    /// Epochs until the first check.
    pub first: u32,
    /// Epochs from one check to the next.
    #[serde(default = "one")]
    pub every: u32,
    /// Other trials that must have reached a check before a trial may stop there. Optuna's default.
    #[serde(default = "five")]
    pub least: u32,
}

fn one() -> u32 {
    1
}

fn three() -> u32 {
    3
}

fn five() -> u32 {
    5
}

impl Stop {
    /// Returns whether trial `index` is checked after this many epochs of `of`. It never is at its
    /// end.
    pub fn asks(&self, index: u64, epoch: u64, of: u64) -> bool {
        match self {
            Self::Halving(halving) => halving.is_rung(epoch, of),
            Self::Hyperband(halving) => {
                let rungs = halving.rungs(of);
                let left_out = self.bracket(index, of) as usize;
                rungs.iter().skip(left_out).any(|rung| *rung == epoch)
            }
            Self::Median(median) => {
                let (first, every) = (u64::from(median.first), u64::from(median.every).max(1));
                epoch < of && epoch >= first && (epoch - first).is_multiple_of(every)
            }
        }
    }

    /// Returns the bracket of trial `index` for trainings of `of` epochs. Trials are compared
    /// within their bracket.
    pub fn bracket(&self, index: u64, of: u64) -> u32 {
        match self {
            Self::Halving(_) | Self::Median(_) => 0,
            Self::Hyperband(halving) => dealt(&halving.shares(of), index),
        }
    }

    pub(super) fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: &str| {
            let field = format!("sweep.stop.{}.{field}", self.name());
            Err(SpecError::new(field, what.to_owned()))
        };
        match self {
            Self::Halving(halving) | Self::Hyperband(halving) => {
                if halving.first == 0 {
                    return fail("first", "must be at least 1 epoch");
                }
                if halving.factor < 2 {
                    return fail(
                        "factor",
                        "must be at least 2: one in so many trials goes on",
                    );
                }
            }
            Self::Median(median) => {
                if median.first == 0 {
                    return fail("first", "must be at least 1 epoch");
                }
                if median.every == 0 {
                    return fail("every", "must be at least 1 epoch");
                }
                if median.least == 0 {
                    return fail("least", "must be at least 1 trial to compare with");
                }
            }
        }
        Ok(())
    }

    fn name(&self) -> &'static str {
        match self {
            Self::Halving(_) => "halving",
            Self::Median(_) => "median",
            Self::Hyperband(_) => "hyperband",
        }
    }
}

impl Halving {
    /// Returns whether this epoch of `of` is a rung. The end is none.
    pub fn is_rung(&self, epoch: u64, of: u64) -> bool {
        self.rungs(of).contains(&epoch)
    }

    /// Returns the epochs of all rungs before the end.
    fn rungs(self, of: u64) -> Vec<u64> {
        let (factor, mut rung) = (u64::from(self.factor).max(2), u64::from(self.first).max(1));
        let mut rungs = Vec::new();
        while rung < of {
            rungs.push(rung);
            rung = rung.saturating_mul(factor);
        }
        rungs
    }

    /// Returns the number of trials of each bracket in a round of Hyperband: with s rungs of B − 1,
    /// ⌈B/(s+1)·factor^s⌉ (algorithm 1).
    fn shares(self, of: u64) -> Vec<u64> {
        let rungs = self.rungs(of).len() as u32;
        let brackets = u64::from(rungs) + 1;
        (0..=rungs)
            .rev()
            .map(|s| {
                let trials = brackets.saturating_mul(u64::from(self.factor).saturating_pow(s));
                trials.div_ceil(u64::from(s) + 1)
            })
            .collect()
    }
}

/// Returns the bracket to which a trial number is dealt, given each bracket's share. The turns keep
/// to the shares throughout ("smooth weighted round robin"), so that the first few trials are not
/// all in one bracket.
fn dealt(shares: &[u64], index: u64) -> u32 {
    let total: i128 = shares.iter().map(|share| i128::from(*share)).sum();
    let turns = i128::from(index) % total.max(1);
    let mut due = vec![0i128; shares.len()];
    let mut next = 0;
    for _ in 0..=turns {
        for (due, share) in due.iter_mut().zip(shares) {
            *due += i128::from(*share);
        }
        // The first of the greatest.
        next = (0..due.len()).rev().max_by_key(|i| due[*i]).unwrap_or(0);
        due[next] -= total;
    }
    next as u32
}
