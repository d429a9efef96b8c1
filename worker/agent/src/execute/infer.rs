//! Inference: what trained models see in a scene, kept beside the data set. Adopt, or ask each model and publish.
//!
//! A shadow network that is given two-bounce times is given those that follow from the depths of the stage's own ToF model;
//! where the stage has none, those it is evaluated with: of the ToF model that it was trained with, or the truth's.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex},
};

use picofarm_dataset::{
    Dataset, DatasetError, ENCODER_VERSION, Manifest, ModelUsed, Models, Predicted,
    PredictionManifest, PredictionSpec, Predictions, SceneUsed, TimesUsed,
};
use picofarm_model::{
    Model,
    input::ShadowVariant,
    masks,
    scene::{Scene, Scenes},
};
use picofarm_proto::{
    key::inference_key,
    model::{Histogram, InferTask, train::TRUTH, train::Target},
};
use tracing::warn;

use super::{
    Control, Output, TaskError,
    evaluate::trained,
    examples::Examples,
    output::{Stores, manifest_sha256, of_dataset},
    reprocess::source_manifest,
    train::{Met, at, model_version, of_model},
};

/// Progress once everything is asked.
const ASKED: f32 = 0.95;

/// Everything of this program that decides the bytes of predictions: networks and encoder. Part of every key.
pub fn infer_version() -> String {
    format!("{}/{ENCODER_VERSION}", model_version())
}

/// Models that are kept from task to task: those of the latest one, by the SHA-256 of their manifests.
#[derive(Default)]
pub(super) struct Minds(Mutex<BTreeMap<String, Arc<Model>>>);

/// Lets models see scene `index`; with `force` although what they see is there.
pub(super) fn run(
    stores: &Stores,
    minds: &Minds,
    task: &InferTask,
    force: bool,
    index: u64,
    control: &Control,
) -> Result<Output, TaskError> {
    task.check().map_err(|e| TaskError::User(e.to_string()))?;
    let ours = infer_version();
    if task.infer.version != ours {
        return Err(TaskError::User(format!(
            "infer.version: the job asks for {:?}, this worker's networks are {ours:?}; submit the job again with this \
             version, or run workers of the other one",
            task.infer.version
        )));
    }
    let place = &task.source;
    let dataset = stores
        .open_source(&place.store, &place.dataset, control)
        .map_err(|e| at("source", e))?;
    let found = source_manifest(stores, &dataset, index, control)?;
    let models = stores
        .source_models(&place.store)
        .map_err(|e| at("source.store", e))?;
    let panel = Panel::of(stores, &models, &dataset, task, control)?;
    let manifest = panel.manifest(task, index, &found);
    let (store, prefix) = stores.probed(&task.output.store, control)?;
    let prefix = prefix.join(&*task.output.dataset);
    let spec = panel.spec(&dataset);
    let opened = Predictions::create_or_open(store, prefix, &spec);
    let predictions = stores
        .wait(control, opened)
        .map_err(|e| at("output.dataset", e))?;
    let finished = match force {
        true => None,
        false => finished(stores, &predictions, &manifest, control)?,
    };
    if let Some(there) = finished {
        return Ok(output(&there, true));
    }
    let predicted = panel.ask(stores, (&models, minds), &dataset, index, control)?;
    let encoded = predictions
        .encode(manifest, &predicted)
        .map_err(of_dataset)?;
    stores.patiently(control, async || predictions.publish(&encoded).await)?;
    control.at(1.0);
    Ok(output(&encoded.manifest, false))
}

fn output(manifest: &PredictionManifest, adopted: bool) -> Output {
    Output {
        manifest_sha256: manifest.sha256(),
        bytes: manifest.total_bytes(),
        adopted,
    }
}

/// What is there if this very task has published it.
fn finished(
    stores: &Stores,
    predictions: &Predictions,
    ours: &PredictionManifest,
    control: &Control,
) -> Result<Option<PredictionManifest>, TaskError> {
    let looked = async {
        match predictions.finished(ours.scene, &ours.task_key).await {
            Err(error @ DatasetError::Damaged { .. }) => {
                warn!(%error, "what was predicted is damaged; it is predicted again to mend it");
                Ok(None)
            }
            other => other,
        }
    };
    stores.wait(control, looked)
}

/// A model, and what it is shown.
struct Member {
    /// The field of the job that names it.
    field: String,
    met: Met,
    histogram: Histogram,
    spots: Vec<u32>,
    /// What the histogram is the light of, of the source's spots.
    lit_by: Vec<u32>,
}

/// The models of a stage: at most one of each kind.
struct Panel {
    tof: Option<Member>,
    shadow: Option<Member>,
    specular: Option<Member>,
    /// Whether the shadow network is given two-bounce times, and by which model where by none of the stage's.
    times: Option<Times>,
}

/// What two-bounce times follow from.
enum Times {
    Truth,
    /// The stage's own ToF model.
    Own,
    /// The one that the shadow network was trained with.
    Other(Member),
}

