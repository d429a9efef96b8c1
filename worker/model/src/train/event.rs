//! What a training reads, reports and returns.

use std::sync::Arc;

use super::position::Line;
use crate::scene::Scenes;

/// An event of a training.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// A finished optimiser step.
    Step {
        /// The number of finished steps.
        step: u64,
        /// The number of steps of the whole training.
        of: u64,
        /// The current epoch, from 1.
        epoch: u64,
        /// The mean loss of the step.
        loss: f32,
        /// Training examples per second, over all processes of the training, since this process
        /// started or resumed.
        samples_per_s: f64,
        /// The share of that time in which the network waited for data.
        data_wait_share: f64,
    },
    /// A validation within an epoch.
    Validated(Line),
    /// The end of an epoch.
    Epoch(Line),
}

/// Whether to continue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// Continue.
    Continue,
    /// Stop after this step.
    Stop,
}

/// The reason why a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// The training is finished.
    Finished,
    /// The caller stopped the training; it can resume from a checkpoint.
    Stopped,
    /// The training is finished, and another process stores the result.
    Elsewhere,
}

/// The scenes of a training.
pub struct Sources {
    /// The training scenes.
    pub train: Arc<dyn Scenes>,
    /// The validation scenes, evaluated after each epoch; may be empty.
    pub validation: Arc<dyn Scenes>,
}

/// The result of a training.
#[derive(Debug, Clone)]
pub struct Trained {
    /// The weights as safetensors, by PyTorch's names.
    pub weights: Vec<u8>,
    /// A line for each epoch, and for each validation within one.
    pub history: Vec<Line>,
    /// Whether the training ended before its last epoch.
    pub stopped_early: bool,
    /// The step that produced these weights: with `early_stop` the one with the best validation,
    /// else the last.
    pub kept_step: u64,
}

impl Trained {
    /// Returns the line with the metrics of these weights.
    pub fn kept(&self) -> Option<&Line> {
        self.history.iter().find(|line| line.step == self.kept_step)
    }

    /// Returns the number of whole epochs.
    pub fn epochs(&self) -> usize {
        self.history.iter().filter(|line| !line.within).count()
    }
}
