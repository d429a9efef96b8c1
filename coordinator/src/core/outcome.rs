//! The outcome of the core's decisions: changes that must become durable, and the messages to send
//! afterwards.

use std::collections::HashMap;

use picofarm_catalog::{Changes, Exception, NewEvent, Output, Range, Worker};
use picofarm_proto::{
    ids::{JobId, LeaseRef, RangeId, StageRef},
    messages::{EventKind, Usage},
};

use super::{
    held_ranges::HeldRanges,
    history::EventDetails,
    message::{SessionId, ToWorker},
    settings::MakeId,
    stage_entry::SetId,
    transition::{Illegal, RangeEvent},
};

/// Changes to commit, and the messages to send after the commit.
pub(super) struct Outcome {
    make_id: MakeId,
    changes: Changes,
    messages: Vec<(SessionId, ToWorker)>,
    /// Outputs in `changes`, by set and task.
    outputs: HashMap<(SetId, u64), [u8; 32]>,
}

impl Outcome {
    pub(super) fn new(make_id: MakeId) -> Self {
        Self {
            make_id,
            changes: Changes::default(),
            messages: Vec::new(),
            outputs: HashMap::new(),
        }
    }

    /// Returns the changes and the messages, and begins with none.
    pub(super) fn take(&mut self) -> (Changes, Vec<(SessionId, ToWorker)>) {
        self.outputs.clear();
        (
            std::mem::take(&mut self.changes),
            std::mem::take(&mut self.messages),
        )
    }

    /// Returns the changes, for methods that add ranges to them.
    pub(super) fn changes(&mut self) -> &mut Changes {
        &mut self.changes
    }

    /// Returns a new range id.
    pub(super) fn new_range_id(&mut self) -> RangeId {
        RangeId::from_uuid((self.make_id)())
    }

    /// Applies an event to a held range. Returns the first resulting leased range, if any.
    ///
    /// # Errors
    /// Returns [`Illegal`] if the event is not possible. Then nothing changes.
    pub(super) fn apply(
        &mut self,
        held: &mut HeldRanges,
        range: &Range,
        event: &RangeEvent,
    ) -> Result<Option<Range>, Illegal> {
        let make_id = &mut self.make_id;
        let mut ids = || RangeId::from_uuid(make_id());
        held.apply(range, event, &mut ids, &mut self.changes)
    }

    /// Adds a message to a session's worker.
    pub(super) fn send(&mut self, session: SessionId, message: ToWorker) {
        self.messages.push((session, message));
    }

    /// Tells a session's worker that it no longer holds a lease.
    pub(super) fn revoke(
        &mut self,
        session: SessionId,
        lease: LeaseRef,
        reason: impl Into<String>,
    ) {
        let reason = reason.into();
        self.send(session, ToWorker::Revoke { lease, reason });
    }

    /// Answers a worker's report on a task.
    pub(super) fn acknowledge(
        &mut self,
        session: SessionId,
        lease: LeaseRef,
        index: u64,
        verdict: Result<(), String>,
    ) {
        let (accepted, reason) = match verdict {
            Ok(()) => (true, String::new()),
            Err(reason) => (false, reason),
        };
        let acknowledge = ToWorker::Acknowledge {
            lease,
            index,
            accepted,
            reason,
        };
        self.send(session, acknowledge);
    }

    /// Adds a result.
    pub(super) fn record_output(&mut self, set: SetId, output: Output) {
        self.outputs.insert((set, output.task), output.manifest);
        self.changes.outputs.push(output);
    }

    /// Returns the manifest of a result that is not durable yet.
    pub(super) fn new_output(&self, set: SetId, task: u64) -> Option<[u8; 32]> {
        self.outputs.get(&(set, task)).copied()
    }

    /// Adds the record of a task's failures.
    pub(super) fn record_exception(&mut self, exception: Exception) {
        let key = (exception.stage, exception.task);
        self.changes.exceptions.insert(key, exception);
    }

    /// Adds what a task of a job consumed.
    pub(super) fn record_usage(&mut self, day: i64, job: JobId, usage: Usage) {
        *self.changes.usage.entry((day, job)).or_default() += usage;
    }

    /// Adds the record of a worker.
    pub(super) fn record_worker(&mut self, worker: Worker) {
        self.changes.workers.insert(worker.id, worker);
    }

    /// Marks a stage as possibly finished.
    pub(super) fn perhaps_over(&mut self, stage: StageRef, now_ms: i64) {
        self.changes.perhaps_over.insert(stage, now_ms);
    }

    /// Returns the number of new lines of history.
    pub(super) fn events(&self) -> usize {
        self.changes.events.len()
    }

    /// Adds a line of history. Adjacent tasks that a worker finished in one batch share a line.
    pub(super) fn event(
        &mut self,
        at_ms: i64,
        stage: StageRef,
        kind: EventKind,
        about: EventDetails,
    ) {
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
