//! Answers to the question why.

use serde::Serialize;

use crate::{ids::JobId, model::Event};

/// Why tasks of a job do not run, or what they do instead.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Reason {
    /// One of a fixed set of words, for programs: `no_workers`, `unable`, `busy`, `after_failure`, …
    pub code: String,
    /// How many tasks it concerns.
    pub tasks: u64,
    /// For people.
    pub words: String,
    /// Unix time at which it is over, milliseconds, where that is known.
    pub until_ms: Option<i64>,
}

/// Where a task stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskState {
    /// Waits.
    Pending,
    /// A worker has it.
    Leased,
    /// Its output is committed.
    Done,
    /// Given up.
    Dead,
    /// Of a job that was stopped before it ran.
    Gone,
}

impl TaskState {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Pending,
        Self::Leased,
        Self::Done,
        Self::Dead,
        Self::Gone,
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pending => "pending",
            Self::Leased => "leased",
            Self::Done => "done",
            Self::Dead => "dead",
            Self::Gone => "gone",
        }
    }
}

/// What became of one task and why.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TaskExplanation {
    /// Task index.
    pub index: u64,
    /// Where it stands.
    pub state: TaskState,
    /// The same for people, with the reason.
    pub words: String,
    /// Failures of its own.
    pub failures: u32,
    /// Failures after which it is given up.
    pub max_failures: u32,
    /// Workers lost while they ran it.
    pub crashes: u32,
    /// Lost workers after which it is given up.
    pub max_crashes: u32,
    /// Attempts that a worker gave back half-way.
    pub interruptions: u32,
    /// Interruptions after which it is given up.
    pub max_interruptions: u32,
    /// The last failure; empty where there was none.
    pub last_error: String,
    /// Why it was run again, once for each time; for people.
    pub reruns: Vec<String>,
    /// Its result, where there is one.
    pub output: Option<TaskOutput>,
    /// Its history, oldest first.
    pub events: Vec<Event>,
}

/// A task's result and where it came from.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TaskOutput {
    /// SHA-256 of the manifest, hexadecimal.
    pub manifest_sha256: String,
    /// Bytes published.
    pub bytes: u64,
    /// Seconds it took.
    pub seconds: f64,
    /// Found in the store and not computed.
    pub adopted: bool,
    /// Who committed it, under which job and when, as far as the history tells.
    pub made: Option<Made>,
}

/// Who committed a result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Made {
    /// Worker's name.
    pub worker: String,
    /// The job under which it ran.
    pub job: JobId,
    /// That job's name.
    pub job_name: String,
    /// Unix time, milliseconds.
    pub at_ms: i64,
}

/// A worker that is connected to a coordinator.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ConnectedWorker {
    /// Its id, across restarts.
    pub id: String,
    /// Name, for people.
    pub name: String,
    /// Program version.
    pub version: String,
    /// Renderer version.
    pub renderer: String,
    /// CPU cores it uses.
    pub cores: u32,
    /// Leases it holds.
    pub leases: u32,
    /// Tasks of its leases that are not done.
    pub tasks: u64,
    /// Unix time of its connection, milliseconds.
    pub since_ms: i64,
    /// It is on probation with a range that crashed others, and gets nothing else.
    pub quarantined: bool,
    /// Why it gets nothing, or when it ends, for people; empty = nothing to say.
    pub note: String,
}
