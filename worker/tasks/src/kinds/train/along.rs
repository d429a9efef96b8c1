//! Reports the progress of a training while it runs.

use picofarm_model::{
    metric::Metrics,
    train::{Event, Line, Loading},
};
use tracing::info;

use crate::task::Control;

/// Share of training in a task's progress.
const TRAINED: f32 = 0.99;
/// Maximum number of log lines about epochs, because a task's log allowance is not much larger.
const LINES: u32 = 80;

/// Scenes prepared ahead of the network may use 1/`AHEAD_SHARE` of a task's spare memory.
const AHEAD_SHARE: u64 = 8;

/// Returns how scenes are prepared: with as many threads as the task has, in a share of the memory
/// left to the task (`left_mib`, MiB; `None` = unknown).
pub(super) fn loading(left_mib: Option<u64>) -> Loading {
    let standard = Loading::default();
    match left_mib {
        None => standard,
        Some(mib) => Loading {
            room: usize::try_from(mib / AHEAD_SHARE).map_or(usize::MAX, |mib| mib << 20),
            ..standard
        },
    }
}

/// Reports the training's progress to the task's control and log.
pub(super) struct Reporter<'a> {
    control: &'a Control,
    epochs: u32,
    reported: u64,
    /// The latest metric of the validation scenes, by name: MAE in metres, or 1 − IoU.
    validation: Option<(&'static str, f64)>,
    /// Training examples per second, and the share of time in which the network waited for data.
    pace: Option<(f64, f64)>,
}

impl<'a> Reporter<'a> {
    pub(super) fn new(control: &'a Control, epochs: u32) -> Self {
        Self {
            control,
            epochs,
            reported: 0,
            validation: None,
            pace: None,
        }
    }

    /// Returns the latest training examples per second and share of time spent waiting for data.
    pub(super) fn pace(&self) -> Option<(f64, f64)> {
        self.pace
    }

    fn validated(&mut self, line: &Line) {
        self.validation = line
            .validation
            .map(|found| ("validation_loss", found.loss()));
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
                self.control
                    .at(*step as f32 / (*of).max(1) as f32 * TRAINED);
                self.pace = Some((*samples_per_s, *data_wait_share));
                let text = format!(
                    "epoch {epoch}/{}, loss {loss:.4}, {samples_per_s:.1} samples/s",
                    self.epochs
                );
                let figures = [
                    ("step", *step as f64),
                    ("steps", *of as f64),
                    ("epoch", *epoch as f64),
                    ("loss", f64::from(*loss)),
                    ("samples_per_s", *samples_per_s),
                    ("data_wait_share", *data_wait_share),
                ];
                let figures: Vec<(&str, f64)> =
                    figures.into_iter().chain(self.validation).collect();
                self.control.say(text, &figures);
            }
            Event::Validated(line) => self.validated(line),
            Event::Epoch(line) => {
                self.validated(line);
                // Logs every epoch of a short training; of a long one, epochs at regular intervals
                // and the last.
                let between = u64::from(self.epochs.div_ceil(LINES));
                if line.epoch >= self.reported + between || line.epoch == u64::from(self.epochs) {
                    self.reported = line.epoch;
                    info!("epoch {}/{}: {}", line.epoch, self.epochs, summary(line));
                }
            }
        }
    }
}

/// Formats an epoch for the log.
fn summary(line: &Line) -> String {
    let loss = format!("loss {:.4}", line.loss);
    match line.validation {
        None => loss,
        Some(Metrics::Depth { mae_m, rmse_m }) => {
            format!("{loss}; validation MAE {mae_m:.4} m, RMSE {rmse_m:.4} m")
        }
        Some(Metrics::Mask { mae, iou, f1 }) => {
            format!("{loss}; validation IoU {iou:.4}, MAE {mae:.4}, F1 {f1:.4}")
        }
    }
}
