//! Evaluation: measures trained models on unseen scenes. One task, or one for each shard of the
//! scenes and one that joins them. The result is stored next to each model. Or measures stored
//! predictions of any origin; that result is stored next to them.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes, ModelNames, names},
    kind::{Declared, Dispatch, Manifest, Results, Taken, TaskKind, holds},
    names::{check_model, check_predictions, check_split, check_times},
    reprocess::Histogram,
    train::{TRUTH, check_spots, is_zero},
};
use crate::{
    show,
    spec::{
        destination::Destination,
        limits::check_count,
        memory::{BASE, Known},
        places::{SourceSettings, check_source},
        spec_error::SpecError,
    },
    split::SIDES,
};

/// Most models in one evaluation or one report.
pub(super) const MAX_MODELS: usize = 1_000;
/// Most shards of an evaluation.
const MAX_SHARDS: u32 = 10_000;

/// The fields of [`EvaluateSettings::times`] and [`EvaluateSettings::predictions`].
const TIMES: &str = "evaluate.times";
const PREDICTIONS: &str = "evaluate.predictions";

/// Evaluates models: one task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EvaluateTask {
    /// The data set with the scenes. The models are in the same store.
    pub source: SourceSettings,
    /// Number of scenes of the data set.
    pub count: u64,
    /// The models and the scenes.
    pub evaluate: EvaluateSettings,
}

/// The models and the scenes of an evaluation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluateSettings {
    /// Names of models, or of stages that train them (in a matrix, the name before the bracket
    /// means all of it). Empty with `predictions`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub models: Vec<String>,
    /// Instead of models: a demultiplex or infer stage, or the folder that one wrote. Its stored
    /// predictions are compared with the truth.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub predictions: String,
    /// The split of the data set.
    #[serde(default = "default_split")]
    pub split: String,
    /// `test` (default), `validation` or `train`.
    #[serde(default = "test")]
    pub side: String,
    /// Number of scenes of that side, the first by the split's order; 0 means all.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub scenes: u64,
    /// Histogram of the data set; defaults to each model's training histogram.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub histogram: Option<Histogram>,
    /// Only these spots, summed. Requires `histogram = "transient_spots"`, which in turn requires
    /// it; ascending.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub spots: Vec<u32>,
    /// Source of two-bounce times for shadow networks that use them, as in `train.shadow.times`;
    /// defaults to each model's training setting.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub times: String,
    /// Whether histograms pass through the sensor with which a model was trained, if any. With
    /// false they are used as stored. Default true.
    #[serde(default = "yes", skip_serializing_if = "is_yes")]
    pub sensor: bool,
    /// Number of shards, 1 to 10,000: tasks that each evaluate a part of the scenes. One more task
    /// joins their sums. The figures are bit-identical. Default 1: one task for all scenes.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub shards: u32,
    /// Version of networks and metrics, part of every task key; filled in at submission if omitted.
    #[serde(default)]
    pub version: String,
}

fn one() -> u32 {
    1
}

fn yes() -> bool {
    true
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_yes(sensor: &bool) -> bool {
    *sensor
}

fn is_one(shards: &u32) -> bool {
    *shards == 1
}

/// Evaluates models on a shard of the scenes, which the dependent evaluation joins: one task a
/// shard.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EvaluateShardTask {
    /// The evaluation.
    #[serde(flatten)]
    pub whole: EvaluateTask,
}

impl Declared for EvaluateShardTask {
    const NAME: &'static str = "evaluate_shard";
    const FIELDS: &'static [&'static str] = EvaluateTask::FIELDS;
    /// Written in job files as an evaluation with `shards`.
    const WRITTEN: bool = false;

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            whole: EvaluateTask::read(fields)?,
        })
    }
}

impl TaskKind for EvaluateShardTask {
    fn io(&self) -> Io<'_> {
        Io {
            makes: Makes::Nothing,
            ..self.whole.io()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        self.whole.io_mut()
    }

    fn check(&self) -> Result<(), SpecError> {
        self.whole.check()
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "evaluate_shard",
            "whole": self.whole.shaping(),
            "shards": self.whole.evaluate.shards,
        })
    }

    fn results(&self) -> Results<'_> {
        let source = &self.whole.source;
        Results {
            field: "source.store",
            store: &source.store,
            folder: format!("{}/evaluate/shards", source.dataset),
            destination: Destination::Shared,
            manifest: Manifest::None,
        }
    }

    fn memory(&self, known: &Known, threads: u32) -> Option<f64> {
        self.whole.memory(known, threads)
    }

    fn check_among(&self, before: &[&dyn TaskKind]) -> Result<(), SpecError> {
        self.whole.check_among(before)
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: u64::from(self.whole.evaluate.shards),
            ..Dispatch::default()
        }
    }
}

fn is_folder(times: &str) -> bool {
    !times.is_empty() && times != TRUTH
}

fn default_split() -> String {
    "default".into()
}

fn test() -> String {
    "test".into()
}

