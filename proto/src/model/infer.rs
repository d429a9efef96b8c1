//! Inference: trained models say what they see in the scenes of a data set, and it is kept. One task a scene.

use serde::{Deserialize, Serialize};

use super::{
    job::{OutputSettings, SpecError, check_count, check_source, default_profile},
    reprocess::{Histogram, SourceSettings},
    train::{check_model, check_spots},
};

/// Most models in one inference: one of each kind.
const MAX_MODELS: usize = 3;

/// What trained models see in each scene of a data set: one task a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InferTask {
    /// The data set whose scenes they see. The models are kept in the same store.
    pub source: SourceSettings,
    /// The number of scenes that the source has room for.
    pub count: u64,
    /// Which models.
    pub infer: InferSettings,
    /// Where predictions go: a folder of their own, beside data sets. They have no histograms, so no profile either.
    pub output: OutputSettings,
}

/// Which models see the scenes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InferSettings {
    /// Names of models, or of stages that train them: at most one of each kind (`tof`, `shadow`, `specular`).
    pub models: Vec<String>,
    /// Which of the data set's histograms; left out: for each model that which it was trained on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub histogram: Option<Histogram>,
    /// Only these spots, summed: with `histogram = "transient_spots"`, which needs it; ascending.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub spots: Vec<u32>,
    /// Version of networks and encoder, part of every task key; filled in at submission where left out.
    #[serde(default)]
    pub version: String,
}

impl InferTask {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check(&self) -> Result<(), SpecError> {
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
}

impl InferSettings {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
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
