//! Training: adopts a model that exists, or resumes from the newest checkpoint, or starts; saves
//! checkpoints; publishes the model.
//!
//! A training can run for days, on several workers in turn. It is therefore saved every few minutes
//! and when it is asked to stop. It never waits for the store while it computes: an unreachable
//! store costs checkpoints, not the training.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use picofarm_dataset::DatasetSpec;
use picofarm_members::Members;
use picofarm_model::{
    Device, ModelError, cpu,
    input::EvidenceForm,
    memory::RetainedMemory,
    scene::Scenes,
    train::{Ended, Event, Line, Plan, Sources, Trained, Training},
};
use picofarm_proto::spec::{
    TrainSettings, TrainTask,
    train::{Normalise, Runtime},
};
use picofarm_results::{
    Lineage, ModelManifest, Models, NewModel, PublishedModel, TrainingSpeed, TrialEnd,
};
use picofarm_store::StorageError;
use tracing::{debug, info, warn};

mod along;
mod board;
mod imported;
mod inputs;
mod plan;
mod results;
mod torch;
mod trial;

use along::{Reporter, loading};
use board::Board;
pub use imported::{ImportFor, NotImported, imported};
use results::{lines, metrics, output, pretty};
use torch::TorchEngine;
pub(crate) use torch::has_torch;

use crate::{
    errors::{dataset_error, in_field, model_error},
    input::{
        examples::Examples,
        models::{Known, WEIGHTS, expected_input, model_version},
    },
    interpreter::Interpreter,
    saver::{PIECE, Saver},
    stores::Stores,
    task::{Context, Control, Output, RunTask, Task, TaskError},
    trial::{Course, EndedTrial, adopted},
};

impl RunTask for TrainTask {
    fn code_version() -> String {
        model_version()
    }

    /// Trains the model that `task` names; with `force`, even if it exists. Uses a GPU if the job
    /// asks for `gpus`.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let _retained = RetainedMemory::from_now();
        let stores = &context.stores;
        let force = task.spec.force;
        let training = TrainingRun {
            device: context.device(task)?,
            gpu: context.gpu(task).map(ToString::to_string),
            peers: &context.peers,
            python: context.torch.as_ref(),
            ..TrainingRun::open(stores, self, control)?
        };
        let Some(trial) = &self.train.trial else {
            let published = match training.learn(stores, force, None, control)? {
                Ok(published) => published,
                Err(_) => unreachable!("only trials are left before their end"),
            };
            return Ok(output(&published.manifest, published.adopted));
        };
        let mut course = trial::open(stores, &training, trial)?;
        if let Some(ended) = course.ended(force, control)? {
            return Ok(adopted(&ended));
        }
        match training.learn(stores, force, Some(&course), control)? {
            Ok(published) => {
                let published = (&published.manifest, published.adopted);
                trial::finished(&course, (stores, &training), published, control)
            }
            Err(left) => course.left(left, control),
        }
    }
}

/// Inputs and state of a training.
struct TrainingRun<'a> {
    task: &'a TrainTask,
    spec: DatasetSpec,
    /// The form of the evidence, if the network takes it.
    evidence: Option<EvidenceForm>,
    models: Models,
    training: Arc<Examples>,
    validation: Arc<Examples>,
    /// The models that the training builds on, by field.
    built: BTreeMap<&'static str, Known>,
    lineage: Lineage,
    key: String,
    /// Memory left to the task, in MiB; `None` = unknown.
    left_mib: Option<u64>,
    /// Device on which the training runs.
    device: Device,
    /// Name of the GPU, as reported by its driver.
    gpu: Option<String>,
    /// Address at which other workers reach this one.
    peers: &'a str,
    /// The Python interpreter of this worker, if it has PyTorch.
    python: Option<&'a Interpreter>,
}

