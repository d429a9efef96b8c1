//! The history of jobs: new events and queries.

use picofarm_proto::{
    ids::JobId,
    messages::{EventKind, TaskCounts},
};

use crate::{range::Run, rights::Sight};

/// A new history event; the catalog assigns its sequence number.
#[derive(Debug, Clone, PartialEq)]
pub struct NewEvent {
    /// Unix time, milliseconds.
    pub at_ms: i64,
    /// The job.
    pub job: JobId,
    /// Position of the stage concerned, if any.
    pub stage: Option<u32>,
    /// The kind of event.
    pub kind: EventKind,
    /// The tasks concerned, if any.
    pub tasks: Option<Run>,
    /// Name of the worker concerned; empty if there is none.
    pub worker: String,
    /// Duration of the task in seconds, if it ended.
    pub seconds: f64,
    /// A message for people.
    pub message: String,
}

impl NewEvent {
    /// Returns an event that concerns a job as a whole.
    pub fn new(job: JobId, at_ms: i64, kind: EventKind, message: String) -> Self {
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

    /// Returns the event of a job's end.
    pub fn ended(job: JobId, at_ms: i64, counts: &TaskCounts) -> Self {
        let mut message = format!(
            "{} of {} tasks done, {} dead",
            counts.done, counts.total, counts.dead
        );
        if counts.pending > 0 {
            message += &format!(", {} not begun because they need those", counts.pending);
        }
        Self::new(job, at_ms, EventKind::Ended, message)
    }
}

/// A query of the history.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventQuery {
    /// The job; `None` selects all jobs.
    pub job: Option<JobId>,
    /// Only events after this sequence number.
    pub after: u64,
    /// The maximum number of events.
    pub limit: u32,
    /// Only events that concern this task.
    pub task: Option<u64>,
    /// Only events that concern this stage.
    pub stage: Option<u32>,
    /// Returns the last `limit` events instead of the first.
    pub newest: bool,
    /// Includes the log messages of tasks.
    pub logs: bool,
    /// Only events of jobs that this reader may see.
    pub sight: Sight,
}
