//! A training that is one of several: its values, and when it stops. [`super::sweep`] makes them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{kinds::names::check_model, spec_error::SpecError};

/// When trials stop that fall behind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Halving {
    /// Epochs until the first rung.
    pub first: u32,
    /// Each further rung lies so many times as far; of those that reach one, one in so many goes on.
    #[serde(default = "three")]
    pub factor: u32,
}

fn three() -> u32 {
    3
}

impl Halving {
    /// Whether a trial is asked after so many epochs of `of`: at rungs, but not at its end.
    pub fn is_rung(&self, epoch: u64, of: u64) -> bool {
        let (mut rung, factor) = (u64::from(self.first), u64::from(self.factor));
        while rung < epoch && factor > 1 {
            rung = rung.saturating_mul(factor);
        }
        rung == epoch && epoch < of
    }
}

/// What makes a training a trial of a sweep.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trial {
    /// The sweep's name: under it, in the folder of models, trials tell how far they came.
    pub sweep: String,
    /// Tells sweeps of one name apart: 16 hexadecimal digits that follow from all but the number of trials.
    pub id: String,
    /// The trial's number, from 0.
    pub index: u64,
    /// Its values by the parameters' names.
    pub values: BTreeMap<String, Value>,
    /// When it stops.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub halving: Option<Halving>,
}

impl Trial {
    pub(super) fn check(&self) -> Result<(), SpecError> {
        check_model("train.trial.sweep", &self.sweep)?;
        let hex = self.id.len() == 16 && self.id.bytes().all(|b| b.is_ascii_hexdigit());
        if !hex {
            let what = format!("{:?} is not 16 hexadecimal digits", self.id);
            return Err(SpecError::new("train.trial.id", what));
        }
        match self.halving {
            Some(halving) => halving.check(),
            None => Ok(()),
        }
    }
}

impl Halving {
    pub(super) fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: &str| {
            let field = format!("sweep.halving.{field}");
            Err(SpecError::new(field, what.to_owned()))
        };
        if self.first == 0 {
            return fail("first", "must be at least 1 epoch");
        }
        if self.factor < 2 {
            return fail(
                "factor",
                "must be at least 2: one in so many trials goes on",
            );
        }
        Ok(())
    }
}