impl TrainingRun<'_> {
    /// Returns the plan for the model runtime.
    fn plan(&self, control: &Control) -> Result<Plan, TaskError> {
        let settings = &self.task.train;
        let greatest = match (settings.input.normalise, settings.input.max) {
            (Normalise::Log, 0.0) => plan::largest_bin(&*self.training, control)?,
            (_, max) => max as f32,
        };
        let plan = plan::plan(
            settings,
            &self.spec,
            (self.training.spots(), self.evidence.clone()),
            greatest,
        )?;
        if let Some(on) = self.built.get("train.specular.on") {
            plan::check_on(&plan, on)?;
        }
        Ok(plan)
    }

    fn settings(&self) -> &TrainSettings {
        &self.task.train
    }

    fn split(&self) -> &str {
        &self.task.train.split
    }

    fn validation_is_empty(&self) -> bool {
        self.validation.is_empty()
    }

    /// Adopts the model if this exact training has published it; otherwise trains and publishes.
    fn learn(
        &self,
        stores: &Stores,
        force: bool,
        course: Option<&Course<'_>>,
        control: &Control,
    ) -> Result<Result<PublishedModel, EndedTrial>, TaskError> {
        let (models, name, key) = (&self.models, &self.task.train.model, &self.key);
        if !force && let Some(manifest) = finished(stores, models, name, key, control)? {
            // The worker that published it may have died before it deleted the checkpoints.
            stores.wait(control, models.delete_checkpoints(name, key))?;
            return Ok(Ok(PublishedModel {
                manifest,
                adopted: true,
            }));
        }
        let plan = self.plan(control)?;
        let asked = expected_input(&plan, &self.spec);
        let board = Board::new(stores, self, control);
        let stopped = || control.stopped();
        let settings = self.settings();
        let mut members = match (settings.runtime, settings.processes) {
            (Runtime::Torch, _) | (_, 1) => None,
            _ => Some(board.members(self.peers, &stopped)?),
        };
        let engine = match settings.runtime {
            Runtime::Embedded => None,
            Runtime::Torch => Some(self.engine(&plan)?),
        };
        let mut lineage = self.lineage.clone();
        lineage.runtime = engine.as_ref().map(|e| self.runtime(e)).unwrap_or_default();
        let parts = (course, members.as_mut(), engine);
        let trained = match self.train(plan, stores, parts, control)? {
            Outcome::Trained(trained) => trained,
            Outcome::Pruned(left) => return Ok(Err(left)),
            Outcome::TrainedElsewhere => {
                let there = finished(stores, models, name, key, control)?;
                let missing = "the process that led the training says that the model is kept, but it is not there";
                return match there {
                    Some(manifest) => Ok(Ok(PublishedModel {
                        manifest,
                        adopted: true,
                    })),
                    None => Err(TaskError::Interrupted(missing.into())),
                };
            }
        };
        let metrics = metrics(&trained);
        let new = NewModel {
            manifest: ModelManifest {
                name: name.clone(),
                kind: self.task.train.target.name().to_owned(),
                training_key: key.clone(),
                settings: self.task.train.shaping(),
                plan: asked,
                lineage,
                metrics: metrics.clone(),
                ..ModelManifest::default()
            },
            objects: vec![
                (WEIGHTS.into(), trained.weights.into()),
                (trial::HISTORY.into(), lines(&trained.history).into()),
                ("metrics.json".into(), pretty(&metrics).into()),
            ],
        };
        let published =
            stores.patiently(control, async || models.publish(new.clone(), force).await)?;
        if let Some(members) = &mut members {
            members.announce_end();
        }
        stores.wait(control, models.delete_checkpoints(name, key))?;
        control.at(1.0);
        Ok(Ok(published))
    }

    /// Stores the speed of the training. Failures are ignored, because nothing depends on it.
    fn tell_speed(
        &self,
        stores: &Stores,
        (samples_per_s, data_wait_share): (f64, f64),
        control: &Control,
    ) {
        let speed = TrainingSpeed {
            training_key: self.key.clone(),
            samples_per_s,
            data_wait_share,
            threads: rayon::current_num_threads(),
            gpu: self.gpu.clone(),
        };
        let put = self.models.put_speed(&self.task.train.model, &speed);
        if let Err(error) = stores.wait(control, put) {
            warn!(%error, "how fast the training was is not kept");
        }
    }

    /// Runs the training. A trial may be pruned before its end.
    fn train(
        &self,
        plan: Plan,
        stores: &Stores,
        (course, members, engine): (
            Option<&Course<'_>>,
            Option<&mut Members<'_>>,
            Option<TorchEngine>,
        ),
        control: &Control,
    ) -> Result<Outcome, TaskError> {
        let device = match engine {
            None => self.device.clone(),
            Some(_) => cpu(),
        };
        let (name, key) = (&self.task.train.model, &*self.key);
        let sources = Sources {
            train: self.training.clone(),
            validation: self.validation.clone(),
        };
        let from = ["train.from", "train.specular.on"];
        let from = from.iter().find_map(|field| self.built.get(*field));
        let from = from.map(|known| &known.weights[..]);
        let newest = stores.wait(control, self.models.newest_checkpoint(name, key))?;
        let mut training = match newest {
            None => Training::start(plan, from, sources, &device),
            Some((step, content)) => {
                info!("goes on from the checkpoint after {step} steps");
                Training::resume(plan, &content, sources, &device)
            }
        }
        .map_err(model_error)?
        .loading(loading(self.left_mib));
        if let Some(engine) = engine {
            training = training.on(Box::new(engine)).map_err(model_error)?;
        }
        let checkpoints = self
            .models
            .checkpoints_of(name, key)
            .map_err(dataset_error)?;
        let mut saver = Saver::new(stores, checkpoints);
        let every = Duration::from_secs_f64(self.task.train.checkpoint_minutes * 60.0);
        let mut saved = Instant::now();
        let epochs = self.task.train.optimise.epochs;
        let mut teller = Reporter::new(control, epochs);
        // Decision on the trial at its latest rung.
        let mut answer = Ok(true);
        let mut unsaved = Ok(());
        let mut ask = |line: &Line, best: Option<f64>| {
            let at = trial::at(line, best, epochs);
            let goes_on = |course: &Course<'_>| course.goes_on(&at, control);
            answer = course.map_or(Ok(true), goes_on);
            matches!(answer, Ok(true))
        };
        // The training may have been stopped exactly at a rung.
        let position = training.position();
        let best = position.best;
        let at_rung = position.history.last().filter(|_| position.batches == 0);
        let ended = match at_rung.copied().is_none_or(|line| ask(&line, best)) {
            false => Ok(Ended::Stopped),
            true => {
                let mut hear = |training: &Training, event: &Event| {
                    teller.hear(event);
                    if let Event::Epoch(line) = event
                        && !ask(line, training.position().best)
                    {
                        return picofarm_model::train::Control::Stop;
                    }
                    if control.stopped() {
                        return picofarm_model::train::Control::Stop;
                    }
                    if training.leads() && saved.elapsed() >= every && !saver.is_busy() {
                        saved = Instant::now();
                        unsaved = save(&mut saver, training);
                        if unsaved.is_err() {
                            return picofarm_model::train::Control::Stop;
                        }
                        if every.is_zero() {
                            // Finishes the save in progress, so that at most the steps since this
                            // checkpoint can be lost.
                            saver.last();
                        }
                        debug!("a checkpoint held the training for {:?}", saved.elapsed());
                    }
                    picofarm_model::train::Control::Continue
                };
                match members {
                    Some(members) => training.run_among(members, &mut hear),
                    None => training.run(&mut hear),
                }
            }
        };
        let left = |training: &Training, end| trial::ended(end, &training.position().history);
        match unsaved.and(ended) {
            Err(error @ ModelError::NotFinite { .. }) if course.is_some() => {
                saver.last();
                Ok(Outcome::Pruned(left(
                    &training,
                    TrialEnd::Diverged(error.to_string()),
                )))
            }
            Err(error) => Err(model_error(error)),
            Ok(Ended::Finished) => {
                saver.last();
                if let Some(pace) = teller.pace() {
                    self.tell_speed(stores, pace, control);
                }
                Ok(Outcome::Trained(training.finish()))
            }
            Ok(Ended::Stopped) if matches!(answer, Ok(false)) => {
                saver.last();
                Ok(Outcome::Pruned(left(&training, TrialEnd::Pruned)))
            }
            Ok(Ended::Elsewhere) => {
                saver.last();
                Ok(Outcome::TrainedElsewhere)
            }
            Ok(Ended::Stopped) => {
                if training.leads() {
                    save(&mut saver, &training).map_err(model_error)?;
                }
                saver.last();
                // If the store was unreachable at a rung, the trial resumes from there.
                answer.and(Err(TaskError::Stopped))
            }
        }
    }
}

/// Saves the current state of a training in the background.
fn save(saver: &mut Saver<'_>, training: &Training) -> Result<(), ModelError> {
    let pieces = training.snapshot()?.pieces(PIECE).map(Bytes::from);
    saver.save(training.learner().steps(), Box::new(pieces));
    Ok(())
}

/// Outcome of a training on this process.
enum Outcome {
    /// The training finished with a network.
    Trained(Trained),
    /// A trial was pruned before its end.
    Pruned(EndedTrial),
    /// Another process has stored the network.
    TrainedElsewhere,
}

/// Returns the model if this exact training has published it.
fn finished(
    stores: &Stores,
    models: &Models,
    name: &str,
    key: &str,
    control: &Control,
) -> Result<Option<ModelManifest>, TaskError> {
    let looked = async {
        match models.finished(name, key).await {
            Err(error @ StorageError::Damaged { .. }) => {
                warn!(%error, "a model is damaged; it is trained again to repair it");
                Ok(None)
            }
            other => other,
        }
    };
    stores
        .wait(control, looked)
        .map_err(|e| in_field("train", e))
}
