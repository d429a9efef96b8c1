//! A stage of an active job.

use std::collections::BTreeMap;

use picofarm_catalog::{Exception, Free, Job, StageRecord};
use picofarm_proto::{
    ids::StageRef,
    messages::{Abilities, FailureKind},
    spec::{JobSpec, StageSpec, memory::Known},
};

use super::{blocklist::Blocklist, budget::fresh, held_ranges::HeldRanges, placement};

/// Number of a set of outputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct SetId(pub(super) usize);

/// A stage of an active job.
pub(super) struct StageEntry {
    id: StageRef,
    job: Job,
    /// Properties of the job's inputs.
    known: Known,
    set: SetId,
    /// Exceptional state of tasks that this coordinator has leased at least once.
    exceptions: BTreeMap<u64, Exception>,
    /// The longest interrupted attempt among these tasks, milliseconds.
    longest_ms: u64,
    /// Unclaimed pending tasks, as last reported by the catalog; `None` if the catalog must be
    /// asked.
    free: Option<Free>,
    /// The catalog is not asked for tasks before this time, because it had none a moment ago.
    ask_at_ms: i64,
    /// The last reported reason why no connected worker may run the stage.
    waiting: Option<String>,
    /// Deadline of the job, Unix milliseconds.
    deadline_ms: Option<i64>,
    /// The ranges held by this instance.
    pub(super) held: HeldRanges,
    /// Workers on which tasks of the stage failed.
    pub(super) blocklist: Blocklist,
}

impl StageEntry {
    pub(super) fn new(job: &Job, record: &StageRecord, set: SetId) -> Self {
        Self {
            id: record.id,
            job: job.clone(),
            known: job.spec.known(record.id.stage as usize),
            set,
            exceptions: BTreeMap::new(),
            longest_ms: 0,
            free: None,
            ask_at_ms: 0,
            waiting: None,
            deadline_ms: job.spec.limits.deadline_ms().ok().flatten(),
            held: HeldRanges::default(),
            blocklist: Blocklist::default(),
        }
    }

    /// Returns the job of the stage.
    pub(super) fn job(&self) -> &Job {
        &self.job
    }

    /// Returns the spec of the job.
    pub(super) fn job_spec(&self) -> &JobSpec {
        &self.job.spec
    }

    /// Returns the spec of the stage.
    pub(super) fn spec(&self) -> &StageSpec {
        &self.job.spec.stages[self.id.stage as usize]
    }

    /// Returns the set of outputs that the stage writes to.
    pub(super) fn set(&self) -> SetId {
        self.set
    }

    /// Returns whether a user has paused the job.
    pub(super) fn is_paused(&self) -> bool {
        self.job.paused
    }

    /// Returns whether the job's deadline has passed.
    pub(super) fn is_overdue(&self, now_ms: i64) -> bool {
        self.deadline_ms.is_some_and(|deadline| deadline <= now_ms)
    }

    /// Records that a user paused or resumed the job. Returns whether it is paused anew.
    pub(super) fn set_paused(&mut self, paused: bool) -> bool {
        let before = std::mem::replace(&mut self.job.paused, paused);
        paused && !before
    }

    /// Returns the unclaimed pending tasks as last reported; `None` if the catalog must be asked.
    pub(super) fn free(&self) -> Option<Free> {
        self.free
    }

    /// Returns the time before which the catalog is not asked for tasks, Unix milliseconds.
    pub(super) fn ask_at_ms(&self) -> i64 {
        self.ask_at_ms
    }

    /// Records the unclaimed pending tasks that the catalog reports.
    pub(super) fn set_free(&mut self, free: Free) {
        self.free = Some(free);
    }

    /// Lets the catalog be asked for tasks, because it may have other ones now.
    pub(super) fn ask_again(&mut self) {
        self.free = None;
    }

    /// Does not ask the catalog for tasks before this time.
    pub(super) fn ask_not_before(&mut self, at_ms: i64) {
        self.ask_at_ms = at_ms;
    }

    /// Records the reason why no connected worker may run the stage. Returns whether it is new.
    pub(super) fn waits_because(&mut self, reason: &str) -> bool {
        let new = self.waiting.as_deref() != Some(reason);
        if new {
            self.waiting = Some(reason.to_owned());
        }
        new
    }

    /// Checks whether a worker has everything that the stage's tasks need.
    ///
    /// # Errors
    /// Returns the reason why the worker does not qualify.
    pub(super) fn suits(&self, worker: &Abilities) -> Result<(), String> {
        placement::may_run(self.spec(), &self.known, worker)
    }

    /// Returns the memory that a task takes and the memory that a worker has for it, bytes, if the
    /// latter is too little.
    pub(super) fn lacks_memory(&self, worker: &Abilities) -> Option<(u64, u64)> {
        placement::lacks_memory(self.spec(), &self.known, worker)
    }

    /// Returns the record of a task's failures.
    pub(super) fn exception(&self, task: u64) -> Option<&Exception> {
        self.exceptions.get(&task)
    }

    /// Returns the records of failures, by task.
    pub(super) fn exceptions(&self) -> impl Iterator<Item = &Exception> {
        self.exceptions.values()
    }

    /// Returns the longest interrupted attempt at a task of the stage, milliseconds.
    pub(super) fn longest_ms(&self) -> u64 {
        self.longest_ms
    }

    /// Records the failures of a task.
    pub(super) fn note_exception(&mut self, exception: Exception) {
        self.longest_ms = self.longest_ms.max(exception.longest_ms);
        self.exceptions.insert(exception.task, exception);
    }

    /// Takes back one failure of this kind that was charged to a task, unless the task was given
    /// up. Returns the changed record.
    pub(super) fn refund(&mut self, task: u64, kind: FailureKind) -> Option<Exception> {
        let exception = self.exceptions.get_mut(&task).filter(|e| !e.dead)?;
        let count = match kind {
            FailureKind::Crash => &mut exception.crashes,
            _ => &mut exception.failures,
        };
        *count = count.checked_sub(1)?;
        Some(exception.clone())
    }

    /// Replaces a task's error message, if there is a record of its failures.
    pub(super) fn set_last_error(&mut self, task: u64, message: String) {
        if let Some(exception) = self.exceptions.get_mut(&task) {
            exception.last_error = message;
        }
    }

    /// Records that a task was given up. Returns its record.
    pub(super) fn give_up(&mut self, task: u64, why: &str) -> Exception {
        let new = fresh(self.id, task);
        let exception = self.exceptions.entry(task).or_insert(new);
        exception.failures += 1;
        exception.dead = true;
        why.clone_into(&mut exception.last_error);
        exception.clone()
    }

    /// Forgets all failures, because a user has the tasks tried again.
    pub(super) fn forget_exceptions(&mut self) {
        self.exceptions.clear();
        self.longest_ms = 0;
    }
}
