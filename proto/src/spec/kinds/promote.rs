//! Promotion: gives the best of several models its own name. One task. A sweep ends with one.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::{
    fields::Fields,
    io::{Io, IoMut, Makes, ModelNames, names},
    kind::{Declared, Manifest, Results, TaskKind},
    names::check_model,
};
use crate::spec::{
    destination::Destination,
    limits::{MAX_STAGES, check_count},
    memory::{BASE, Known, Network},
    places::{MODELS, SourceSettings, check_source},
    spec_error::SpecError,
};

/// Gives the best of several models a name: one task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PromoteTask {
    /// The training data set, with the models in its store.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<SourceSettings>,
    /// Number of scenes of the data set.
    #[serde(skip_serializing_if = "is_zero")]
    pub count: u64,
    /// The models and the name.
    pub promote: PromoteSettings,
}

/// Candidate models, and the name for the best.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PromoteSettings {
    /// The name for the best model.
    pub model: String,
    /// The candidate models, or stages that train them. Trials that stopped early are skipped.
    pub among: Vec<String>,
    /// The store of the models, for a stage without `source`.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub store: String,
    /// Whether missing models are skipped too.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub tolerate_missing: bool,
    /// Version of networks and training, part of every task key; filled in at submission if
    /// omitted.
    #[serde(default)]
    pub version: String,
}

impl Declared for PromoteTask {
    const NAME: &'static str = "promote";
    const FIELDS: &'static [&'static str] = &["source", "count", "promote"];

    fn read(fields: &mut Fields) -> Result<Self, SpecError> {
        Ok(Self {
            source: fields.optional("source")?,
            count: fields.or_default("count")?,
            promote: fields.required("promote")?,
        })
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero(n: &u64) -> bool {
    *n == 0
}

impl PromoteTask {
    /// Returns the store of the models.
    pub fn store(&self) -> &String {
        match &self.source {
            Some(source) => &source.store,
            None => &self.promote.store,
        }
    }
}

impl TaskKind for PromoteTask {
    fn io(&self) -> Io<'_> {
        Io {
            version: ("promote.version", &self.promote.version),
            source: self.source.as_ref(),
            models_store: Some(self.store()),
            models: names("promote.among", &self.promote.among),
            makes: Makes::Model {
                store: self.store(),
                name: &self.promote.model,
                training: None,
            },
            ..Io::default()
        }
    }

    fn io_mut(&mut self) -> IoMut<'_> {
        let source = self.source.as_mut();
        let own_store = source.is_none();
        IoMut {
            version: Some(&mut self.promote.version),
            source: source.map(|source| (source, &mut self.count)),
            stores: match own_store {
                true => vec![("promote.store", &mut self.promote.store)],
                false => Vec::new(),
            },
            models_in_store: own_store,
            models: ModelNames::List("promote.among", &mut self.promote.among),
            ..IoMut::default()
        }
    }

    fn check(&self) -> Result<(), SpecError> {
        let settings = &self.promote;
        match &self.source {
            Some(source) => {
                check_source(source)?;
                check_count("count", self.count)?;
                if !settings.store.is_empty() {
                    let what =
                        "is for stages without source, whose store has the models; remove it";
                    return Err(SpecError::new("promote.store", what));
                }
            }
            None if settings.store.is_empty() => {
                let what = "is missing; give a path or URL, or a source";
                return Err(SpecError::new("promote.store", what));
            }
            None => {}
        }
        check_model("promote.model", &settings.model)?;
        if settings.among.is_empty() || settings.among.len() > MAX_STAGES {
            let what = format!(
                "names {} models; name 1 to {MAX_STAGES}",
                settings.among.len()
            );
            return Err(SpecError::new("promote.among", what));
        }
        for (i, model) in settings.among.iter().enumerate() {
            check_model(&format!("promote.among[{i}]"), model)?;
            if settings.among[..i].contains(model) || *model == settings.model {
                let what = format!("{model:?} is named twice");
                return Err(SpecError::new(format!("promote.among[{i}]"), what));
            }
        }
        Ok(())
    }

    fn shaping(&self) -> Value {
        json!({
            "stage": "promote",
            "source": self.source.as_ref().map(SourceSettings::shaping),
            "settings": self.promote,
        })
    }

    fn results(&self) -> Results<'_> {
        let name = &*self.promote.model;
        Results {
            field: match self.source {
                Some(_) => "source.store",
                None => "promote.store",
            },
            store: self.store(),
            folder: format!("{MODELS}/{name}"),
            destination: Destination::folder(
                "promote.model",
                self.store(),
                format!("{MODELS}/{name}"),
            ),
            manifest: Manifest::Model { name },
        }
    }

    fn memory(&self, known: &Known, _threads: u32) -> Option<f64> {
        let weights = known.networks.iter().map(Network::weights);
        Some(BASE + 2.0 * weights.fold(0.0, f64::max))
    }
}