impl Declared for EvaluateTask {
    const NAME: &'static str = "evaluate";
    const FIELDS: &'static [&'static str] = &["source", "count", "evaluate"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            evaluate: fields.required("evaluate")?,
        })
    }
}

impl TaskKind for EvaluateTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("evaluate.version", &self.evaluate.version),
            source: Some(&self.source),
            folder: self.evaluate.folder(),
            split: Some(&self.evaluate.split),
            models: names("evaluate.models", &self.evaluate.models),
            makes: Makes::Evaluations,
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        let settings = &mut self.evaluate;
        let folder = match settings.predictions.is_empty() {
            true => is_folder(&settings.times).then_some((TIMES, &mut settings.times)),
            false => Some((PREDICTIONS, &mut settings.predictions)),
        };
        IoMut {
            version: Some(&mut settings.version),
            source: Some((&mut self.source, &mut self.count)),
            folder,
            models: ModelNames::List("evaluate.models", &mut settings.models),
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        self.evaluate.check()
    }

    fn shaping(&self) -> Value {
        let settings = EvaluateSettings {
            shards: 1,
            ..self.evaluate.clone()
        };
        json!({
            "stage": "evaluate",
            "source": self.source.shaping(),
            "count": self.count,
            "settings": settings,
        })
    }

    fn results(&self) -> Results<'_> {
        Results {
            field: "source.store",
            store: &self.source.store,
            folder: format!("{}/evaluate", self.source.dataset),
            destination: Destination::Shared,
            manifest: Manifest::None,
        }
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        let asked = known.networks.iter().map(|n| n.ask(source));
        Some(BASE + source.two() + asked.fold(0.0, f64::max))
    }

    /// The folder that models take depths or evidence from must have them.
    fn check_among(&self, before: &[&dyn TaskKind]) -> Result<(), SpecError> {
        if !self.evaluate.predictions.is_empty() {
            return Ok(());
        }
        let taken = |model: &String| {
            let place = Some((&self.source.store, model));
            let trained = before.iter().find(|task| task.trains() == place);
            let settings = trained.and_then(|task| task.training());
            settings.map_or(Taken::Unknown, Taken::of)
        };
        for model in &self.evaluate.models {
            holds(self, taken(model), before)?;
        }
        Ok(())
    }
}

impl EvaluateSettings {
    /// Returns the folder that is read in addition to the data set: predictions to compare, or
    /// those that two-bounce times come from.
    fn folder(&self) -> Option<(&'static str, &String)> {
        match self.predictions.is_empty() {
            true => is_folder(&self.times).then_some((TIMES, &self.times)),
            false => Some((PREDICTIONS, &self.predictions)),
        }
    }

    /// Checks every field against its limits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check(&self) -> Result<(), SpecError> {
        let fail =
            |field: &str, what: String| Err(SpecError::new(format!("evaluate.{field}"), what));
        if !self.predictions.is_empty() {
            return self.check_predictions();
        }
        if self.models.is_empty() || self.models.len() > MAX_MODELS {
            let what = format!(
                "names {} models; name 1 to {MAX_MODELS}, or predictions",
                self.models.len()
            );
            return fail("models", what);
        }
        for (i, model) in self.models.iter().enumerate() {
            check_model(&format!("evaluate.models[{i}]"), model)?;
            if self.models[..i].contains(model) {
                return fail(&format!("models[{i}]"), format!("{model:?} is named twice"));
            }
        }
        if !(1..=MAX_SHARDS).contains(&self.shards) {
            let what = format!("is {}, expected 1 to {MAX_SHARDS}", self.shards);
            return fail("shards", what);
        }
        if !self.times.is_empty() {
            check_times("evaluate.times", &self.times)?;
        }
        check_split("evaluate.split", &self.split)?;
        if !SIDES.contains(&&*self.side) {
            return fail("side", show::unknown(&self.side, &SIDES));
        }
        match self.histogram {
            None if !self.spots.is_empty() => fail(
                "spots",
                "need histogram = \"transient_spots\"; give it, or remove them".into(),
            ),
            None => Ok(()),
            Some(histogram) => check_spots("evaluate.spots", histogram, &self.spots),
        }
    }

    /// Checks the settings for stored predictions, which leave no choice of an input.
    fn check_predictions(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: &str| Err(SpecError::new(format!("evaluate.{field}"), what));
        let made =
            "belongs to models; predictions are made already: remove it, or name models instead";
        if !self.models.is_empty() {
            let what = "is given together with predictions; give one of the two, and the other a stage of its own";
            return fail("models", what);
        }
        for (field, given) in [
            ("histogram", self.histogram.is_some()),
            ("spots", !self.spots.is_empty()),
            ("times", !self.times.is_empty()),
            ("sensor", !self.sensor),
            ("shards", self.shards != 1),
        ] {
            if given {
                return fail(field, made);
            }
        }
        check_predictions(PREDICTIONS, &self.predictions)?;
        check_split("evaluate.split", &self.split)?;
        match SIDES.contains(&&*self.side) {
            true => Ok(()),
            false => fail("side", &show::unknown(&self.side, &SIDES)),
        }
    }
}
