//! The audit log on the wire.

use super::{ConvertError, parse};
use crate::{
    messages::{Act, AuditEntry, Outcome},
    wire,
};

impl From<AuditEntry> for wire::AuditEntry {
    fn from(m: AuditEntry) -> Self {
        wire::AuditEntry {
            sequence: m.sequence,
            at_ms: m.at_ms,
            who: m.who,
            act: m.act.name().to_owned(),
            job_id: m.job.map(|job| job.to_string()).unwrap_or_default(),
            outcome: m.outcome.name().to_owned(),
            detail: m.detail,
        }
    }
}

impl TryFrom<wire::AuditEntry> for AuditEntry {
    type Error = ConvertError;

    fn try_from(w: wire::AuditEntry) -> Result<Self, ConvertError> {
        let unknown = |field, value: &str| ConvertError::Invalid {
            field,
            what: format!("{value:?} is not known to this version"),
        };
        Ok(AuditEntry {
            sequence: w.sequence,
            at_ms: w.at_ms,
            who: w.who,
            act: Act::named(&w.act).ok_or_else(|| unknown("audit.act", &w.act))?,
            job: match w.job_id.as_str() {
                "" => None,
                id => Some(parse(id, "audit.job_id")?),
            },
            outcome: Outcome::named(&w.outcome)
                .ok_or_else(|| unknown("audit.outcome", &w.outcome))?,
            detail: w.detail,
        })
    }
}
