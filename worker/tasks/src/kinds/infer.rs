//! Inference: stores the predictions of trained models for a scene, next to the data set. The task
//! adopts predictions that exist, or runs each model and publishes the result.
//!
//! A shadow network that takes two-bounce times receives those derived from the depths of the
//! stage's own ToF model. If the stage has no such model, it receives the kind of times that it was
//! trained with: derived from stored predictions, or from the true depths.

use std::{collections::BTreeMap, sync::Arc};

use picofarm_dataset::{Dataset, ENCODER_VERSION};
use picofarm_model::{
    Device, Model, ModelError, masks,
    scene::{Scene, Scenes},
};
use picofarm_proto::spec::{InferTask, TaskSpec};
use picofarm_results::{Models, Predicted, Predictions};
use picofarm_store::published::Manifest as _;

mod panel;

use crate::{
    errors::{dataset_error, in_field, model_error, prediction_error},
    input::{examples::Examples, models::model_version, source_manifest, truth},
    making::predicted::{self, agreement},
    stores::Stores,
    task::{self, Context, Control, Latest, Output, RunTask, Task, TaskError},
};
use panel::{Member, Panel, ReadHistogram, Times};

/// Progress of the task when all models have run.
const ASKED: f32 = 0.95;

/// Returns the version of all code of this program that determines the bytes of predictions and
/// their manifests: networks, encoder and agreement figures. Part of every key.
pub fn infer_version() -> String {
    format!(
        "{}/{ENCODER_VERSION}/{}",
        model_version(),
        agreement::VERSION
    )
}

impl RunTask for InferTask {
    fn code_version() -> String {
        infer_version()
    }

    /// Runs the models on scene `index`; with `force`, even if its predictions exist.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, cache) = (&context.stores, &context.models);
        let (device, on_gpu) = (context.device(task)?, context.gpu(task).is_some());
        let (force, index) = (task.spec.force, task.index);
        let task = self;
        let place = &task.source;
        let dataset = stores
            .open_source(&place.store, &place.dataset, control)
            .map_err(|e| in_field("source", e))?;
        stores.fits(TaskSpec::Infer(task.clone()), Some(dataset.spec()))?;
        let found = source_manifest(stores, &dataset, index, control)?;
        let models = stores
            .source_models(&place.store, control)
            .map_err(|e| in_field("source.store", e))?;
        let panel = Panel::open(stores, &models, &dataset, (task, &found), control)?;
        truth::check(
            &dataset.place(),
            &panel.needs(),
            &[(index, found.missing())],
        )?;
        let mut manifest = panel.manifest(task, index, &found);
        let (store, prefix) = stores.probed(&task.output.store, control)?;
        let prefix = prefix.join(&*task.output.dataset);
        let spec = panel.spec(&dataset);
        let opened = Predictions::create_or_open(store, prefix, &spec);
        let predictions = stores
            .wait(control, opened)
            .map_err(|e| in_field("output.dataset", e))?;
        if !force && let Some(there) = predicted::adopted(stores, &predictions, &manifest, control)?
        {
            return Ok(there);
        }
        let answers = panel.ask(
            stores,
            (&models, cache),
            (device, on_gpu),
            (&dataset, index),
            control,
        )?;
        manifest.agreement =
            agreement::measure(stores, (&dataset, index), &answers, &spec.spots, control)?;
        let encoded = predictions
            .encode(manifest, &answers)
            .map_err(dataset_error)?;
        predicted::publish(stores, &predictions, &encoded, control)
    }
}

impl Panel {
    /// Runs all models on a scene.
    fn ask(
        &self,
        stores: &Stores,
        (models, cache): (&Models, &Latest<task::Models>),
        (device, on_gpu): (Device, bool),
        (dataset, index): (&Dataset, u64),
        control: &Control,
    ) -> Result<Predicted, TaskError> {
        let mut asked = Inference {
            stores,
            models,
            device,
            on_gpu,
            dataset,
            index,
            control,
            cache: cache.get(),
            used: BTreeMap::new(),
            seen: Vec::new(),
        };
        let mut predicted = Predicted::default();
        if let Some(tof) = &self.tof {
            predicted.depth_m = asked.depth(tof)?;
            asked.proceed(0.3)?;
        }
        if let Some(shadow) = &self.shadow {
            let sees = shadow.checked.plan.question.sees_evidence();
            let taken = match &self.times {
                None | Some(Times::Truth) => Seen::Scene,
                Some(Times::Own) => Seen::Depth(predicted.depth_m.clone()),
                Some(Times::Stored(stored)) if sees => Seen::Evidence(&stored.0),
                Some(Times::Stored(stored)) => {
                    Seen::Depth(stores.wait(control, stored.0.read_depth(index))?)
                }
            };
            predicted.lit = asked.masks(shadow, taken, 0.3..0.8)?;
        }
        if let Some(specular) = &self.specular {
            predicted.specular = asked.masks(specular, Seen::Scene, 0.8..ASKED)?;
        }
        cache.set(asked.used);
        Ok(predicted)
    }
}

