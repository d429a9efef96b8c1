//! Own training: runs the job's Python code in a process of its own and publishes what it leaves.
//!
//! Like a training of the farm's networks, it may run for days on several workers in turn: it
//! resumes from its newest checkpoint, and a sweep may stop it. Unlike there, nothing promises
//! equal bytes: another run of equal code adopts the model that was published first.

mod code;
mod inputs;
mod recorder;
mod results;

use std::path::Path;

use picofarm_proto::spec::{SpecError, kinds::PythonTask};
use picofarm_results::{ModelManifest, Models};
use picofarm_store::StorageError;
use tracing::{info, warn};

use self::{
    inputs::Inputs,
    recorder::{Recorder, Resumed},
};
use crate::{
    errors::{dataset_error, in_field},
    interpreter::Interpreter,
    python::{Ended, Order, Patience, prepare, run},
    saver::Saver,
    stores::Stores,
    submission::Submission,
    task::{Context, Control, Output, RunTask, Task, TaskError},
    trial::{Course, EndedTrial, Learner, adopted},
};

/// Version of the conversation between code and worker, and of the results.
const VERSION: &str = "python-1";
/// Kind of the models.
const KIND: &str = "python";

impl RunTask for PythonTask {
    fn code_version() -> String {
        VERSION.into()
    }

    /// Runs the code, or adopts its results if they exist.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let Some(interpreter) = &context.python else {
            let what = "python: this worker runs no Python; start it with --python PATH";
            return Err(TaskError::Crash(what.into()));
        };
        let stores = &context.stores;
        let inputs = Inputs::open(self, stores, control)?;
        let training = OwnTraining {
            task: self,
            stores,
            models: stores
                .models(self.store(), control)
                .map_err(|e| in_field("python.store", e))?,
            inputs,
            runtime: (interpreter, context.environments.as_deref()),
            control,
        };
        let Some(trial) = &self.python.trial else {
            return match training.learn(task.spec.force, None)? {
                Finished::Published(manifest, adopted) => Ok(results::output(&manifest, adopted)),
                Finished::Left(_) => Err(TaskError::Crash("only trials end early".into())),
            };
        };
        let learner = Learner {
            model: &self.python.model,
            kind: KIND,
            key: &training.inputs.key,
        };
        let mut course = Course::new((stores, &training.models), learner, trial);
        if let Some(ended) = course.ended(false, control)? {
            if task.spec.force {
                info!(
                    "the trial is not run again by force: own code could come to another end than the sweep has recorded"
                );
            }
            return Ok(adopted(&ended));
        }
        match training.learn(false, Some(&course))? {
            Finished::Published(manifest, adopted) => {
                let ended = results::ended(&manifest, stores, &training.models, control)?;
                course.finished(ended, (&*manifest, adopted), control)
            }
            Finished::Left(ended) => course.left(ended, control),
        }
    }

    fn resolve(&mut self, here: &Submission<'_>) -> Result<(), SpecError> {
        code::resolve(&mut self.python, here)
    }
}

/// A training with its inputs.
struct OwnTraining<'a> {
    task: &'a PythonTask,
    stores: &'a Stores,
    models: Models,
    inputs: Inputs,
    /// The interpreter, and the folder of virtual environments.
    runtime: (&'a Interpreter, Option<&'a Path>),
    control: &'a Control,
}

/// The end of a training.
enum Finished {
    /// The model is published; whether it was before.
    Published(Box<ModelManifest>, bool),
    /// A trial ended before its training.
    Left(EndedTrial),
}

impl OwnTraining<'_> {
    /// Adopts the model if this exact training has published it; otherwise runs the code and
    /// publishes what it leaves.
    fn learn(&self, force: bool, course: Option<&Course<'_>>) -> Result<Finished, TaskError> {
        let (name, key) = (&self.task.python.model, &self.inputs.key);
        if !force && let Some(manifest) = self.published()? {
            // The worker that published it may have died before it deleted the checkpoints.
            self.stores
                .wait(self.control, self.models.delete_checkpoints(name, key))?;
            return Ok(Finished::Published(manifest.into(), true));
        }
        let newest = self
            .stores
            .wait(self.control, self.models.newest_checkpoint(name, key))?;
        let resumed = newest.map(|(step, pieces)| {
            info!("goes on from the checkpoint after {step} steps");
            Resumed::read(step, pieces)
        });
        let (resumed, checkpoint) = match resumed.transpose()? {
            Some((resumed, state)) => (resumed, Some(state)),
            None => (Resumed::default(), None),
        };
        let checkpoints = self
            .models
            .checkpoints_of(name, key)
            .map_err(dataset_error)?;
        let saver = Saver::new(self.stores, checkpoints);
        let mut recorder =
            Recorder::new(&self.task.python, saver, (course, self.control), resumed)?;
        let code = code::unpack(&self.task.python)?;
        let requirements = &*self.task.python.requirements;
        let prepared = prepare(self.runtime, requirements, self.control)?;
        let order = Order {
            entry: self.task.python.entry.clone(),
            code: &code,
            requirements,
            task: self.inputs.task(&self.task.python),
            checkpoint,
            built: prepared.built,
            variables: prepared.variables,
        };
        let ran = run(
            &prepared.interpreter,
            order,
            &mut recorder,
            (self.control, Patience::default()),
        );
        recorder.last();
        match ran? {
            Ended::Stopped => Ok(Finished::Left(recorder.ended()?)),
            Ended::Done { result, facts } => {
                let new = results::model(self.task, &self.inputs, recorder, (result, facts))?;
                let publish = async || self.models.publish(new.clone(), false).await;
                let published = self.stores.patiently(self.control, publish)?;
                self.stores
                    .wait(self.control, self.models.delete_checkpoints(name, key))?;
                self.control.at(1.0);
                Ok(Finished::Published(
                    published.manifest.into(),
                    published.adopted,
                ))
            }
        }
    }

    /// Returns the model if this exact training has published it.
    fn published(&self) -> Result<Option<ModelManifest>, TaskError> {
        let (name, key) = (&self.task.python.model, &self.inputs.key);
        let looked = async {
            match self.models.finished(name, key).await {
                Err(error @ StorageError::Damaged { .. }) => {
                    warn!(%error, "a model is damaged; it is trained again to repair it");
                    Ok(None)
                }
                other => other,
            }
        };
        self.stores
            .wait(self.control, looked)
            .map_err(|e| in_field("python", e))
    }
}
