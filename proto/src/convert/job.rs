//! Jobs on the wire: as JSON.

use super::{ConvertError, required};
use crate::{
    spec::{JobSpec, StageSpec},
    wire,
};

fn read<T: serde::de::DeserializeOwned>(
    json: &str,
    field: &'static str,
) -> Result<T, ConvertError> {
    serde_json::from_str(json).map_err(|e| ConvertError::Invalid {
        field,
        what: e.to_string(),
    })
}

impl TryFrom<wire::JobSpec> for JobSpec {
    type Error = ConvertError;

    fn try_from(w: wire::JobSpec) -> Result<Self, ConvertError> {
        read(&w.json, "spec")
    }
}

impl From<JobSpec> for wire::JobSpec {
    fn from(m: JobSpec) -> Self {
        wire::JobSpec {
            json: serde_json::to_string(&m).expect("a spec is plain data"),
        }
    }
}

pub(super) fn stage(w: Option<wire::StageSpec>) -> Result<StageSpec, ConvertError> {
    read(&required(w, "lease.stage")?.json, "lease.stage")
}

impl From<StageSpec> for wire::StageSpec {
    fn from(m: StageSpec) -> Self {
        wire::StageSpec {
            json: serde_json::to_string(&m).expect("a spec is plain data"),
        }
    }
}
