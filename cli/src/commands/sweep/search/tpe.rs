//! Proposes values with the tree-structured Parzen estimator (Bergstra et al., "Algorithms for
//! Hyper-Parameter Optimization", NIPS 2011). From candidates drawn near the best trials, it
//! selects the one with the greatest ratio of the density among the best to the density among the
//! others.
//!
//! The best are ⌈0.1 n⌉ of n trials, at most 25, and 24 candidates are drawn. These are Optuna's
//! defaults; Watanabe, arXiv 2304.11127, describes the effect of each choice. Before [`STARTUP`]
//! trials have ended, values are drawn at random. Open trials and those just proposed count among
//! the others, so that a round does not propose the same values many times ("constant liar"). Tried
//! values are not proposed again, because a training with the same values is the same training.

use picofarm_proto::spec::domain;

use super::{Space, Tried, Values, parzen::Mixture, ranked};

/// Number of trials that must have ended before the estimator proposes anything.
pub const STARTUP: usize = 10;
/// Maximum number of best trials.
const MOST: usize = 25;
/// Candidates for each proposal.
const CANDIDATES: u64 = 24;
/// Number of random draws after which nothing is considered left to try.
const PATIENCE: u64 = 200;

/// Proposes the values of `count` further trials, numbered from `first`. Returns fewer if nothing
/// is left to try.
pub fn propose(space: &Space, tried: &[Tried], seed: u64, first: u64, count: u64) -> Vec<Values> {
    let ended = ranked(tried);
    let best = ended.len().div_ceil(10).min(MOST);
    let (good, bad) = ended.split_at(best);
    let good = Mixture::new(space, good.iter().map(|t| &t.values));
    let open = tried.iter().filter(|t| !t.outcome.ended());
    let others: Vec<&Values> = bad.iter().copied().chain(open).map(|t| &t.values).collect();
    let mut proposed: Vec<Values> = Vec::new();
    for trial in first..first.saturating_add(count) {
        let known = |values: &Values| {
            proposed.contains(values) || tried.iter().any(|t| t.values == *values)
        };
        let chosen = match ended.len() < STARTUP {
            true => None,
            false => {
                let others = others.iter().copied().chain(&proposed);
                let others = Mixture::new(space, others);
                let candidates = (0..CANDIDATES).map(|number| good.draw(seed, trial, number));
                let candidates = candidates.filter(|values| !known(values));
                let scored = candidates.map(|values| {
                    (
                        good.log_density(&values) - others.log_density(&values),
                        values,
                    )
                });
                scored.reduce(|a, b| if b.0 > a.0 { b } else { a })
            }
        };
        let chosen = chosen.map(|(_, values)| values);
        let Some(values) = chosen.or_else(|| at_random(space, seed, trial, known)) else {
            break;
        };
        proposed.push(values);
    }
    proposed
}

/// Returns random values of `count` further trials, numbered from `first`: those that the sweep
/// would draw, except values that were already tried.
pub fn random(space: &Space, tried: &[Tried], seed: u64, first: u64, count: u64) -> Vec<Values> {
    let mut proposed: Vec<Values> = Vec::new();
    for trial in first..first.saturating_add(count) {
        let known = |values: &Values| {
            proposed.contains(values) || tried.iter().any(|t| t.values == *values)
        };
        let Some(values) = at_random(space, seed, trial, known) else {
            break;
        };
        proposed.push(values);
    }
    proposed
}

/// Returns the trial's draw, or the first of further draws with values that were not tried.
fn at_random(
    space: &Space,
    seed: u64,
    trial: u64,
    known: impl Fn(&Values) -> bool,
) -> Option<Values> {
    let again = |attempt: u64| match attempt {
        0 => domain::draw(space, seed, trial),
        _ => domain::draw(space, super::bits(seed, "again", [trial, attempt]), trial),
    };
    (0..PATIENCE).map(again).find(|values| !known(values))
}
