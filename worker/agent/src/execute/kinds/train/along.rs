//! What happens along a training: it tells how far it is.

use picofarm_model::{
    metric::Metrics,
    train::{Event, Line, Loading},
};
use tracing::info;

use crate::execute::Control;

/// Share of a task's progress that is training.
const TRAINED: f32 = 0.99;
/// Lines of an epoch that a task logs at most: its allowance holds few more.
const LINES: u32 = 80;

/// One part of so many of the memory that is left beside the task holds scenes that are made ready for the network.
const AHEAD_SHARE: u64 = 8;

/// How scenes are made ready: by as many threads as the task has, in a part of the memory that is left beside it, MiB; `None`
/// = not known.
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

/// Tells the task's control and its log how far the training is.
pub(super) struct Reporter<'a> {
    control: &'a Control,
    epochs: u32,
    reported: u64,
    /// The latest figure of the validation scenes: MAE in metres, or one less IoU.
    validation: Option<(&'static str, f64)>,
    /// Training examples a second, and share of the time in which the network waited for data.
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

    /// Training examples a second, and the share of waiting for data, as last heard.
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
                // All of few epochs, every so many of many, and the last.
                let between = u64::from(self.epochs.div_ceil(LINES));
                if line.epoch >= self.reported + between || line.epoch == u64::from(self.epochs) {
                    self.reported = line.epoch;
                    info!("epoch {}/{}: {}", line.epoch, self.epochs, summary(line));
                }
            }
        }
    }
}

/// An epoch for people.
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
