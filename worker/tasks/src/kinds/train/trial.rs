//! A sweep's trial. At certain epochs (rungs), the training compares itself with the trials that
//! have also reached them, and stops if it has fallen behind. Its outcome is recorded under the
//! sweep's name and is the task's result.

use picofarm_model::{metric::Metrics, train::Line};
use picofarm_proto::spec::{Domain, Trial};
use picofarm_results::{ModelManifest, Models, Rung, TrialEnd, TrialRecord};
use picofarm_store::published::Manifest as _;
use serde_json::Value;
use tracing::info;

use super::{
    TrainingRun,
    results::lines_of,
    verdict::{Verdict, verdict},
};
use crate::{
    stores::Stores,
    task::{Control, Output, TaskError},
};

/// Name of the object with a model's epochs.
pub(super) const HISTORY: &str = "history.jsonl";

/// A running trial.
pub(super) struct Course<'a> {
    stores: &'a Stores,
    training: &'a TrainingRun<'a>,
    trial: &'a Trial,
    /// Earlier outcome of the trial, if it must end in the same way again.
    again: Option<TrialRecord>,
}

/// A training that was pruned before its end.
pub(super) struct EndedTrial {
    pub(super) end: TrialEnd,
    pub(super) history: Vec<Line>,
}

impl<'a> Course<'a> {
    /// Returns the trial of a training.
    pub(super) fn open(
        stores: &'a Stores,
        training: &'a TrainingRun<'a>,
        trial: &'a Trial,
    ) -> Result<Self, TaskError> {
        if training.validation_is_empty() {
            let what = format!(
                "sweep: the split {:?} has no validation scenes to compare trials by; give it some",
                training.split()
            );
            return Err(TaskError::User(what));
        }
        Ok(Self {
            stores,
            training,
            trial,
            again: None,
        })
    }

    /// Returns the trial's recorded outcome. With `force`, returns `None` and makes the trial end
    /// in the same way again.
    pub(super) fn ended(
        &mut self,
        force: bool,
        control: &Control,
    ) -> Result<Option<TrialRecord>, TaskError> {
        let trial = self.trial;
        let looked = self.models().trial(&trial.sweep, &trial.id, trial.index);
        let found = self.stores.wait(control, looked)?;
        if let Some(found) = &found
            && found.training_key != self.training.key
        {
            let what = format!(
                "sweep: trial {} of {:?} is another training by now (key {}, this one's is {}): its values or the data set have changed; \
                 choose another name for the model",
                trial.index, trial.sweep, found.training_key, self.training.key
            );
            return Err(TaskError::User(what));
        }
        if force {
            self.again = found;
            return Ok(None);
        }
        if let Some(ended) = &found {
            // The worker that recorded the outcome may have died before it deleted the checkpoints.
            self.forget(ended, control)?;
        }
        Ok(found)
    }

    /// Returns whether the trial continues after an epoch of `of`. `best` is its lowest loss so
    /// far.
    pub(super) fn goes_on(
        &self,
        line: &Line,
        best: Option<f64>,
        of: u32,
        control: &Control,
    ) -> Result<bool, TaskError> {
        if let Some(again) = &self.again {
            return Ok(again.end != TrialEnd::Pruned || again.epochs != line.epoch);
        }
        let trial = self.trial;
        let of = u64::from(of);
        let asked = trial
            .stop
            .filter(|stop| stop.asks(trial.index, line.epoch, of));
        let (Some(stop), Some(found)) = (asked, line.validation) else {
            return Ok(true);
        };
        let ours = Rung {
            index: trial.index,
            epochs: line.epoch,
            loss: found.loss(),
        };
        let (models, sweep, id) = (self.models(), &*trial.sweep, &*trial.id);
        let written = async || models.put_rung(sweep, id, &ours).await;
        self.stores.patiently(control, written)?;
        let mut there = self
            .stores
            .wait(control, models.rung(sweep, id, line.epoch))?;
        let bracket = stop.bracket(trial.index, of);
        there.retain(|other| stop.bracket(other.index, of) == bracket);
        let Verdict { goes_on, why } = verdict(&stop, &ours, best.unwrap_or(ours.loss), &there);
        let then = if goes_on { "goes on" } else { "stops" };
        info!(
            "trial {} after {} epochs {why}: it {then}",
            trial.index, line.epoch
        );
        Ok(goes_on)
    }

