//! The models of an infer stage. They are checked before anything is read or computed, and their
//! manifests name the predictions.

use std::collections::BTreeMap;

use picofarm_dataset::{Dataset, Manifest};
use picofarm_proto::{
    key::inference_key,
    spec::{
        Histogram, InferTask,
        train::{TRUTH, Target},
    },
};
use picofarm_results::{
    ModelUsed, Models, PinnedDepths, PredictionManifest, PredictionSpec, Predictions, SceneUsed,
    TimesUsed,
};
use picofarm_store::published::Manifest as _;

use crate::{
    input::{
        examples::Examples,
        models::{CheckedModel, trained},
        times::{self, Taken},
        truth::{self, Need},
    },
    stores::{Stores, manifest_sha256},
    task::{Control, TaskError},
};

/// A histogram, and the spots that are summed if it is `transient_spots`.
pub(super) type ReadHistogram = (Histogram, Vec<u32>);

/// A model and its input.
pub(super) struct Member {
    /// The field of the job that names it.
    pub(super) field: String,
    pub(super) checked: CheckedModel,
    pub(super) histogram: Histogram,
    pub(super) spots: Vec<u32>,
    /// The source's spots that contribute to the histogram.
    lit_by: Vec<u32>,
}

/// The models of a stage: at most one of each kind.
pub(super) struct Panel {
    pub(super) tof: Option<Member>,
    pub(super) shadow: Option<Member>,
    pub(super) specular: Option<Member>,
    /// Source of the two-bounce times, if the shadow network takes them.
    pub(super) times: Option<Times>,
}

/// Source of two-bounce times.
pub(super) enum Times {
    Truth,
    /// Depths of the stage's own ToF model.
    Own,
    /// Stored predictions, with whose depths or evidence the shadow network was trained.
    Stored(Box<(Predictions, PinnedDepths)>),
}

impl Panel {
    pub(super) fn open(
        stores: &Stores,
        models: &Models,
        dataset: &Dataset,
        (task, found): (&InferTask, &Manifest),
        control: &Control,
    ) -> Result<Self, TaskError> {
        let mut by_kind: BTreeMap<String, Member> = BTreeMap::new();
        let mut times_of_shadow = TRUTH.to_owned();
        for (i, name) in task.infer.models.iter().enumerate() {
            let field = format!("infer.models[{i}]");
            let checked =
                CheckedModel::look(stores, models, (&field, name), dataset.spec(), control)?;
            let settings = trained(&checked.manifest.settings).map_err(|what| {
                TaskError::User(format!(
                    "{field}: the settings of {name:?} are not known: {what}"
                ))
            })?;
            let (histogram, spots) = match task.infer.histogram {
                Some(histogram) => (histogram, task.infer.spots.clone()),
                None => (settings.histogram, settings.spots),
            };
            let kind = checked.manifest.kind.clone();
            if kind == Target::Shadow.name() {
                times_of_shadow = settings.shadow.times;
            }
            let member = Member::new(stores, dataset, field, checked, (histogram, spots))?;
            if let Some(other) = by_kind.insert(kind.clone(), member) {
                return Err(TaskError::User(format!(
                    "infer.models: {:?} and {name:?} both predict {kind:?}; name one of each kind, and give the other a \
                     stage of its own",
                    other.checked.manifest.name
                )));
            }
        }
        let mut take = |kind: Target| by_kind.remove(kind.name());
        let (tof, shadow, specular) = (
            take(Target::Tof),
            take(Target::Shadow),
            take(Target::Specular),
        );
        let taking = shadow.as_ref().and_then(|shadow| {
            let taken = Taken::by(&shadow.checked.plan.question)?;
            Some((shadow, taken))
        });
        let times = match (taking, &tof) {
            (None, _) => None,
            (Some((_, Taken::Times)), Some(_)) => Some(Times::Own),
            (Some((_, Taken::Times)), None) if times_of_shadow == TRUTH => Some(Times::Truth),
            (Some((shadow, taken)), _) => {
                let field = format!(
                    "{}: its two-bounce times (a \"tof\" model in infer.models gives others)",
                    shadow.field
                );
                let (store, named) = (&task.source.store, (&*field, &*times_of_shadow));
                let times = times::Times::open(stores, store, dataset, named, taken, control)?;
                let scene = [found.scene];
                let seen = stores.wait(control, dataset.pin(&scene))?;
                let pinned = times.pin(stores, &field, &scene, &seen, control)?;
                times
                    .predictions
                    .zip(pinned)
                    .map(|kept| Times::Stored(Box::new(kept)))
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

    /// Returns the quantities that the scenes must have.
    pub(super) fn needs(&self) -> Vec<Need> {
        let from_truth = matches!(self.times, Some(Times::Truth));
        let timed = self
            .shadow
            .as_ref()
            .is_some_and(|m| m.checked.plan.question.timed());
        truth::of_times(timed, from_truth)
    }

    /// Returns the layout of the group of predictions.
    pub(super) fn spec(&self, dataset: &Dataset) -> PredictionSpec {
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
            confidence: false,
            evidence: None,
        }
    }

    /// Returns the manifest of a scene's predictions, without the list of its objects.
    pub(super) fn manifest(
        &self,
        task: &InferTask,
        index: u64,
        found: &Manifest,
    ) -> PredictionManifest {
        let times = match &self.times {
            None => None,
            Some(Times::Truth) => Some(TimesUsed::Truth),
            Some(Times::Own) => self.tof.as_ref().map(|tof| TimesUsed::Model(tof.used())),
            Some(Times::Stored(kept)) => kept.1.model.clone().map(TimesUsed::Model),
        };
        let source = SceneUsed {
            dataset: task.source.dataset.clone(),
            task_key: found.provenance.task_key.clone(),
            manifest_sha256: manifest_sha256(found),
        };
        let shown = self.members().map(|(kind, member)| {
            let sha256 = member.checked.manifest.sha256();
            (
                kind.name(),
                (sha256, member.histogram, member.spots.clone()),
            )
        });
        let times_of = match (&self.times, &times) {
            (Some(Times::Stored(kept)), _) => &*kept.1.id,
            (_, None) => "",
            (_, Some(TimesUsed::Truth)) => TRUTH,
            (_, Some(TimesUsed::Model(model))) => &model.manifest_sha256,
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
}

impl Member {
    fn new(
        stores: &Stores,
        dataset: &Dataset,
        field: String,
        checked: CheckedModel,
        (histogram, spots): ReadHistogram,
    ) -> Result<Self, TaskError> {
        let scenes = Examples::new(stores, dataset, (histogram, &spots), Vec::new(), "infer")?;
        let (wanted, there) = (checked.plan.question.spots, scenes.spots());
        if wanted > 0 && wanted != there {
            return Err(TaskError::User(format!(
                "{field}: {:?} was trained on histograms of {wanted} spots, these are of {there}",
                checked.manifest.name
            )));
        }
        Ok(Self {
            lit_by: scenes.spot_numbers(),
            field,
            checked,
            histogram,
            spots,
        })
    }

    fn used(&self) -> ModelUsed {
        ModelUsed {
            name: self.checked.manifest.name.clone(),
            manifest_sha256: self.checked.manifest.sha256(),
            histogram: self.histogram.name().to_owned(),
            spots: self.spots.clone(),
        }
    }
}
