//! Evaluation: computes the errors of trained models on scenes that they were not trained on.
//!
//! An evaluation is a single task, or one task for each shard of the scenes and one that joins the
//! shards in the scenes' order; both give the same figures to the bit. The result is stored next to
//! each model. A model that was evaluated on these scenes before is skipped. Shards are only a
//! cache: the joining task recomputes those that are missing or damaged.

mod asked;
mod predictions;

use std::ops::Range;

use picofarm_dataset::{Dataset, Pinned};
use picofarm_model::{
    Answered, Device, Evaluated, answered, baseline::Baseline, memory::RetainedMemory,
};
use picofarm_proto::spec::{EvaluateShardTask, EvaluateTask, TaskSpec};
use picofarm_results::{Evaluation, Models, ShardName, SplitUsed, Verdict};
use picofarm_store::sha256_hex;
use serde::{Deserialize, Serialize};
use serde_json::json;
use sha2::{Digest, Sha256};
use tracing::{info, warn};

use crate::{
    errors::{in_field, model_error, prediction_error},
    input::{
        examples::Examples,
        models::{model_version, pin},
        sides::{first, sides},
        times::Times,
    },
    stores::{Stores, saying},
    task::{Context, Control, Output, RunTask, Task, TaskError},
};
use asked::EvaluatedModel;

/// Maximum number of training scenes that the trivial baselines are fitted to.
const BASELINE: usize = 64;

impl RunTask for EvaluateTask {
    fn code_version() -> String {
        model_version()
    }

    /// Evaluates the models that `task` names, and joins their shards if there are any.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let _retained = RetainedMemory::from_now();
        let evaluation = EvaluationRun::new((context, context.device(task)?), self, control)?;
        if !self.evaluate.predictions.is_empty() {
            return evaluation.of_predictions(control);
        }
        let (mut documents, mut computed) = (Vec::new(), false);
        for which in 0..self.evaluate.models.len() {
            let (found, new) = evaluation.evaluate(which, control)?;
            computed |= new;
            documents.extend(found.to_bytes());
        }
        control.at(1.0);
        Ok(Output {
            manifest_sha256: sha256_hex(&documents),
            bytes: documents.len() as u64,
            adopted: !computed,
        })
    }
}

impl RunTask for EvaluateShardTask {
    fn code_version() -> String {
        model_version()
    }

    /// Evaluates the models on the scenes of shard `task.index`. Skips models with a finished
    /// evaluation or shard.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let _retained = RetainedMemory::from_now();
        let evaluation =
            EvaluationRun::new((context, context.device(task)?), &self.whole, control)?;
        let (mut bytes, mut computed) = (0, false);
        let mut names = Sha256::new();
        for which in 0..self.whole.evaluate.models.len() {
            let asked = evaluation.open_model(which, control)?;
            let name = evaluation.shard(&asked, task.index as u32);
            names.update(format!("{} {:?}\n", name.evaluation, name.shard));
            if evaluation.found(&asked, control)?.is_some() {
                continue;
            }
            if evaluation.read(&name, control)?.is_some() {
                continue;
            }
            let record = ShardRecord {
                evaluation: name.evaluation.clone(),
                shard: name.shard,
                answered: evaluation.ask(&asked, name.shard.0, control)?,
            };
            let text = serde_json::to_vec(&record).expect("sums are plain data");
            let put = async || evaluation.models.put_shard(&name, &text).await;
            context.stores.patiently(control, put)?;
            bytes += text.len() as u64;
            computed = true;
        }
        control.at(1.0);
        Ok(Output {
            // Shards are deleted after their evaluation is stored, so only their names are stable.
            manifest_sha256: hex::encode(names.finalize()),
            bytes,
            adopted: !computed,
        })
    }
}

/// An evaluation: its scenes and its models.
struct EvaluationRun<'a> {
    stores: &'a Stores,
    task: &'a EvaluateTask,
    /// Device on which the models run.
    device: Device,
    dataset: Dataset,
    models: Models,
    split: SplitUsed,
    scenes: Vec<u64>,
    /// Hashes of the scenes.
    data: Pinned,
    /// Training scenes that the trivial baselines are fitted to, and their hashes.
    known: Vec<u64>,
    known_data: Pinned,
    /// Memory left to the task, in MiB; `None` = unknown.
    left_mib: Option<u64>,
}

/// A shard as it is stored.
#[derive(Serialize, Deserialize)]
struct ShardRecord {
    /// Key of the evaluation.
    evaluation: String,
    /// Index of the shard and number of shards.
    shard: (u32, u32),
    /// One entry for each scene, in order.
    answered: Vec<Answered>,
}