/// What a mask's network sees.
enum Seen<'a> {
    /// A scene as it is stored.
    Scene,
    /// The same, with two-bounce times from these depths.
    Depth(Vec<f32>),
    /// The evidence in these predictions.
    Evidence(&'a Predictions),
}

/// Models in use for one scene.
struct Inference<'a> {
    stores: &'a Stores,
    models: &'a Models,
    device: Device,
    on_gpu: bool,
    dataset: &'a Dataset,
    index: u64,
    control: &'a Control,
    /// Cached models, and the models that this task has used.
    cache: task::Models,
    used: task::Models,
    /// The scene with each histogram that has been read.
    seen: Vec<(ReadHistogram, Arc<Scene>)>,
}

impl Inference<'_> {
    fn model(&mut self, member: &Member) -> Result<Arc<Model>, TaskError> {
        let which = (member.checked.manifest.sha256(), self.on_gpu);
        let model = match self.cache.get(&which) {
            Some(model) => model.clone(),
            None => {
                let (stores, models, control) = (self.stores, self.models, self.control);
                let read =
                    member
                        .checked
                        .model(stores, models, (&member.field, &self.device), control);
                Arc::new(read?)
            }
        };
        self.used.insert(which, model.clone());
        Ok(model)
    }

    /// Returns the scene with its evidence, and no histogram.
    fn evidence(&self, member: &Member, of: &Predictions) -> Result<Arc<Scene>, TaskError> {
        let histogram = (member.histogram, &*member.spots);
        let scenes = Examples::new(
            self.stores,
            self.dataset,
            histogram,
            vec![self.index],
            "infer",
        )?
        .seeing(Some(of.clone()), &member.field)?;
        self.load(&scenes)
    }

    fn load(&self, scenes: &Examples) -> Result<Arc<Scene>, TaskError> {
        scenes.load(0).map_err(|source| {
            model_error(ModelError::Scene {
                scene: self.index as usize,
                source,
            })
        })
    }

    fn scene(&mut self, member: &Member) -> Result<Arc<Scene>, TaskError> {
        let shown = (member.histogram, member.spots.clone());
        if let Some((_, scene)) = self.seen.iter().find(|(other, _)| *other == shown) {
            return Ok(scene.clone());
        }
        let (stores, dataset) = (self.stores, self.dataset);
        let histogram = (shown.0, &*shown.1);
        let scenes = Examples::new(stores, dataset, histogram, vec![self.index], "infer")?;
        let scene = self.load(&scenes)?;
        self.seen.push((shown, scene.clone()));
        Ok(scene)
    }

    fn depth(&mut self, tof: &Member) -> Result<Vec<f32>, TaskError> {
        self.control
            .say(format!("asks {}", tof.checked.manifest.name), &[]);
        let (model, scene) = (self.model(tof)?, self.scene(tof)?);
        let place = self.dataset.place();
        let scenes = [self.index];
        let fault = prediction_error(&tof.checked.manifest.name, &place, &scenes);
        model.depth_m(&scene).map_err(fault)
    }

    /// Predicts masks.
    fn masks(
        &mut self,
        member: &Member,
        sees: Seen<'_>,
        share: std::ops::Range<f32>,
    ) -> Result<Vec<u8>, TaskError> {
        let model = self.model(member)?;
        let mut scene = match sees {
            Seen::Evidence(of) => self.evidence(member, of)?,
            Seen::Scene | Seen::Depth(_) => self.scene(member)?,
        };
        if let Seen::Depth(depth_m) = sees {
            // The scene is not copied, because nothing else refers to it.
            self.seen.retain(|(_, other)| !Arc::ptr_eq(other, &scene));
            Arc::make_mut(&mut scene).seen_depth_m = Some(depth_m);
            let shown = (member.histogram, member.spots.clone());
            self.seen.push((shown, scene.clone()));
        }
        let name = &member.checked.manifest.name;
        let mut tell = |mask: usize, of: usize| {
            let text = match of {
                1 => format!("asks {name}"),
                _ => format!("asks {name}: spot {mask}/{of}"),
            };
            self.control.say(text, &[]);
            let part = mask as f32 / of as f32;
            self.control
                .at(share.start + part * (share.end - share.start))
        };
        let place = self.dataset.place();
        let scenes = [self.index];
        let said =
            masks(&model, &scene, &mut tell).map_err(prediction_error(name, &place, &scenes))?;
        said.ok_or(TaskError::Stopped)
    }

    fn proceed(&self, fraction: f32) -> Result<(), TaskError> {
        match self.control.at(fraction) {
            true => Ok(()),
            false => Err(TaskError::Stopped),
        }
    }
}
