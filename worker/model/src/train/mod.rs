//! Training: from scenes to weights.

mod checkpoint;
pub mod group;
mod learner;
mod load;
mod loss;
mod order;
mod position;
mod run;
mod schedule;
mod segments;

use serde::{Deserialize, Serialize};

pub use checkpoint::{Snapshot, left_by};
pub use learner::{Gradients, Learner, predict};
pub use load::Loading;
pub use picofarm_settings::Schedule;
pub use position::{Line, Position, epochs_at};
pub use run::{Control, Ended, Event, Sources, Trained, Training};
pub use schedule::Pace;

use crate::{ModelError, input::Question, net::NetSpec};

/// Everything that decides what a training gives, but the scenes and the weights it begins with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// What is asked.
    pub question: Question,
    /// The network that learns to answer.
    pub net: NetSpec,
    /// Times that each scene is visited.
    pub epochs: u64,
    /// Examples a batch.
    pub batch: usize,
    /// Batches a step.
    pub accumulate: usize,
    /// Greatest learning rate.
    pub learning_rate: f64,
    /// Weight decay.
    pub decay: f64,
    /// How the rate moves.
    pub schedule: Schedule,
    /// Epochs of the first cycle, and how many times as long each further one is: for [`Schedule::Restarts`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub restarts: Option<(u64, u64)>,
    /// Greatest norm of a step's gradient; none without it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clip_norm: Option<f64>,
    /// Decay of an average of the weights that is validated and kept in their place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ema: Option<f64>,
    /// Mirrored scenes are shown too, where the target allows it.
    pub augment: bool,
    /// Validations without improvement after which it ends; 0 = never.
    pub early_stop: u64,
    /// Steps after which it is validated within an epoch too; 0 = at the end of each only.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub validate_every: u64,
    /// Of weights, order, spots and mirroring.
    pub seed: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero(n: &u64) -> bool {
    *n == 0
}

impl Plan {
    /// Batches of an epoch over so many scenes, those left over dropped.
    pub fn batches(&self, scenes: usize) -> u64 {
        let steps = scenes / (self.batch * self.accumulate);
        (steps * self.accumulate) as u64
    }

    /// Steps of the whole training.
    pub fn steps(&self, scenes: usize) -> u64 {
        self.epochs * self.batches(scenes) / self.accumulate as u64
    }

    /// Checks it against itself and the number of scenes to learn from.
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
