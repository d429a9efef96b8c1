//! Where a training stands, and what it has seen.

use serde::{Deserialize, Serialize};

use crate::metric::Metrics;

/// Where a training stands, and what it has seen.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Position {
    /// Whole epochs done.
    pub epoch: u64,
    /// Batches done of the next one.
    pub batches: u64,
    /// Sum of the losses of the steps since the last line.
    pub losses: f64,
    /// Steps since then.
    pub steps: u64,
    /// The smallest validation loss so far.
    pub best: Option<f64>,
    /// Validations since then.
    pub since_best: u64,
    /// The step after which the weights are kept that count at the end; 0 = the last one.
    pub kept_step: u64,
    /// A line for each epoch done, and for each validation on the way.
    pub history: Vec<Line>,
    /// It ended before its last epoch, because it no longer became better.
    pub stopped_early: bool,
}

/// What is known at the end of an epoch, or of a validation on the way to it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// From 1.
    pub epoch: u64,
    /// The epoch went on after it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub within: bool,
    /// Steps of the optimiser until then.
    pub step: u64,
    /// Mean loss of the steps since the line before.
    pub loss: f64,
    /// Learning rate of the last step.
    pub learning_rate: f64,
    /// On the validation scenes, where there are any.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub validation: Option<Metrics>,
}

/// Where each line of a history lies, in epochs: the whole ones at whole numbers, those within in between.
pub fn epochs_at(history: &[Line]) -> impl Iterator<Item = (f64, &Line)> {
    let whole = history.iter().find(|line| !line.within);
    let steps = whole.map_or(0.0, |line| line.step as f64 / line.epoch as f64);
    history.iter().map(move |line| {
        let at = match line.within && steps > 0.0 {
            true => line.step as f64 / steps,
            false => line.epoch as f64,
        };
        (at, line)
    })
}
