//! A training that belongs to a sweep: its values, and its stopping rule. [`super::sweep`] makes
//! them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{domain::Domain, kinds::names::check_model, spec_error::SpecError, stop::Stop};

/// The data that makes a training a trial of a sweep.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trial {
    /// Name of the sweep. Trials record their progress under it, in the folder of models.
    pub sweep: String,
    /// Distinguishes sweeps with the same name: 16 hexadecimal digits that depend on everything
    /// except the trials' number and values.
    pub id: String,
    /// The trial's number, from 0.
    pub index: u64,
    /// The trial's values, by the parameters' names.
    pub values: BTreeMap<String, Value>,
    /// The possible values of each parameter by name, if the sweep gives them.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub over: BTreeMap<String, Domain>,
    /// Seed of the sweep's draws.
    #[serde(default)]
    pub seed: u64,
    /// The stopping rule.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop: Option<Stop>,
}

impl Trial {
    /// Checks a trial in a field.
    pub(super) fn check(&self, field: &str) -> Result<(), SpecError> {
        check_model(&format!("{field}.sweep"), &self.sweep)?;
        let hex = self.id.len() == 16 && self.id.bytes().all(|b| b.is_ascii_hexdigit());
        if !hex {
            let what = format!("{:?} is not 16 hexadecimal digits", self.id);
            return Err(SpecError::new(format!("{field}.id"), what));
        }
        for (parameter, domain) in &self.over {
            if let Some(what) = domain.fault() {
                return Err(SpecError::new(format!("{field}.over.{parameter}"), what));
            }
        }
        match self.stop {
            Some(stop) => stop.check(),
            None => Ok(()),
        }
    }
}
