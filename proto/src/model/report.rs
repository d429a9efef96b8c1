//! Reports: what trained models came to, as one page and as JSON, kept in their store. One task.

use serde::{Deserialize, Serialize};

use super::{
    evaluate::MAX_MODELS,
    job::{SpecError, place},
    train::check_model,
};

/// Most scenes of each model that a report shows.
const MAX_PICTURES: u32 = 100;

/// A report about models: one task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ReportTask {
    /// What it is about.
    pub report: ReportSettings,
}

/// What a report is about.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReportSettings {
    /// Its name, under which it is kept in the store: letters, digits, `-`, `_` and `.`.
    pub name: String,
    /// Names of models, or of stages that train them (of a matrix: the name before the bracket means all of it).
    pub models: Vec<String>,
    /// The store that keeps the models, and the report; where left out, that in which stages before it train them.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub store: String,
    /// Title of the page.
    #[serde(default = "title")]
    pub title: String,
    /// Scenes of each model to show.
    #[serde(default = "two")]
    pub pictures: u32,
    /// Version of networks and metrics, part of the task key; filled in at submission where left out.
    #[serde(default)]
    pub version: String,
}

fn title() -> String {
    "Trained networks".into()
}

fn two() -> u32 {
    2
}

impl ReportTask {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check(&self) -> Result<(), SpecError> {
        self.report.check()
    }

    /// Checks where it lies: an absolute path or URL.
    ///
    /// # Errors
    /// [`SpecError`] naming the field.
    pub fn check_places(&self) -> Result<(), SpecError> {
        place("report.store", &self.report.store)
    }
}

impl ReportSettings {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| Err(SpecError::new(format!("report.{field}"), what));
        check_model("report.name", &self.name)?;
        if self.models.is_empty() || self.models.len() > MAX_MODELS {
            let what = format!("names {} models; name 1 to {MAX_MODELS}", self.models.len());
            return fail("models", what);
        }
        for (i, model) in self.models.iter().enumerate() {
            check_model(&format!("report.models[{i}]"), model)?;
            if self.models[..i].contains(model) {
                return fail(&format!("models[{i}]"), format!("{model:?} is named twice"));
            }
        }
        if self.store.is_empty() {
            let what =
                "is missing: no stage before this one trains any of the models; give a path or URL";
            return fail("store", what.into());
        }
        if self.pictures > MAX_PICTURES {
            let what = format!("{} is more than {MAX_PICTURES}", self.pictures);
            return fail("pictures", what);
        }
        Ok(())
    }
}
