//! Inference: stores the predictions of trained models for the scenes of a data set. One task a
//! scene.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes, ModelNames, names},
    kind::{Declared, Dispatch, Results, TaskKind},
    names::check_model,
    reprocess::Histogram,
    train::check_spots,
};
use crate::spec::{
    limits::check_count,
    memory::{BASE, Known, Network},
    places::{OutputSettings, SourceSettings, check_source, default_profile},
    spec_error::SpecError,
};

/// Most models in one inference: one of each kind.
const MAX_MODELS: usize = 3;

/// Predicts each scene of a data set with trained models: one task a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InferTask {
    /// The data set with the scenes. The models are in the same store.
    pub source: SourceSettings,
    /// The number of scenes for which the source has room.
    pub count: u64,
    /// The models.
    pub infer: InferSettings,
    /// The destination of predictions: a separate folder next to data sets. Predictions have no
    /// histograms, and therefore no profile.
    pub output: OutputSettings,
}

/// The models of an inference.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InferSettings {
    /// Names of models, or of stages that train them: at most one of each kind (`tof`, `shadow`,
    /// `specular`).
    pub models: Vec<String>,
    /// Histogram of the data set; defaults to each model's training histogram.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub histogram: Option<Histogram>,
    /// Only these spots, summed. Requires `histogram = "transient_spots"`, which in turn requires
    /// it; ascending.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub spots: Vec<u32>,
    /// Version of networks and encoder, part of every task key; filled in at submission if omitted.
    #[serde(default)]
    pub version: String,
}

impl Declared for InferTask {
    const NAME: &'static str = "infer";
    const FIELDS: &'static [&'static str] = &["source", "count", "infer", "output"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.required("source")?,
            count: fields.or_default("count")?,
            infer: fields.required("infer")?,
            output: fields.required("output")?,
        })
    }
}

impl TaskKind for InferTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("infer.version", &self.infer.version),
            source: Some(&self.source),
            models: names("infer.models", &self.infer.models),
            makes: Makes::PerScene(&self.output),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            version: Some(&mut self.infer.version),
            source: Some((&mut self.source, &mut self.count)),
            stores: vec![("output.store", &mut self.output.store)],
            models: ModelNames::List("infer.models", &mut self.infer.models),
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        check_source(&self.source)?;
        check_count("count", self.count)?;
        self.infer.check()?;
        let (from, to) = (&self.source, &self.output);
        if (&from.store, &from.dataset) == (&to.store, &to.dataset) {
            let what = format!(
                "{:?} is the source itself; choose another folder for what is predicted of it",
                to.dataset
            );
            return Err(SpecError::new("output.dataset", what));
        }
        if to.profile != default_profile() {
            let what = format!(
                "{:?} is how histograms are coded, and predictions have none; remove it",
                to.profile
            );
            return Err(SpecError::new("output.profile", what));
        }
        to.check()
    }

    /// No two models, as far as earlier stages train them, may have the same target.
    fn check_among(&self, before: &[&dyn TaskKind]) -> Result<(), SpecError> {
        let mut kinds = BTreeMap::new();
        for model in &self.infer.models {
            let place = Some((&self.source.store, model));
            let trained = before.iter().find(|task| task.trains() == place);
            let Some(kind) = trained.and_then(|task| task.predicts()) else {
                continue;
            };
            if let Some(other) = kinds.insert(kind, model) {
                let what = format!(
                    "{other:?} and {model:?} both predict {kind:?}; name one of each kind, and give the other a stage of \
                     its own"
                );
                return Err(SpecError::new("infer.models", what));
            }
        }
        Ok(())
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "infer",
            "source": self.source.shaping(),
            "settings": self.infer,
        })
    }

    fn results(&self) -> Results<'_> {
        Results::scenes(&self.output)
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let source = known.source.as_ref()?;
        let weights: f64 = known.networks.iter().map(Network::weights).sum();
        let asked = known.networks.iter().map(|n| n.ask(source) - n.weights());
        Some(BASE + source.two() + weights + asked.fold(0.0, f64::max))
    }

    fn dispatch(&self) -> Dispatch {
        Dispatch {
            tasks: self.count,
            ..Dispatch::default()
        }
    }
}

impl InferSettings {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| Err(SpecError::new(format!("infer.{field}"), what));
        if self.models.is_empty() || self.models.len() > MAX_MODELS {
            let what = format!(
                "names {} models; name 1 to {MAX_MODELS}, at most one of each kind (tof, shadow, specular)",
                self.models.len()
            );
            return fail("models", what);
        }
        for (i, model) in self.models.iter().enumerate() {
            check_model(&format!("infer.models[{i}]"), model)?;
            if self.models[..i].contains(model) {
                return fail(&format!("models[{i}]"), format!("{model:?} is named twice"));
            }
        }
        match self.histogram {
            None if !self.spots.is_empty() => fail(
                "spots",
                "need histogram = \"transient_spots\"; give it, or remove them".into(),
            ),
            None => Ok(()),
            Some(histogram) => check_spots("infer.spots", histogram, &self.spots),
        }
    }
}
