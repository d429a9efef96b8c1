//! The fields of a stage in a job file, as kinds read them.

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::{show, spec::spec_error::SpecError};

/// The fields common to all stages.
const COMMON: [&str; 6] = [
    "name",
    "kind",
    "needs",
    "tolerate_dead",
    "force",
    "resources",
];

/// The fields of a stage.
#[derive(Debug)]
pub struct Fields {
    kind: String,
    /// Prefix of messages: the stage's name.
    named: String,
    table: Map<String, Value>,
}

impl Fields {
    /// Creates the fields of a stage from its written form.
    ///
    /// # Errors
    /// Returns an error if the value is not a table, or if its kind or name is not a text.
    pub(in crate::spec) fn new(stage: Value) -> Result<Self, SpecError> {
        let Value::Object(table) = stage else {
            return Err(SpecError::new("stage", "is not a table; write [[stage]]"));
        };
        let name = table.get("name").and_then(Value::as_str);
        let mut fields = Self {
            kind: String::new(),
            named: name.map_or_else(String::new, |n| format!("{n:?}: ")),
            table,
        };
        let kind: Option<String> = fields.optional("kind")?;
        fields.kind = kind.unwrap_or_else(|| "render".into());
        Ok(fields)
    }

    /// Returns the name of the stage's kind.
    pub fn kind(&self) -> &str {
        &self.kind
    }

    /// Takes an optional field.
    ///
    /// # Errors
    /// Returns an error for a value of the wrong type.
    pub fn optional<T: DeserializeOwned>(&mut self, field: &str) -> Result<Option<T>, SpecError> {
        let value = match self.table.remove(field) {
            None | Some(Value::Null) => return Ok(None),
            Some(value) => value,
        };
        serde_path_to_error::deserialize(value)
            .map(Some)
            .map_err(|e| {
                let what = show::suggest(&e.inner().to_string());
                let path = match e.path().to_string() {
                    below if below == "." => field.to_owned(),
                    below if below.starts_with('[') => format!("{field}{below}"),
                    below => format!("{field}.{below}"),
                };
                SpecError::new("stage", format!("{}{path}: {what}", self.named))
            })
    }

    /// Takes a field, or the default if it is missing.
    ///
    /// # Errors
    /// Returns an error for a value of the wrong type.
    pub fn or_default<T: DeserializeOwned + Default>(
        &mut self,
        field: &str,
    ) -> Result<T, SpecError> {
        Ok(self.optional(field)?.unwrap_or_default())
    }

    /// Takes a required field.
    ///
    /// # Errors
    /// Returns an error for a missing field or a value of the wrong type.
    pub fn required<T: DeserializeOwned>(&mut self, field: &str) -> Result<T, SpecError> {
        let missing = format!("is missing; kind = {:?} needs it", self.kind);
        self.optional(field)?
            .ok_or_else(|| SpecError::new(field, missing))
    }

    /// Checks that there are no fields except the common ones and `own`; `owners` lists the kinds
    /// that have a field.
    ///
    /// # Errors
    /// Returns an error for a field of another kind, or of none.
    pub(super) fn only(
        &self,
        own: &[&str],
        owners: impl Fn(&str) -> Vec<&'static str>,
    ) -> Result<(), SpecError> {
        let known = |field: &&String| own.contains(&&***field) || COMMON.contains(&&***field);
        let Some(field) = self.table.keys().find(|field| !known(field)) else {
            return Ok(());
        };
        let kind = &self.kind;
        let owners: Vec<String> = owners(field)
            .iter()
            .map(|kind| format!("{kind:?}"))
            .collect();
        let what = match (&**field, owners.is_empty()) {
            ("output", _) => {
                format!("is not for kind = {kind:?}, which makes no data set; remove it")
            }
            ("source" | "count", _) => {
                format!("is not for kind = {kind:?}, which reads no data set; remove it")
            }
            (_, false) => {
                let owners = owners.join(" or ");
                format!("belongs to kind = {owners}; remove it from kind = {kind:?}")
            }
            (_, true) => {
                let known = COMMON.iter().chain(own).map(|name| format!("`{name}`"));
                let known: Vec<String> = known.collect();
                let what = format!(
                    "unknown field `{field}`, expected one of {}",
                    known.join(", ")
                );
                let what = format!("{}{}", self.named, show::suggest(&what));
                return Err(SpecError::new("stage", what));
            }
        };
        Err(SpecError::new(&**field, what))
    }
}
