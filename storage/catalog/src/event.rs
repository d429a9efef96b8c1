//! The history of jobs: lines to be written, and which are asked for.

use picofarm_proto::{
    ids::JobId,
    model::{EventKind, TaskCounts},
};

use crate::{range::Run, rights::Sight};

/// A line of history to be written; its sequence number is given by the catalog.
#[derive(Debug, Clone, PartialEq)]
pub struct NewEvent {
    /// Unix time, milliseconds.
    pub at_ms: i64,
    /// The job.
    pub job: JobId,
    /// Position of the stage concerned, where one is.
    pub stage: Option<u32>,
    /// What.
    pub kind: EventKind,
    /// The tasks concerned, where any are.
    pub tasks: Option<Run>,
    /// Worker's name, where one is concerned.
    pub worker: String,
    /// Seconds the task took, where it ended.
    pub seconds: f64,
    /// In words.
    pub message: String,
}

impl NewEvent {
    /// Something about a job as a whole.
    pub fn of(job: JobId, at_ms: i64, kind: EventKind, message: String) -> Self {
        Self {
            at_ms,
            job,
            stage: None,
            kind,
            tasks: None,
            worker: String::new(),
            seconds: 0.0,
            message,
        }
    }

    /// The end of a job.
    pub fn ended(job: JobId, at_ms: i64, counts: &TaskCounts) -> Self {
        let mut message = format!(
            "{} of {} tasks done, {} dead",
            counts.done, counts.total, counts.dead
        );
        if counts.pending > 0 {
            message += &format!(", {} not begun because they need those", counts.pending);
        }
        Self::of(job, at_ms, EventKind::Ended, message)
    }
}

/// Which part of the history.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventQuery {
    /// The job; `None` = all of them.
    pub job: Option<JobId>,
    /// Only events after this sequence number.
    pub after: u64,
    /// At most this many.
    pub limit: u32,
    /// Only events that concern this task.
    pub task: Option<u64>,
    /// Only events that concern this stage.
    pub stage: Option<u32>,
    /// The last `limit` rather than the first.
    pub newest: bool,
    /// What tasks logged, too.
    pub logs: bool,
    /// Only events of jobs that this reader may see.
    pub sight: Sight,
}