impl Panel {
    fn of(
        stores: &Stores,
        models: &Models,
        dataset: &Dataset,
        task: &InferTask,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let mut by_kind: BTreeMap<String, Member> = BTreeMap::new();
        let mut tof_of_shadow = TRUTH.to_owned();
        for (i, name) in task.infer.models.iter().enumerate() {
            let field = format!("infer.models[{i}]");
            let met = Met::look(stores, models, (&field, name), dataset.spec(), control)?;
            let settings = trained(&met.manifest.settings).map_err(|what| {
                TaskError::User(format!(
                    "{field}: the settings of {name:?} are not known: {what}"
                ))
            })?;
            let (histogram, spots) = match task.infer.histogram {
                Some(histogram) => (histogram, task.infer.spots.clone()),
                None => (settings.histogram, settings.spots),
            };
            let kind = met.manifest.kind.clone();
            if kind == Target::Shadow.name() {
                tof_of_shadow = settings.shadow.tof;
            }
            let member = Member::new(stores, dataset, field, met, (histogram, spots))?;
            if let Some(other) = by_kind.insert(kind.clone(), member) {
                return Err(TaskError::User(format!(
                    "infer.models: {:?} and {name:?} both predict {kind:?}; name one of each kind, and give the other a \
                     stage of its own",
                    other.met.manifest.name
                )));
            }
        }
        let mut take = |kind: Target| by_kind.remove(kind.name());
        let (tof, shadow, specular) = (
            take(Target::Tof),
            take(Target::Shadow),
            take(Target::Specular),
        );
        let timed = |member: &&Member| {
            let variant = member.met.plan.question.variant;
            matches!(variant, ShadowVariant::Concat | ShadowVariant::Difference)
        };
        let times = match (shadow.as_ref().filter(timed), &tof) {
            (None, _) => None,
            (Some(_), Some(_)) => Some(Times::Own),
            (Some(_), None) if tof_of_shadow == TRUTH => Some(Times::Truth),
            (Some(shadow), None) => {
                let field = format!("{}: its two-bounce times", shadow.field);
                let at = (&*field, &*tof_of_shadow);
                let met = Met::look(stores, models, at, dataset.spec(), control)?;
                let shown = (shadow.histogram, shadow.spots.clone());
                let member = Member::new(stores, dataset, field, met, shown)?;
                Some(Times::Other(member))
            }
        };
        Ok(Self {
            tof,
            shadow,
            specular,
            times,
        })
    }

    fn members(&self) -> impl Iterator<Item = (Target, &Member)> {
        [
            (Target::Tof, &self.tof),
            (Target::Shadow, &self.shadow),
            (Target::Specular, &self.specular),
        ]
        .into_iter()
        .filter_map(|(kind, member)| Some((kind, member.as_ref()?)))
    }

    /// What the group of predictions holds.
    fn spec(&self, dataset: &Dataset) -> PredictionSpec {
        let source = dataset.spec();
        PredictionSpec {
            scenes: source.scenes,
            height: source.height,
            width: source.width,
            depth: self.tof.is_some(),
            spots: self
                .shadow
                .as_ref()
                .map_or(Vec::new(), |m| m.lit_by.clone()),
            specular: self.specular.is_some(),
        }
    }

    /// The manifest of what is predicted of a scene, but for its objects.
    fn manifest(&self, task: &InferTask, index: u64, found: &Manifest) -> PredictionManifest {
        let times = match &self.times {
            None => None,
            Some(Times::Truth) => Some(TimesUsed::Truth),
            Some(Times::Own) => self.tof.as_ref().map(|tof| TimesUsed::Model(tof.used())),
            Some(Times::Other(tof)) => Some(TimesUsed::Model(tof.used())),
        };
        let source = SceneUsed {
            dataset: task.source.dataset.clone(),
            task_key: found.provenance.task_key.clone(),
            manifest_sha256: manifest_sha256(found),
        };
        let shown = self.members().map(|(kind, member)| {
            let sha256 = member.met.manifest.sha256();
            (
                kind.name(),
                (sha256, member.histogram, member.spots.clone()),
            )
        });
        let times_of = match &times {
            None => "",
            Some(TimesUsed::Truth) => TRUTH,
            Some(TimesUsed::Model(model)) => &model.manifest_sha256,
        };
        let version = &task.infer.version;
        let shown = shown.collect();
        let key = inference_key(&source.manifest_sha256, &shown, times_of, version);
        PredictionManifest {
            scene: index,
            task_key: key.to_string(),
            code: version.clone(),
            source,
            models: self
                .members()
                .map(|(kind, member)| (kind.name().to_owned(), member.used()))
                .collect(),
            two_bounce_times: times,
            ..PredictionManifest::default()
        }
    }

