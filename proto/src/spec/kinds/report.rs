//! Reports: presents the results of trained models as one page and as JSON, stored with the models.
//! One task.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    evaluate::MAX_MODELS,
    fields::Fields,
    io::{Io, IoMut, Makes, ModelNames, names},
    kind::{Declared, Manifest, Results, TaskKind},
    names::check_model,
};
use crate::spec::{
    destination::Destination,
    memory::{BASE, Known},
    places::REPORTS,
    spec_error::{SpecError, within},
};

/// Most scenes of each model in a report.
pub const MAX_PICTURES: u32 = 100;

/// Reports on models: one task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ReportTask {
    /// The content of the report.
    pub report: ReportSettings,
}

/// The content of a report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReportSettings {
    /// The name under which the report is stored: letters, digits, `-`, `_` and `.`.
    pub name: String,
    /// Names of models, or of stages that train them (in a matrix, the name before the bracket
    /// means all of it).
    pub models: Vec<String>,
    /// The store of the models and the report; defaults to the store in which earlier stages train
    /// the models.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub store: String,
    /// Title of the page.
    #[serde(default = "title")]
    pub title: String,
    /// Number of scenes shown for each model.
    #[serde(default = "two")]
    pub pictures: u32,
    /// Version of networks and metrics, part of the task key; filled in at submission if omitted.
    #[serde(default)]
    pub version: String,
}

fn title() -> String {
    "Trained networks".into()
}

fn two() -> u32 {
    2
}

impl Declared for ReportTask {
    const NAME: &'static str = "report";
    const FIELDS: &'static [&'static str] = &["report"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            report: fields.required("report")?,
        })
    }
}

impl TaskKind for ReportTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("report.version", &self.report.version),
            models_store: Some(&self.report.store),
            models: names("report.models", &self.report.models),
            makes: Makes::Report(&self.report.store, &self.report.name),
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        IoMut {
            version: Some(&mut self.report.version),
            stores: vec![("report.store", &mut self.report.store)],
            models_in_store: true,
            models: ModelNames::List("report.models", &mut self.report.models),
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        self.report.check()
    }

    fn shaping(&self) -> Value {
        json!({"stage": "report", "settings": self.report})
    }

    fn results(&self) -> Results<'_> {
        let folder = format!("{REPORTS}/{}", self.report.name);
        Results {
            field: "report.store",
            store: &self.report.store,
            folder: folder.clone(),
            destination: Destination::folder("report.name", &self.report.store, folder),
            manifest: Manifest::Report {
                name: &self.report.name,
            },
        }
    }

    /// The pictures show scenes on which the models run.
    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let asked = known
            .networks
            .iter()
            .map(|n| n.scene.two() + n.ask(&n.scene));
        Some(BASE + asked.reduce(f64::max)?)
    }
}

impl ReportSettings {
    /// Checks every field against its limits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
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
        let unit = "scenes of each model on the page";
        within("report.pictures", self.pictures, (0, MAX_PICTURES), unit)
    }
}
