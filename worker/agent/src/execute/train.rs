//! Training: adopt, or go on from the newest checkpoint, or begin; save what is reached now and then; publish.
//!
//! A training may run for days and on many workers, one after the other. So it is saved every few minutes, when it is told
//! to stop, and never waits for the store while it computes; a store that is away costs checkpoints, not the training.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use picofarm_dataset::{Dataset, DatasetError, Lineage, ModelManifest, Models, NewModel};
use picofarm_model::{Built, Ended, ModelError, Plan, Training, scene::Scenes};
use picofarm_proto::{
    key::training_key,
    model::{TrainSettings, TrainTask, train::Normalise},
};
use tracing::{info, warn};

mod along;

use along::{Saver, Teller};

use super::{
    Control, Output, TaskError,
    examples::{Examples, first, sides},
    output::{Stores, of_dataset},
};

/// Name of the object that holds a model's weights.
pub(super) const WEIGHTS: &str = "weights.safetensors";
/// Version of networks, training and metrics.
pub fn model_version() -> String {
    picofarm_model::VERSION.to_owned()
}

/// Trains what `task` names; with `force` although it is there.
pub(super) fn run(
    stores: &Stores,
    task: &TrainTask,
    force: bool,
    control: &Control,
) -> Result<Output, TaskError> {
    task.check().map_err(|e| TaskError::User(e.to_string()))?;
    check_version("train", &task.train.version)?;
    let lesson = Lesson::of(stores, task, control)?;
    let (models, name, key) = (&lesson.models, &task.train.model, &lesson.key);
    if !force && let Some(manifest) = finished(stores, models, name, key, control)? {
        // Whoever published it may have died before this.
        stores.wait(control, models.delete_checkpoints(name, key))?;
        return Ok(output(&manifest, true));
    }
    let trained = lesson.train(stores, control)?;
    let new = NewModel {
        manifest: ModelManifest::new(
            name,
            task.train.task.name(),
            key,
            lesson.settings(),
            lesson.lineage.clone(),
            trained.metrics.clone(),
        ),
        objects: vec![
            (WEIGHTS.into(), trained.weights.into()),
            ("history.jsonl".into(), trained.history.into_bytes().into()),
            ("metrics.json".into(), pretty(&trained.metrics).into()),
        ],
    };
    let published = stores.patiently(control, async || models.publish(new.clone(), force).await)?;
    stores.wait(control, models.delete_checkpoints(name, key))?;
    control.at(1.0);
    Ok(output(&published.manifest, published.adopted))
}

/// Everything that a training is made of.
struct Lesson<'a> {
    task: &'a TrainTask,
    models: Models,
    training: Arc<Examples>,
    validation: Arc<Examples>,
    built: BTreeMap<&'static str, Arc<Built>>,
    lineage: Lineage,
    key: String,
}

impl<'a> Lesson<'a> {
    fn of(stores: &Stores, task: &'a TrainTask, control: &Control) -> Result<Self, TaskError> {
        let (place, settings) = (&task.source, &task.train);
        let dataset = stores
            .open_source(&place.store, &place.dataset, control)
            .map_err(|e| at("source", e))?;
        let models = stores
            .models(&place.store, control)
            .map_err(|e| at("source.store", e))?;
        let split = ("train.split", &*settings.split);
        let sides = sides(stores, &dataset, split, ["train", "validation"], control)?;
        let [mut training, validation] = sides.scenes;
        first(&mut training, settings.scenes, "train.scenes")?;
        if validation.is_empty() && settings.optimise.early_stop > 0 {
            return Err(TaskError::User(format!(
                "train.optimise.early_stop: the split {:?} has no validation scenes to tell when; give it some, or 0",
                settings.split
            )));
        }
        let (built, sha256) = read_models(stores, &models, settings, control)?;
        let pin = |scenes: &[u64]| pin(stores, &dataset, scenes, control);
        let pins = [pin(&training)?, pin(&validation)?];
        let mut used: Vec<u64> = training.iter().chain(&validation).copied().collect();
        used.sort_unstable();
        let by_field: BTreeMap<&str, String> = sha256
            .iter()
            .map(|(field, _, sha)| (*field, sha.clone()))
            .collect();
        let key = training_key(settings, [&pins[0], &pins[1]], &by_field).to_string();
        let lineage = Lineage {
            dataset: place.dataset.clone(),
            data: pin(&used)?,
            split: sides.split,
            training_scenes: training.len() as u64,
            validation_scenes: validation.len() as u64,
            code: settings.version.clone(),
            seed: settings.seed,
            models: sha256
                .into_iter()
                .map(|(_, name, sha)| (name, sha))
                .collect(),
        };
        let histogram = (settings.histogram, &*settings.spots);
        let examples = |scenes| Examples::new(stores, &dataset, histogram, scenes, "train");
        Ok(Self {
            task,
            models,
            training: examples(training)?,
            validation: examples(validation)?,
            built,
            lineage,
            key,
        })
    }

