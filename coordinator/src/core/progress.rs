//! The last reported progress of running tasks.

use picofarm_proto::messages::{LogAllowance, TaskAt};

#[derive(Debug, Clone)]
pub(super) struct Progress {
    pub(super) fraction: f32,
    /// The first reported progress, which is the progress saved by an earlier attempt.
    pub(super) first: Option<f32>,
    /// The current step of the task, in the worker's words.
    pub(super) at: TaskAt,
    pub(super) since_ms: i64,
    /// Remaining allowance of log lines that the worker may send for this task.
    pub(super) log: LogAllowance,
}

impl Progress {
    /// Creates the progress of a task that has just begun.
    pub(super) fn since(since_ms: i64) -> Self {
        Self {
            fraction: 0.0,
            first: None,
            at: TaskAt::default(),
            since_ms,
            log: LogAllowance::default(),
        }
    }
}
