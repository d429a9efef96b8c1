//! What a worker finds when it checks its own machine.

use serde::Serialize;

/// Most checks of an examination.
pub const MOST_CHECKS: usize = 16;
/// Most bytes of the text of a check.
pub const DETAIL_BYTES: usize = 1024;
/// Most bytes of the name of a check.
pub const WHAT_BYTES: usize = 32;

/// A request to a worker to check its machine.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Examine {
    /// The number of the examination.
    pub id: u64,
    /// A path or URL to put, read and delete a small object in; empty = none.
    pub store: String,
    /// A file or folder with scenes to read; empty = none.
    pub scenes: String,
}

/// The result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Nothing is wrong.
    Ok,
    /// Tasks run without it.
    Note,
    /// Tasks fail.
    Bad,
}

impl Verdict {
    /// Returns the word for display.
    pub fn word(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Note => "note",
            Self::Bad => "BAD",
        }
    }
}

/// One check of a machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Check {
    /// The subject: store, memory, …
    pub what: String,
    /// The result.
    pub verdict: Verdict,
    /// For people.
    pub detail: String,
}

impl Check {
    /// Creates a check.
    pub fn new(what: &str, verdict: Verdict, detail: impl Into<String>) -> Self {
        Self {
            what: what.to_owned(),
            verdict,
            detail: detail.into(),
        }
    }
}

/// A worker's answer to an examination.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Examined {
    /// The number of the examination.
    pub id: u64,
    /// The worker's clock when it answered, Unix time in milliseconds.
    pub clock_ms: i64,
    /// Its checks.
    pub checks: Vec<Check>,
}

/// A connected worker with the result of its examination.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ExaminedWorker {
    /// Its id.
    pub id: String,
    /// Its name.
    pub name: String,
    /// Whether it answered in time.
    pub answered: bool,
    /// By how much its clock is ahead of the coordinator's, milliseconds.
    pub ahead_ms: i64,
    /// Its checks.
    pub checks: Vec<Check>,
}
