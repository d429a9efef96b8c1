//! The training as a trial of a sweep.

use picofarm_model::{metric::Metrics, train::Line};
use picofarm_proto::spec::Trial;
use picofarm_results::{ModelManifest, TrialEnd};
use serde_json::Value;

use super::{TrainingRun, results::lines_of};
use crate::{
    stores::Stores,
    task::{Control, Output, TaskError},
    trial::{AtEpoch, Course, EndedTrial, Learner},
};

/// Name of the object with a model's epochs.
pub(super) const HISTORY: &str = "history.jsonl";

/// Returns the trial of a training.
pub(super) fn open<'a>(
    stores: &'a Stores,
    training: &'a TrainingRun<'_>,
    trial: &'a Trial,
) -> Result<Course<'a>, TaskError> {
    if training.validation_is_empty() {
        let what = format!(
            "sweep: the split {:?} has no validation scenes to compare trials by; give it some",
            training.split()
        );
        return Err(TaskError::User(what));
    }
    let settings = training.settings();
    let learner = Learner {
        model: &settings.model,
        kind: settings.target.name(),
        key: &training.key,
    };
    Ok(Course::new((stores, &training.models), learner, trial))
}

/// Returns the trial's state after a line of the history. `best` is its lowest loss so far.
pub(super) fn at(line: &Line, best: Option<f64>, of: u32) -> AtEpoch {
    AtEpoch {
        epoch: line.epoch,
        of: of.into(),
        loss: line.validation.map(|found| found.loss()),
        best,
    }
}

/// Returns the figures of a trial that ended before its training.
pub(super) fn ended(end: TrialEnd, history: &[Line]) -> EndedTrial {
    let last = history.last();
    EndedTrial {
        end,
        epochs: last.map_or(0, |line| line.epoch),
        loss: last.and_then(|line| line.validation.as_ref().map(Metrics::loss)),
        history: history.iter().map(of_line).collect(),
    }
}

/// Records that the trial finished with the stored model.
pub(super) fn finished(
    course: &Course<'_>,
    (stores, training): (&Stores, &TrainingRun<'_>),
    (manifest, adopted): (&ModelManifest, bool),
    control: &Control,
) -> Result<Output, TaskError> {
    let history = training.models.read(manifest, HISTORY);
    let history = stores.wait(control, history)?;
    let history = lines_of(&history).map_err(TaskError::Crash)?;
    // Loss of the epoch from which the weights are.
    let kept = manifest.metrics.get("validation").cloned();
    let kept = kept.and_then(|found| serde_json::from_value::<Metrics>(found).ok());
    let ended = EndedTrial {
        loss: kept.map(|found| found.loss()),
        ..ended(TrialEnd::Finished, &history)
    };
    course.finished(ended, (manifest, adopted), control)
}

fn of_line(line: &Line) -> Value {
    serde_json::to_value(line).expect("figures are plain data")
}