    /// What was asked for, as the manifest tells it.
    fn settings(&self) -> serde_json::Value {
        self.task.train.shaping()
    }

    fn plan(&self, control: &Control) -> Result<Plan, TaskError> {
        let settings = &self.task.train;
        let max = match (settings.input.normalise, settings.input.max) {
            (Normalise::Log, 0.0) => largest_bin(&*self.training, control)?,
            (_, max) => max as f32,
        };
        let model = |field: &str| self.built.get(field).cloned();
        Ok(Plan {
            settings: settings.shaping(),
            tof: model("train.shadow.tof"),
            on: model("train.specular.on"),
            from: model("train.from"),
            max,
        })
    }

    fn train(
        &self,
        stores: &Stores,
        control: &Control,
    ) -> Result<picofarm_model::Trained, TaskError> {
        let (name, key) = (&self.task.train.model, &*self.key);
        let plan = self.plan(control)?;
        let (train, validate) = (self.training.clone(), self.validation.clone());
        let newest = stores.wait(control, self.models.newest_checkpoint(name, key))?;
        let mut training = match newest {
            None => Training::start(plan, train, validate),
            Some((step, content)) => {
                info!("goes on from the checkpoint after {step} steps");
                Training::resume(plan, train, validate, &content)
            }
        }
        .map_err(of_model)?;
        let mut saver = Saver::new(stores, &self.models, name, key);
        let every = Duration::from_secs_f64(self.task.train.checkpoint_minutes * 60.0);
        let mut teller = Teller::new(control, self.task.train.optimise.epochs);
        loop {
            let due = Instant::now() + every;
            let ended = training.run(&mut |event| {
                teller.hear(&event);
                match (control.stopped(), Instant::now() >= due) {
                    (true, _) => picofarm_model::Control::Stop,
                    (false, true) => picofarm_model::Control::Checkpoint,
                    (false, false) => picofarm_model::Control::Continue,
                }
            });
            match ended.map_err(of_model)? {
                Ended::Finished => break,
                Ended::Paused => {
                    let content = Bytes::from(training.checkpoint());
                    saver.save(training.step(), content);
                    if control.stopped() {
                        saver.last();
                        return Err(TaskError::Stopped);
                    }
                }
            }
        }
        saver.last();
        training.finish().map_err(of_model)
    }
}

/// The model if this very training has published it.
fn finished(
    stores: &Stores,
    models: &Models,
    name: &str,
    key: &str,
    control: &Control,
) -> Result<Option<ModelManifest>, TaskError> {
    let looked = async {
        match models.finished(name, key).await {
            Err(error @ DatasetError::Damaged { .. }) => {
                warn!(%error, "a model is damaged; it is trained again to mend it");
                Ok(None)
            }
            other => other,
        }
    };
    stores.wait(control, looked).map_err(|e| at("train", e))
}

