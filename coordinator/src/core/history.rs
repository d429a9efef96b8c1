//! The lines of history that the core writes.

use picofarm_catalog::{NewEvent, Run};
use picofarm_proto::{ids::StageRef, model::EventKind};

use super::state::Core;

/// The optional part of an event.
#[derive(Default)]
pub(super) struct About {
    pub(super) tasks: Option<Run>,
    pub(super) worker: String,
    pub(super) seconds: f64,
    pub(super) message: String,
}

impl About {
    pub(super) fn message(message: impl Into<String>) -> Self {
        Self {
            message: message.into(),
            ..Self::default()
        }
    }

    pub(super) fn tasks(mut self, lo: u64, hi: u64) -> Self {
        self.tasks = Some(Run { lo, hi });
        self
    }

    pub(super) fn task(self, task: u64) -> Self {
        self.tasks(task, task + 1)
    }

    pub(super) fn worker(mut self, name: impl Into<String>) -> Self {
        self.worker = name.into();
        self
    }

    pub(super) fn seconds(mut self, seconds: f64) -> Self {
        self.seconds = seconds;
        self
    }
}

impl Core {
    /// Adds a line of history. Adjacent tasks that a worker finished in one batch share a line.
    pub(super) fn event(&mut self, at_ms: i64, stage: StageRef, kind: EventKind, about: About) {
        if let (Some(last), Some(tasks)) = (self.changes.events.last_mut(), about.tasks)
            && matches!(kind, EventKind::Committed | EventKind::Reused)
            && (last.kind, last.job, last.stage) == (kind, stage.job, Some(stage.stage))
            && last.worker == about.worker
            && last.message == about.message
            && let Some(before) = last.tasks.as_mut().filter(|t| t.hi == tasks.lo)
        {
            before.hi = tasks.hi;
            last.seconds += about.seconds;
            return;
        }
        self.changes.events.push(NewEvent {
            at_ms,
            job: stage.job,
            stage: Some(stage.stage),
            kind,
            tasks: about.tasks,
            worker: about.worker,
            seconds: about.seconds,
            message: about.message,
        });
    }
}
