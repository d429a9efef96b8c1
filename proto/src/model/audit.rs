//! Who did what: the lines of the audit log.

use serde::Serialize;

use crate::ids::JobId;

/// Most bytes of a name in the log.
pub const WHO_BYTES: usize = 200;
/// Most bytes of a detail in the log.
pub const DETAIL_BYTES: usize = 1_000;

/// Something that is done to a farm, or attempted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Act {
    /// A job is submitted.
    Submit,
    /// A job is stopped.
    Cancel,
    /// A job is held.
    Pause,
    /// A held job goes on.
    Resume,
    /// A job's given-up tasks are pending again.
    Retry,
    /// A worker is asked to end.
    Drain,
    /// The coordinator read the token file again.
    Tokens,
    /// The coordinator read its certificates again.
    Certificates,
}

impl Act {
    /// All of them.
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

    /// Its name.
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

    /// The act of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|act| act.name() == name)
    }
}

/// What became of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// It was done.
    Done,
    /// The caller may not do it, or it cannot be done.
    Refused,
    /// The coordinator could not, for reasons of its own.
    Failed,
}

impl Outcome {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Done, Self::Refused, Self::Failed];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Refused => "refused",
            Self::Failed => "failed",
        }
    }

    /// The outcome of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|outcome| outcome.name() == name)
    }
}

/// A line of the audit log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct AuditEntry {
    /// Position in the log, growing.
    pub sequence: u64,
    /// Unix time, milliseconds.
    pub at_ms: i64,
    /// Name of the caller; `(coordinator)` where nobody called.
    pub who: String,
    /// What was done or attempted.
    pub act: Act,
    /// The job, where it concerns one. It may be forgotten by now.
    pub job: Option<JobId>,
    /// What became of it.
    pub outcome: Outcome,
    /// In words.
    pub detail: String,
}
