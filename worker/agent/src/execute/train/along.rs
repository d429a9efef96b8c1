//! What happens along a training: it is saved, and it tells how far it is.

use std::time::Duration;

use bytes::Bytes;
use picofarm_dataset::{DatasetError, Models};
use picofarm_model::Event;
use tokio::task::JoinHandle;
use tracing::{info, warn};

use crate::execute::{Control, output::Stores};

/// How long a training that shall stop may take to save what it has reached.
const LAST_SAVE: Duration = Duration::from_secs(240);
/// Share of a task's progress that is training.
const TRAINED: f32 = 0.99;
/// Lines of an epoch that a task logs at most: its allowance holds few more.
const LINES: u32 = 80;

/// Saves checkpoints while the training goes on, one at a time.
pub(super) struct Saver<'a> {
    stores: &'a Stores,
    models: &'a Models,
    name: &'a str,
    key: &'a str,
    under_way: Option<JoinHandle<Result<(), DatasetError>>>,
}

impl<'a> Saver<'a> {
    pub(super) fn new(stores: &'a Stores, models: &'a Models, name: &'a str, key: &'a str) -> Self {
        Self {
            stores,
            models,
            name,
            key,
            under_way: None,
        }
    }

    pub(super) fn save(&mut self, step: u64, content: Bytes) {
        self.last();
        let (models, name, key) = (
            self.models.clone(),
            self.name.to_owned(),
            self.key.to_owned(),
        );
        let put = async move { models.put_checkpoint(&name, &key, step, content).await };
        self.under_way = Some(self.stores.runtime().spawn(put));
    }

    /// Waits for the checkpoint that is under way. Without it, the training goes on from the one before.
    pub(super) fn last(&mut self) {
        let Some(under_way) = self.under_way.take() else {
            return;
        };
        let within = async { tokio::time::timeout(LAST_SAVE, under_way).await };
        match self.stores.runtime().block_on(within) {
            Ok(Ok(Ok(()))) => {}
            Ok(Ok(Err(error))) => warn!(%error, "a checkpoint was not saved"),
            Ok(Err(error)) => warn!(%error, "a checkpoint was not saved: saving broke down"),
            Err(_) => warn!(
                "a checkpoint was not saved within {} s",
                LAST_SAVE.as_secs()
            ),
        }
    }
}

/// Tells the task's control and its log how far the training is.
pub(super) struct Teller<'a> {
    control: &'a Control,
    epochs: u32,
    told: u32,
}

impl<'a> Teller<'a> {
    pub(super) fn new(control: &'a Control, epochs: u32) -> Self {
        let told = 0;
        Self {
            control,
            epochs,
            told,
        }
    }

    pub(super) fn hear(&mut self, event: &Event) {
        match event {
            Event::Step {
                step,
                of,
                epoch,
                loss,
                samples_per_s,
                data_wait_share,
            } => {
                let fraction = *step as f32 / (*of).max(1) as f32;
                self.control.at(fraction * TRAINED);
                let text = format!(
                    "epoch {}/{}, loss {loss:.4}, {samples_per_s:.1} samples/s",
                    (epoch + 1).min(self.epochs),
                    self.epochs
                );
                let figures = [
                    ("step", *step as f64),
                    ("steps", *of as f64),
                    ("epoch", f64::from(*epoch)),
                    ("loss", f64::from(*loss)),
                    ("samples_per_s", f64::from(*samples_per_s)),
                    ("data_wait_share", f64::from(*data_wait_share)),
                ];
                self.control.say(text, &figures);
            }
            Event::Validated { epoch, metrics } => {
                // All of few epochs, every so many of many, and the last.
                let between = self.epochs.div_ceil(LINES);
                if *epoch >= self.told + between || *epoch == self.epochs {
                    self.told = *epoch;
                    info!("epoch {epoch}/{}: {metrics}", self.epochs);
                }
            }
        }
    }
}
