//! The places that a job reads and writes: stores, folders in them, and their checks.

use serde::{Deserialize, Serialize};

use super::spec_error::SpecError;

/// Folder of a store for trained models.
pub const MODELS: &str = "models";
/// Folder of a store for reports about models.
pub const REPORTS: &str = "reports";

/// The destination of results.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputSettings {
    /// The store: a path or URL that every worker can reach.
    pub store: String,
    /// Folder of the data set in the store.
    pub dataset: String,
    /// Codec profile.
    #[serde(default = "default_profile")]
    pub profile: String,
}

pub(super) fn default_profile() -> String {
    "sqrt-u16".into()
}

impl OutputSettings {
    pub(super) fn check(&self) -> Result<(), SpecError> {
        if self.store.is_empty() {
            return Err(SpecError::new(
                "output.store",
                "is empty; give a path or URL",
            ));
        }
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
        let dataset = &self.dataset;
        if dataset.is_empty() || dataset.starts_with('.') || !dataset.chars().all(plain) {
            return Err(SpecError::new(
                "output.dataset",
                format!(
                    "{dataset:?} must be a plain folder name of letters, digits, '-', '_' and '.'"
                ),
            ));
        }
        let kept = match &**dataset {
            MODELS => Some("trained models"),
            REPORTS => Some("reports about models"),
            _ => None,
        };
        if let Some(kept) = kept {
            let what = format!("{dataset:?} is where a store keeps {kept}; choose another name");
            return Err(SpecError::new("output.dataset", what));
        }
        Ok(())
    }
}

/// An input data set.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SourceSettings {
    /// The store: a path or URL that every worker can reach.
    pub store: String,
    /// Folder of the data set in the store.
    pub dataset: String,
}

impl SourceSettings {
    /// Returns the form used in keys, which is the place.
    pub(super) fn shaping(&self) -> serde_json::Value {
        serde_json::json!([self.store, self.dataset])
    }
}

/// A stage's name, or a place.
#[derive(Deserialize)]
#[serde(untagged)]
enum SourceText {
    Stage(String),
    Place(PlaceText),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlaceText {
    store: String,
    dataset: String,
}

/// Until the whole job has been read, a source without a store names a stage.
impl<'de> Deserialize<'de> for SourceSettings {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = SourceText::deserialize(deserializer).map_err(|_| {
            serde::de::Error::custom(
                "a source is a stage's name or { store = \"…\", dataset = \"…\" }",
            )
        })?;
        Ok(match text {
            SourceText::Stage(name) => Self {
                store: String::new(),
                dataset: name,
            },
            SourceText::Place(PlaceText { store, dataset }) => Self { store, dataset },
        })
    }
}

pub(super) fn check_source(source: &SourceSettings) -> Result<(), SpecError> {
    if source.store.is_empty() {
        return Err(SpecError::new(
            "source.store",
            "is empty; give a path or URL, or name a stage of the job",
        ));
    }
    if source.dataset.is_empty() {
        return Err(SpecError::new(
            "source.dataset",
            "is empty; give the data set's folder",
        ));
    }
    Ok(())
}

/// Checks a place that must mean the same on every machine: absolute, and without `..`.
pub(super) fn place(field: &str, text: &str) -> Result<(), SpecError> {
    let fail = |what: &str| Err(SpecError::new(field, format!("{text:?} {what}")));
    if text.contains('\0') {
        return fail("holds a zero byte");
    }
    // The check includes decoded percent escapes of a URL.
    let plain = text
        .to_ascii_lowercase()
        .replace("%2e", ".")
        .replace("%2f", "/")
        .replace("%5c", "\\");
    if plain.split(['/', '\\']).any(|part| part == "..") {
        return fail("has a part `..`; name the place itself");
    }
    if !text.contains("://") && !text.starts_with('/') {
        return fail(
            "is relative, which means another place to each worker; give an absolute path or a URL",
        );
    }
    Ok(())
}