impl<'a> EvaluationRun<'a> {
    fn new(
        (context, device): (&'a Context, Device),
        task: &'a EvaluateTask,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let stores = &context.stores;
        let (place, settings) = (&task.source, &task.evaluate);
        let dataset = stores
            .open_source(&place.store, &place.dataset, control)
            .map_err(|e| in_field("source", e))?;
        let left_mib = stores.fits(TaskSpec::Evaluate(task.clone()), Some(dataset.spec()))?;
        let models = stores
            .models(&place.store, control)
            .map_err(|e| in_field("source.store", e))?;
        let split = ("evaluate.split", &*settings.split);
        let sides = sides(stores, &dataset, split, [&*settings.side, "train"], control)?;
        let [mut scenes, mut known] = sides.scenes;
        first(&mut scenes, settings.scenes, "evaluate.scenes")?;
        known.truncate(BASELINE);
        Ok(Self {
            data: pin(stores, &dataset, &scenes, control)?,
            known_data: pin(stores, &dataset, &known, control)?,
            known,
            left_mib,
            stores,
            task,
            device,
            dataset,
            models,
            split: sides.split,
            scenes,
        })
    }

    /// Returns the stored evaluation of a model, if there is one.
    fn found(
        &self,
        asked: &EvaluatedModel,
        control: &Control,
    ) -> Result<Option<Evaluation>, TaskError> {
        let name = &self.task.evaluate.models[asked.which];
        let found = self.models.evaluation(name, &asked.key);
        self.stores.wait(control, found)
    }

    /// Returns the evaluation of one of the models, and whether it was computed by this task.
    fn evaluate(&self, which: usize, control: &Control) -> Result<(Evaluation, bool), TaskError> {
        let (stores, models, settings) = (self.stores, &self.models, &self.task.evaluate);
        let name = &settings.models[which];
        let asked = self.open_model(which, control)?;
        if let Some(found) = self.found(&asked, control)? {
            self.tell(&asked, &found)?;
            return Ok((found, false));
        }
        let mut answered = Vec::with_capacity(self.scenes.len());
        for shard in 0..settings.shards {
            answered.extend(match self.read(&self.shard(&asked, shard), control)? {
                Some(shard) => shard,
                None => {
                    if settings.shards > 1 {
                        warn!(
                            "{name}: shard {shard} of {} is missing; it is made here",
                            settings.shards
                        );
                    }
                    self.ask(&asked, shard, control)?
                }
            });
        }
        let target = asked.model.model.question().target;
        let metrics = metrics(&Evaluated::from_scenes(target, &answered), &self.scenes);
        info!("{name}: {}", summary(&metrics));
        let made = Evaluation {
            key: asked.key.clone(),
            model: name.clone(),
            model_sha256: asked.sha256.clone(),
            predicts: String::new(),
            dataset: self.task.source.dataset.clone(),
            data: self.data.id.clone(),
            split: self.split.clone(),
            side: settings.side.clone(),
            scenes: self.scenes.len() as u64,
            histogram: asked.histogram.name().to_owned(),
            sensor: asked.sensor.is_some(),
            times: asked
                .times
                .as_ref()
                .map_or_else(String::new, |times| times.name.clone()),
            code: settings.version.clone(),
            metrics,
        };
        let new = stores.patiently(control, async || models.put_evaluation(&made).await)?;
        // A shard that cannot be deleted now is left, because nothing reads it.
        for shard in 0..settings.shards {
            let name = self.shard(&asked, shard);
            if settings.shards > 1
                && let Err(error) = stores.wait(control, models.delete_shard(&name))
            {
                warn!(%error, "a shard that was joined is left behind");
            }
        }
        // If another task stored its evaluation first, that one counts.
        let found = match new {
            true => made,
            false => self.found(&asked, control)?.unwrap_or(made),
        };
        self.tell(&asked, &found)?;
        Ok((found, true))
    }

    /// Logs how the model compares with the trivial baselines.
    fn tell(&self, asked: &EvaluatedModel, found: &Evaluation) -> Result<(), TaskError> {
        let target = asked.model.model.question().target;
        let verdict = Verdict::of_evaluation(target.name(), &found.metrics);
        let name = &found.model;
        // An older version stored evaluations of predictions that are not numbers.
        if found.metrics["mae_m"].is_null() && found.metrics["iou"].is_null() {
            return Err(TaskError::User(format!(
                "model {name:?}: its evaluation {} has no figures; an older version kept it of answers that are no numbers: \
                 remove models/{name}/evaluations/{}.json and evaluate it again",
                found.key, found.key
            )));
        }
        let on = format!(
            "{} {} scenes of {}",
            found.scenes, found.side, found.dataset
        );
        saying(&verdict, &format!("{name} on {on}"));
        Ok(())
    }

    fn shard(&self, asked: &EvaluatedModel, index: u32) -> ShardName {
        let settings = &self.task.evaluate;
        ShardName {
            model: settings.models[asked.which].clone(),
            evaluation: asked.key.clone(),
            shard: (index, settings.shards),
        }
    }

    /// Returns the scenes of a shard, as indices into those of the evaluation.
    fn range(&self, shard: u32) -> Range<usize> {
        let (scenes, of) = (
            self.scenes.len() as u64,
            u64::from(self.task.evaluate.shards),
        );
        let begin = |shard: u64| (shard * scenes / of) as usize;
        begin(u64::from(shard))..begin(u64::from(shard) + 1)
    }

    /// Reads a shard; `None` if it is missing or incomplete.
    fn read(
        &self,
        name: &ShardName,
        control: &Control,
    ) -> Result<Option<Vec<Answered>>, TaskError> {
        if name.shard.1 == 1 {
            return Ok(None);
        }
        let Some(bytes) = self.stores.wait(control, self.models.shard(name))? else {
            return Ok(None);
        };
        match serde_json::from_slice::<ShardRecord>(&bytes) {
            Ok(found) if found.shard == name.shard && found.evaluation == name.evaluation => {
                Ok(Some(found.answered))
            }
            Ok(found) => {
                warn!(shard = name.shard.0, found = ?found.shard, "a shard is another one; it is made again");
                Ok(None)
            }
            Err(error) => {
                warn!(shard = name.shard.0, %error, "a shard is damaged; it is made again");
                Ok(None)
            }
        }
    }

    /// Runs a model on the scenes of a shard.
    fn ask(
        &self,
        asked: &EvaluatedModel,
        shard: u32,
        control: &Control,
    ) -> Result<Vec<Answered>, TaskError> {
        let (model, which) = (&asked.model, asked.which);
        let examples = |scenes: &[u64]| {
            let histogram = (asked.histogram, &*asked.spots);
            Examples::new(
                self.stores,
                &self.dataset,
                histogram,
                scenes.to_vec(),
                "evaluate",
            )
            .and_then(|examples| examples.through(asked.sensor.clone()))
            .map(|examples| examples.staying(self.left_mib))
        };
        let times = asked.times.as_ref();
        let field = format!("evaluate.models[{which}]");
        let scenes = examples(&self.scenes[self.range(shard)])?
            .timed_by(times.and_then(Times::depths))
            .seeing(times.and_then(Times::evidence), &field)?;
        let spots = model.model.question().spots;
        if spots > 0 && spots != scenes.spots() {
            return Err(TaskError::User(format!(
                "evaluate.models[{which}]: {:?} was trained on histograms of {spots} spots, these are of {}",
                model.manifest.name,
                scenes.spots()
            )));
        }
        let question = model.model.question();
        let baseline =
            Baseline::fit(question, &examples(&self.known)?, BASELINE).map_err(model_error)?;
        let (name, count) = (&model.manifest.name, self.task.evaluate.models.len());
        let mut tell = |scene: usize, of: usize| {
            let share = (which as f32 + scene as f32 / of as f32) / count as f32;
            let text = format!("{name} ({} of {count}): scene {scene}/{of}", which + 1);
            control.say(text, &[]);
            control.at(share * 0.99)
        };
        let place = self.dataset.place();
        let asked_of = &self.scenes[self.range(shard)];
        answered(&model.model, &baseline, &scenes, &mut tell)
            .map_err(prediction_error(name, &place, asked_of))?
            .ok_or(TaskError::Stopped)
    }
}

/// Returns the figures in the form in which they are stored.
fn metrics(found: &Evaluated, scenes: &[u64]) -> serde_json::Value {
    let baselines = found
        .baselines
        .iter()
        .map(|(name, m)| (name.clone(), json!(m)));
    let mut metrics = json!(found.metrics);
    metrics["released"] = json!(found.released);
    metrics["baselines"] = baselines.collect();
    metrics["examples"] = json!(found.examples);
    metrics["by_scene"] = json!(found.scenes);
    metrics["by_scene_index"] = json!(scenes);
    metrics
}

/// Formats the mean figures of all scenes for the log.
fn summary(metrics: &serde_json::Value) -> String {
    let all = metrics.as_object().into_iter().flatten();
    let numbers = all.filter(|(name, _)| *name != "examples");
    let numbers = numbers.filter_map(|(name, x)| Some(format!("{name} {:.4}", x.as_f64()?)));
    numbers.collect::<Vec<_>>().join(", ")
}
