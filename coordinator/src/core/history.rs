//! The optional parts of a line of history.

use picofarm_catalog::Run;

/// The optional part of an event.
#[derive(Default)]
pub(super) struct EventDetails {
    pub(super) tasks: Option<Run>,
    pub(super) worker: String,
    pub(super) seconds: f64,
    pub(super) message: String,
}

impl EventDetails {
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
