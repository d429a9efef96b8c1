//! Training: from scenes to weights.

mod checkpoint;
mod clock;
mod engine;
mod event;
mod gradients;
pub mod group;
mod learner;
mod load;
mod loss;
mod order;
mod position;
mod run;
mod schedule;
mod segments;
mod validate;

use serde::{Deserialize, Serialize};

pub use checkpoint::{Snapshot, left_by};
pub use engine::Engine;
pub use event::{Control, Ended, Event, Sources, Trained};
pub use gradients::Gradients;
pub use learner::{Learner, predict};
pub use load::Loading;
pub use picofarm_settings::Schedule;
pub use position::{Line, Position, epochs_at};
pub use run::Training;
pub use schedule::Pace;

use crate::{ModelError, input::Question, net::NetSpec};

/// All settings that determine the result of a training, except for the scenes and the initial
/// weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// The question that the network learns to answer.
    pub question: Question,
    /// The network.
    pub net: NetSpec,
    /// The number of visits to each scene.
    pub epochs: u64,
    /// The number of examples in a batch.
    pub batch: usize,
    /// The number of batches in a step.
    pub accumulate: usize,
    /// The greatest learning rate.
    pub learning_rate: f64,
    /// The weight decay.
    pub decay: f64,
    /// The schedule of the learning rate.
    pub schedule: Schedule,
    /// For [`Schedule::Restarts`]: the number of epochs of the first cycle, and the factor by which
    /// each further cycle is longer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub restarts: Option<(u64, u64)>,
    /// The greatest norm of a step's gradient; unlimited if `None`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clip_norm: Option<f64>,
    /// The decay of an average of the weights. If set, the average is validated and stored instead
    /// of the weights.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ema: Option<f64>,
    /// Whether mirrored scenes are used too, if the target allows it.
    pub augment: bool,
    /// The number of validations without improvement after which the training ends; 0 = never.
    pub early_stop: u64,
    /// The number of steps between validations within an epoch; 0 = validate only at the end of
    /// each epoch.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub validate_every: u64,
    /// The seed of weights, order, spots and mirroring.
    pub seed: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero(n: &u64) -> bool {
    *n == 0
}

impl Plan {
    /// Returns the number of batches in an epoch over the given number of scenes. Remaining scenes
    /// are dropped.
    pub fn batches(&self, scenes: usize) -> u64 {
        let steps = scenes / (self.batch * self.accumulate);
        (steps * self.accumulate) as u64
    }

    /// Returns the number of steps of the whole training.
    pub fn steps(&self, scenes: usize) -> u64 {
        self.epochs * self.batches(scenes) / self.accumulate as u64
    }

    /// Checks the plan for consistency, and against the number of training scenes.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] naming the first field that cannot be used.
    pub fn check(&self, scenes: usize) -> Result<(), ModelError> {
        self.net.check()?;
        self.question.check(&self.net)?;
        if self.batch == 0 || self.accumulate == 0 || self.epochs == 0 {
            let what = "epochs, batch and accumulate must be at least 1";
            return Err(ModelError::invalid("optimise", what));
        }
        if self.batches(scenes) == 0 {
            let what = format!(
                "a step takes {} × {} scenes and there are {scenes} to learn from; make it smaller",
                self.batch, self.accumulate
            );
            return Err(ModelError::invalid("optimise.batch", what));
        }
        let positive = self.learning_rate > 0.0 && self.learning_rate.is_finite();
        if !positive || !(0.0..1.0).contains(&self.decay) {
            let what = "learning_rate must be positive, weight_decay in 0..1";
            return Err(ModelError::invalid("optimise", what));
        }
        if self
            .clip_norm
            .is_some_and(|norm| !(norm > 0.0 && norm.is_finite()))
        {
            return Err(ModelError::invalid(
                "optimise.clip_norm",
                "must be positive",
            ));
        }
        if self.ema.is_some_and(|decay| !(0.0..1.0).contains(&decay)) {
            return Err(ModelError::invalid("optimise.ema", "must lie in 0..1"));
        }
        schedule::check(self, scenes)
    }

    pub(crate) fn text(&self) -> String {
        serde_json::to_string(self).expect("plain data")
    }
}
