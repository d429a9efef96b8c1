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
    /// Sum of the losses of this epoch's steps.
    pub losses: f64,
    /// Steps of this epoch.
    pub steps: u64,
    /// The smallest validation loss so far.
    pub best: Option<f64>,
    /// Validations since then.
    pub since_best: u64,
    /// The epoch, from 1, after which the weights are kept that count at the end; 0 = the last one.
    #[serde(default)]
    pub kept_epoch: u64,
    /// A line for each epoch done.
    pub history: Vec<Line>,
    /// It ended before its last epoch, because it no longer became better.
    pub stopped_early: bool,
}

/// An epoch.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Line {
    /// From 1.
    pub epoch: u64,
    /// Steps of the optimiser until then.
    pub step: u64,
    /// Mean loss of its steps.
    pub loss: f64,
    /// Learning rate of its last step.
    pub learning_rate: f64,
    /// On the validation scenes, where there are any.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub validation: Option<Metrics>,
}
