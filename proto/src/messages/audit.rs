//! The lines of the audit log.

use serde::Serialize;

use crate::ids::JobId;

/// Longest name in the log, bytes.
pub const WHO_BYTES: usize = 200;
/// Longest detail in the log, bytes.
pub const DETAIL_BYTES: usize = 1_000;

/// An action on a farm, done or attempted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Act {
    /// Submits a job.
    Submit,
    /// Cancels a job.
    Cancel,
    /// Pauses a job.
    Pause,
    /// Resumes a paused job.
    Resume,
    /// Makes a job's given-up tasks pending again.
    Retry,
    /// Asks a worker to end.
    Drain,
    /// The coordinator read the token file again.
    Tokens,
    /// The coordinator read its certificates again.
    Certificates,
}

impl Act {
    /// All acts.
    pub const ALL: [Self; 8] = [
        Self::Submit,
        Self::Cancel,
        Self::Pause,
        Self::Resume,
        Self::Retry,
        Self::Drain,
        Self::Tokens,
        Self::Certificates,
    ];

    /// Returns the name of the act.
    pub fn name(self) -> &'static str {
        match self {
            Self::Submit => "submit",
            Self::Cancel => "cancel",
            Self::Pause => "pause",
            Self::Resume => "resume",
            Self::Retry => "retry",
            Self::Drain => "drain",
            Self::Tokens => "tokens",
            Self::Certificates => "certificates",
        }
    }

    /// Returns the act with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|act| act.name() == name)
    }
}

/// The outcome of an act.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The act was done.
    Done,
    /// The caller may not do it, or it cannot be done.
    Refused,
    /// The coordinator failed.
    Failed,
}

impl Outcome {
    /// All outcomes.
    pub const ALL: [Self; 3] = [Self::Done, Self::Refused, Self::Failed];

    /// Returns the name of the outcome.
    pub fn name(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Refused => "refused",
            Self::Failed => "failed",
        }
    }

    /// Returns the outcome with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|outcome| outcome.name() == name)
    }
}

/// A line of the audit log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct AuditEntry {
    /// Position in the log, ascending.
    pub sequence: u64,
    /// Unix time, milliseconds.
    pub at_ms: i64,
    /// Name of the caller; `(coordinator)` if there was none.
    pub who: String,
    /// The act, done or attempted.
    pub act: Act,
    /// The job concerned, if any. It may have been forgotten since.
    pub job: Option<JobId>,
    /// The outcome.
    pub outcome: Outcome,
    /// Description.
    pub detail: String,
}