    /// Asks all models of a scene.
    fn ask(
        &self,
        stores: &Stores,
        (models, minds): (&Models, &Minds),
        dataset: &Dataset,
        index: u64,
        control: &Control,
    ) -> Result<Predicted, TaskError> {
        let mut asked = Asked {
            stores,
            models,
            dataset,
            index,
            control,
            minds: minds.0.lock().expect("no panic while locked").clone(),
            used: BTreeMap::new(),
            seen: Vec::new(),
        };
        let mut predicted = Predicted::default();
        if let Some(tof) = &self.tof {
            predicted.depth_m = asked.depth(tof)?;
            asked.proceed(0.3)?;
        }
        if let Some(shadow) = &self.shadow {
            let depth = match &self.times {
                None | Some(Times::Truth) => None,
                Some(Times::Own) => Some(predicted.depth_m.clone()),
                Some(Times::Other(tof)) => Some(asked.depth(tof)?),
            };
            predicted.lit = asked.masks(shadow, depth.as_deref(), 0.3..0.8)?;
        }
        if let Some(specular) = &self.specular {
            predicted.specular = asked.masks(specular, None, 0.8..ASKED)?;
        }
        *minds.0.lock().expect("no panic while locked") = asked.used;
        Ok(predicted)
    }
}

impl Member {
    fn new(
        stores: &Stores,
        dataset: &Dataset,
        field: String,
        met: Met,
        (histogram, spots): (Histogram, Vec<u32>),
    ) -> Result<Self, TaskError> {
        let scenes = Examples::new(stores, dataset, (histogram, &spots), Vec::new(), "infer")?;
        let (wanted, there) = (met.plan.question.spots, scenes.spots());
        if wanted > 0 && wanted != there {
            return Err(TaskError::User(format!(
                "{field}: {:?} was trained on histograms of {wanted} spots, these are of {there}",
                met.manifest.name
            )));
        }
        Ok(Self {
            lit_by: scenes.spot_numbers(),
            field,
            met,
            histogram,
            spots,
        })
    }

    fn used(&self) -> ModelUsed {
        ModelUsed {
            name: self.met.manifest.name.clone(),
            manifest_sha256: self.met.manifest.sha256(),
            histogram: self.histogram.name().to_owned(),
            spots: self.spots.clone(),
        }
    }
}

/// Models being asked of a scene.
struct Asked<'a> {
    stores: &'a Stores,
    models: &'a Models,
    dataset: &'a Dataset,
    index: u64,
    control: &'a Control,
    /// Models at hand, and those that were asked.
    minds: BTreeMap<String, Arc<Model>>,
    used: BTreeMap<String, Arc<Model>>,
    /// The scene with each histogram that was read.
    seen: Vec<((Histogram, Vec<u32>), Arc<Scene>)>,
}

impl Asked<'_> {
    fn model(&mut self, member: &Member) -> Result<Arc<Model>, TaskError> {
        let sha256 = member.met.manifest.sha256();
        let model = match self.minds.get(&sha256) {
            Some(model) => model.clone(),
            None => {
                let (stores, models, control) = (self.stores, self.models, self.control);
                let read = member.met.model(stores, models, &member.field, control);
                Arc::new(read?)
            }
        };
        self.used.insert(sha256, model.clone());
        Ok(model)
    }

    fn scene(&mut self, member: &Member) -> Result<Arc<Scene>, TaskError> {
        let shown = (member.histogram, member.spots.clone());
        if let Some((_, scene)) = self.seen.iter().find(|(other, _)| *other == shown) {
            return Ok(scene.clone());
        }
        let (stores, dataset) = (self.stores, self.dataset);
        let histogram = (shown.0, &*shown.1);
        let scenes = Examples::new(stores, dataset, histogram, vec![self.index], "infer")?;
        let scene = scenes.load(0).map_err(|source| {
            of_model(picofarm_model::ModelError::Scene {
                scene: self.index as usize,
                source,
            })
        })?;
        self.seen.push((shown, scene.clone()));
        Ok(scene)
    }

    fn depth(&mut self, tof: &Member) -> Result<Vec<f32>, TaskError> {
        self.control
            .say(format!("asks {}", tof.met.manifest.name), &[]);
        let (model, scene) = (self.model(tof)?, self.scene(tof)?);
        model.depth_m(&scene).map_err(of_model)
    }

    fn masks(
        &mut self,
        member: &Member,
        depth_m: Option<&[f32]>,
        share: std::ops::Range<f32>,
    ) -> Result<Vec<u8>, TaskError> {
        let (model, scene) = (self.model(member)?, self.scene(member)?);
        let name = &member.met.manifest.name;
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
        let said = masks(&model, depth_m, &scene, &mut tell).map_err(of_model)?;
        said.ok_or(TaskError::Stopped)
    }

    fn proceed(&self, fraction: f32) -> Result<(), TaskError> {
        match self.control.at(fraction) {
            true => Ok(()),
            false => Err(TaskError::Stopped),
        }
    }
}