/// The models that a training builds on: ready to be used, by field; and field, name and SHA-256 of the manifest.
type Read = (
    BTreeMap<&'static str, Arc<Built>>,
    Vec<(&'static str, String, String)>,
);

fn read_models(
    stores: &Stores,
    models: &Models,
    settings: &TrainSettings,
    control: &Control,
) -> Result<Read, TaskError> {
    let (mut built, mut sha256) = (BTreeMap::new(), Vec::new());
    for (field, name) in settings.models() {
        let (manifest, model) =
            read_model(stores, models, name, control).map_err(|e| at(field, e))?;
        let wants_tof = field != "train.from";
        let wanted = if wants_tof {
            "tof"
        } else {
            settings.task.name()
        };
        if manifest.kind != wanted {
            return Err(TaskError::User(format!(
                "{field}: {name:?} predicts {:?}, but one that predicts {wanted:?} is needed",
                manifest.kind
            )));
        }
        sha256.push((field, name.clone(), manifest.sha256()));
        built.insert(field, Arc::new(model));
    }
    Ok((built, sha256))
}

/// A model from a store, ready to be used.
pub(super) fn read_model(
    stores: &Stores,
    models: &Models,
    name: &str,
    control: &Control,
) -> Result<(ModelManifest, Built), TaskError> {
    let manifest = stores.wait(control, models.manifest(name))?;
    let weights = stores.wait(control, models.read(&manifest, WEIGHTS))?;
    let settings = manifest.settings.clone();
    let weights = weights.to_vec();
    Ok((manifest, Built { settings, weights }))
}

/// What pins the bytes of scenes, in this order.
pub(super) fn pin(
    stores: &Stores,
    dataset: &Dataset,
    scenes: &[u64],
    control: &Control,
) -> Result<String, TaskError> {
    let pinned = stores.wait(control, dataset.pin(scenes));
    pinned.map_err(|e| at("source", e))
}

/// Refuses another version of the code than this program's.
pub(super) fn check_version(of: &str, asked: &str) -> Result<(), TaskError> {
    let ours = model_version();
    if asked == ours {
        return Ok(());
    }
    Err(TaskError::User(format!(
        "{of}.version: the job asks for {asked:?}, this worker's networks are {ours:?}; submit the job again with this \
         version, or run workers of the other one"
    )))
}

/// The largest bin of all scenes.
fn largest_bin(scenes: &dyn Scenes, control: &Control) -> Result<f32, TaskError> {
    let mut max = 0.0f32;
    for index in 0..scenes.len() {
        control.say(
            format!(
                "looks for the largest bin: scene {index} of {}",
                scenes.len()
            ),
            &[],
        );
        if control.stopped() {
            return Err(TaskError::Stopped);
        }
        let scene = scenes.load(index).map_err(|source| {
            of_model(ModelError::Scene {
                scene: index,
                source,
            })
        })?;
        max = scene.histogram.iter().copied().fold(max, f32::max);
    }
    match max > 0.0 {
        true => Ok(max),
        false => Err(TaskError::User(
            "train.input.normalise: \"log\" needs light, but every bin of every training scene is 0".into(),
        )),
    }
}

/// Who is to blame for a training's error.
pub(super) fn of_model(error: ModelError) -> TaskError {
    match error {
        ModelError::Scene { scene, source } => match source.downcast::<DatasetError>() {
            Ok(error) => of_dataset(*error),
            Err(error) => TaskError::Crash(format!("scene {scene}: {error}")),
        },
        // What is in the store has its checksum: this program made it, and does not know it again.
        ModelError::Weights { what } => TaskError::Crash(what),
        other => TaskError::User(other.to_string()),
    }
}

pub(super) fn at(field: &str, error: TaskError) -> TaskError {
    match error {
        TaskError::User(text) => TaskError::User(format!("{field}: {text}")),
        other => other,
    }
}

fn output(manifest: &ModelManifest, adopted: bool) -> Output {
    Output {
        manifest_sha256: manifest.sha256(),
        bytes: manifest.total_bytes(),
        adopted,
    }
}

fn pretty(value: &serde_json::Value) -> Vec<u8> {
    let mut value = value.clone();
    value.sort_all_objects();
    let mut bytes = serde_json::to_vec_pretty(&value).expect("figures are plain data");
    bytes.push(b'\n');
    bytes
}