    /// Records that the trial finished with the stored model.
    pub(super) fn finished(
        &self,
        manifest: &ModelManifest,
        adopted: bool,
        control: &Control,
    ) -> Result<Output, TaskError> {
        let history = self.models().read(manifest, HISTORY);
        let history = self.stores.wait(control, history)?;
        let history = lines_of(&history).map_err(TaskError::Crash)?;
        let mut record = self.record(TrialEnd::Finished, history);
        // Loss of the epoch from which the weights are.
        let kept = manifest.metrics.get("validation").cloned();
        let kept = kept.and_then(|found| serde_json::from_value::<Metrics>(found).ok());
        record.loss = kept.map(|found| found.loss());
        self.tell(&record, manifest.total_bytes(), adopted, control)
    }

    /// Records that the trial was pruned, and deletes its checkpoints.
    pub(super) fn left(&self, left: EndedTrial, control: &Control) -> Result<Output, TaskError> {
        let EndedTrial { end, history } = left;
        let record = self.record(end, history);
        let output = self.tell(&record, record.to_bytes().len() as u64, false, control)?;
        self.forget(&record, control)?;
        Ok(output)
    }

    /// Deletes the checkpoints of a trial that has ended.
    fn forget(&self, record: &TrialRecord, control: &Control) -> Result<(), TaskError> {
        let (name, key) = (&record.model, &record.training_key);
        let deleted = self.models().delete_checkpoints(name, key);
        self.stores.wait(control, deleted)
    }

    fn tell(
        &self,
        record: &TrialRecord,
        bytes: u64,
        adopted: bool,
        control: &Control,
    ) -> Result<Output, TaskError> {
        let put = async || self.models().put_trial(record).await;
        let stands = self.stores.patiently(control, put)?;
        if self.again.is_some() && stands != *record {
            let what = format!(
                "trial {} of {:?} came to another end than before: {:?} after {} epochs, and {:?} after {} before",
                record.index, record.sweep, record.end, record.epochs, stands.end, stands.epochs
            );
            return Err(TaskError::Crash(what));
        }
        control.at(1.0);
        Ok(Output {
            manifest_sha256: stands.sha256(),
            bytes,
            adopted,
        })
    }

    fn record(&self, end: TrialEnd, history: Vec<Line>) -> TrialRecord {
        let (trial, settings) = (self.trial, self.training.settings());
        let last = history.last();
        TrialRecord {
            sweep: trial.sweep.clone(),
            id: trial.id.clone(),
            index: trial.index,
            values: trial.values.clone(),
            over: trial.over.iter().map(of_domain).collect(),
            model: settings.model.clone(),
            kind: settings.target.name().to_owned(),
            training_key: self.training.key.clone(),
            epochs: last.map_or(0, |line| line.epoch),
            loss: last.and_then(|line| line.validation.as_ref().map(Metrics::loss)),
            end,
            history: history.iter().map(of_line).collect(),
        }
    }

    fn models(&self) -> &Models {
        &self.training.models
    }
}

/// Returns the output of a trial that has ended before.
pub(super) fn adopted(record: &TrialRecord) -> Output {
    Output {
        manifest_sha256: record.sha256(),
        bytes: record.to_bytes().len() as u64,
        adopted: true,
    }
}

fn of_domain((name, domain): (&String, &Domain)) -> (String, Value) {
    let domain = serde_json::to_value(domain).expect("a domain is plain data");
    (name.clone(), domain)
}

fn of_line(line: &Line) -> Value {
    serde_json::to_value(line).expect("figures are plain data")
}
