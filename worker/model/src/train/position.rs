//! The position of a training, and its history.

use serde::{Deserialize, Serialize};

use crate::metric::Metrics;

/// The position of a training, and its history.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Position {
    /// The number of finished epochs.
    pub epoch: u64,
    /// The number of finished batches of the next epoch.
    pub batches: u64,
    /// The sum of the losses of the steps since the last line.
    pub losses: f64,
    /// The number of steps since the last line.
    pub steps: u64,
    /// The smallest validation loss so far.
    pub best: Option<f64>,
    /// The number of validations since the best one.
    pub since_best: u64,
    /// The step with the weights that the training returns; 0 = the last one.
    pub kept_step: u64,
    /// A line for each finished epoch, and for each validation within an epoch.
    pub history: Vec<Line>,
    /// Whether the training ended before its last epoch because it no longer improved.
    pub stopped_early: bool,
}

/// The figures at the end of an epoch, or at a validation within one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// The epoch, from 1.
    pub epoch: u64,
    /// Whether the line was written within the epoch.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub within: bool,
    /// The number of optimiser steps up to this line.
    pub step: u64,
    /// The mean loss of the steps since the previous line.
    pub loss: f64,
    /// The learning rate of the last step.
    pub learning_rate: f64,
    /// The metrics on the validation scenes, if there are any.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub validation: Option<Metrics>,
}

/// Returns each line of a history with its time in epochs: a whole number at the end of an epoch, a
/// fraction within one.
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
