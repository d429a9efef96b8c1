//! Explanations of jobs and tasks.

use serde::Serialize;

use crate::{ids::JobId, messages::Event};

/// A reason why tasks of a job do not run, or a description of their current work.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Reason {
    /// One of a fixed set of words, for programs: `no_workers`, `unable`, `busy`, `after_failure`,
    /// …
    pub code: String,
    /// Number of tasks concerned.
    pub tasks: u64,
    /// Description for users.
    pub words: String,
    /// Unix time at which the reason ends, milliseconds, if known.
    pub until_ms: Option<i64>,
}

/// The state of a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskState {
    /// Waiting.
    Pending,
    /// Leased to a worker.
    Leased,
    /// The output is committed.
    Done,
    /// Given up.
    Dead,
    /// Part of a job that was stopped before the task ran.
    Gone,
}

impl TaskState {
    /// All states.
    pub const ALL: [Self; 5] = [
        Self::Pending,
        Self::Leased,
        Self::Done,
        Self::Dead,
        Self::Gone,
    ];

    /// Returns the name of the state.
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

/// The state of one task and its reason.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TaskExplanation {
    /// Task index.
    pub index: u64,
    /// State of the task.
    pub state: TaskState,
    /// The state in words, with its reason.
    pub words: String,
    /// Failures of the task itself.
    pub failures: u32,
    /// Failures after which the task is given up.
    pub max_failures: u32,
    /// Workers lost while they ran the task.
    pub crashes: u32,
    /// Lost workers after which the task is given up.
    pub max_crashes: u32,
    /// Attempts that a worker returned half-way.
    pub interruptions: u32,
    /// Interruptions after which the task is given up.
    pub max_interruptions: u32,
    /// The last failure; empty if there was none.
    pub last_error: String,
    /// The reason for each repeated run, in words.
    pub reruns: Vec<String>,
    /// The task's result, if any.
    pub output: Option<TaskOutput>,
    /// The task's history, oldest first.
    pub events: Vec<Event>,
}

/// A task's result and its origin.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TaskOutput {
    /// SHA-256 of the manifest, hexadecimal.
    pub manifest_sha256: String,
    /// Bytes published.
    pub bytes: u64,
    /// Seconds that the task took.
    pub seconds: f64,
    /// Whether the result was found in the store instead of computed.
    pub adopted: bool,
    /// The worker, job and time of the commit, as far as the history contains them.
    pub made: Option<Made>,
}

/// The origin of a result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Made {
    /// Name of the worker.
    pub worker: String,
    /// The job under which the task ran.
    pub job: JobId,
    /// Name of that job.
    pub job_name: String,
    /// Unix time, milliseconds.
    pub at_ms: i64,
}

/// A worker connected to a coordinator.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ConnectedWorker {
    /// Id, the same across restarts.
    pub id: String,
    /// Name for display.
    pub name: String,
    /// Program version.
    pub version: String,
    /// Renderer version.
    pub renderer: String,
    /// CPU cores that the worker uses.
    pub cores: u32,
    /// Number of leases.
    pub leases: u32,
    /// Unfinished tasks of its leases.
    pub tasks: u64,
    /// Unix time of its connection, milliseconds.
    pub since_ms: i64,
    /// Whether the worker runs a range that crashed others on probation, and gets nothing else.
    pub quarantined: bool,
    /// The reason why the worker gets no tasks, or its end, in words; may be empty.
    pub note: String,
}
