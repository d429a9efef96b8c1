//! A sweep's trial. At certain epochs (rungs), the training compares itself with the trials that
//! have also reached them, and stops if it has fallen behind. Its outcome is recorded under the
//! sweep's name and is the task's result.

mod verdict;

use picofarm_proto::spec::{Domain, Trial};
use picofarm_results::{ModelManifest, Models, Rung, TrialEnd, TrialRecord};
use picofarm_store::published::Manifest as _;
use serde_json::Value;
use tracing::info;

use crate::{
    errors::in_field,
    stores::Stores,
    task::{Control, Output, TaskError},
};
use verdict::{Verdict, verdict};

/// The training of a trial.
#[derive(Clone, Copy)]
pub(crate) struct Learner<'a> {
    /// Name of the model.
    pub model: &'a str,
    /// The predicted quantity.
    pub kind: &'a str,
    /// Key of the training.
    pub key: &'a str,
}

/// A running trial.
pub(crate) struct Course<'a> {
    stores: &'a Stores,
    models: &'a Models,
    learner: Learner<'a>,
    trial: &'a Trial,
    /// Earlier outcome of the trial, if it must end in the same way again.
    again: Option<TrialRecord>,
}

/// The figures of a trial that has ended.
pub(crate) struct EndedTrial {
    pub end: TrialEnd,
    /// Number of completed epochs.
    pub epochs: u64,
    /// Its loss, which is smaller for better trials.
    pub loss: Option<f64>,
    pub history: Vec<Value>,
}

/// A trial at the end of an epoch.
pub(crate) struct AtEpoch {
    /// Number of completed epochs.
    pub epoch: u64,
    /// Number of epochs of the whole training.
    pub of: u64,
    /// The loss at this epoch, if it was measured.
    pub loss: Option<f64>,
    /// The lowest loss so far.
    pub best: Option<f64>,
}

impl<'a> Course<'a> {
    /// Returns the trial of a training.
    pub(crate) fn new(
        (stores, models): (&'a Stores, &'a Models),
        learner: Learner<'a>,
        trial: &'a Trial,
    ) -> Self {
        Self {
            stores,
            models,
            learner,
            trial,
            again: None,
        }
    }

    /// Returns the trial's recorded outcome. With `force`, returns `None` and makes the trial end
    /// in the same way again.
    pub(crate) fn ended(
        &mut self,
        force: bool,
        control: &Control,
    ) -> Result<Option<TrialRecord>, TaskError> {
        let trial = self.trial;
        self.check_name(control)?;
        let looked = self.models.trial(&trial.sweep, &trial.id, trial.index);
        let found = self.stores.wait(control, looked)?;
        if let Some(found) = &found
            && found.training_key != self.learner.key
        {
            let what = format!(
                "sweep: trial {} of {:?} is another training by now (key {}, this one's is {}): its values or the data set have changed; \
                 choose another name for the model",
                trial.index, trial.sweep, found.training_key, self.learner.key
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

    /// Refuses a sweep under the name of another training's model before its trials are trained,
    /// because its best model could not get the name.
    fn check_name(&self, control: &Control) -> Result<(), TaskError> {
        let name = &*self.trial.sweep;
        let held = self.stores.wait(control, self.models.look(name));
        match held.map_err(|e| in_field("sweep", e))? {
            Some(model) if model.lineage.promoted.is_none() => Err(TaskError::User(format!(
                "sweep: {name:?} is the model of another training; choose another name for the model, \
                 or delete that one by `picofarm model remove`"
            ))),
            _ => Ok(()),
        }
    }

    /// Returns whether the trial continues after an epoch.
    pub(crate) fn goes_on(&self, at: &AtEpoch, control: &Control) -> Result<bool, TaskError> {
        if let Some(again) = &self.again {
            return Ok(again.end != TrialEnd::Pruned || again.epochs != at.epoch);
        }
        let trial = self.trial;
        let asked = trial
            .stop
            .filter(|stop| stop.asks(trial.index, at.epoch, at.of));
        let (Some(stop), Some(loss)) = (asked, at.loss) else {
            return Ok(true);
        };
        let ours = Rung {
            index: trial.index,
            epochs: at.epoch,
            loss,
        };
        let (models, sweep, id) = (self.models, &*trial.sweep, &*trial.id);
        let written = async || models.put_rung(sweep, id, &ours).await;
        self.stores.patiently(control, written)?;
        let mut there = self
            .stores
            .wait(control, models.rung(sweep, id, at.epoch))?;
        let bracket = stop.bracket(trial.index, at.of);
        there.retain(|other| stop.bracket(other.index, at.of) == bracket);
        let Verdict { goes_on, why } = verdict(&stop, &ours, at.best.unwrap_or(loss), &there);
        let then = if goes_on { "goes on" } else { "stops" };
        info!(
            "trial {} after {} epochs {why}: it {then}",
            trial.index, at.epoch
        );
        Ok(goes_on)
    }

    /// Records that the trial finished with the stored model.
    pub(crate) fn finished(
        &self,
        ended: EndedTrial,
        (manifest, adopted): (&ModelManifest, bool),
        control: &Control,
    ) -> Result<Output, TaskError> {
        self.tell(
            &self.record(ended),
            manifest.total_bytes(),
            adopted,
            control,
        )
    }

    /// Records that the trial was pruned, and deletes its checkpoints.
    pub(crate) fn left(&self, ended: EndedTrial, control: &Control) -> Result<Output, TaskError> {
        let record = self.record(ended);
        let output = self.tell(&record, record.to_bytes().len() as u64, false, control)?;
        self.forget(&record, control)?;
        Ok(output)
    }

    /// Deletes the checkpoints of a trial that has ended.
    fn forget(&self, record: &TrialRecord, control: &Control) -> Result<(), TaskError> {
        let (name, key) = (&record.model, &record.training_key);
        let deleted = self.models.delete_checkpoints(name, key);
        self.stores.wait(control, deleted)
    }

    fn tell(
        &self,
        record: &TrialRecord,
        bytes: u64,
        adopted: bool,
        control: &Control,
    ) -> Result<Output, TaskError> {
        let put = async || self.models.put_trial(record).await;
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

    fn record(&self, ended: EndedTrial) -> TrialRecord {
        let (trial, learner) = (self.trial, self.learner);
        TrialRecord {
            sweep: trial.sweep.clone(),
            id: trial.id.clone(),
            index: trial.index,
            values: trial.values.clone(),
            over: trial.over.iter().map(of_domain).collect(),
            model: learner.model.to_owned(),
            kind: learner.kind.to_owned(),
            training_key: learner.key.to_owned(),
            epochs: ended.epochs,
            loss: ended.loss,
            end: ended.end,
            history: ended.history,
        }
    }
}

/// Returns the output of a trial that has ended before.
pub(crate) fn adopted(record: &TrialRecord) -> Output {
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
