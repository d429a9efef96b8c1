//! The stages of active jobs.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_catalog::{Exception, Free, Job, Timing};
use picofarm_proto::{
    ids::StageRef,
    key::StageKey,
    model::{Abilities, StageSpec, memory::Known},
};

use super::{blocklist::Blocklist, placement, stage::Stage};

pub(super) struct StageEntry {
    /// The job of the stage.
    pub(super) job: Job,
    /// Properties of the job's inputs.
    pub(super) known: Known,
    pub(super) set: usize,
    pub(super) stage: Stage,
    /// Exceptional state of tasks that this coordinator has leased at least once.
    pub(super) exceptions: BTreeMap<u64, Exception>,
    /// The longest interrupted attempt among these tasks, milliseconds.
    pub(super) longest_ms: u64,
    /// Unclaimed pending tasks, as last reported by the catalog; `None` if the catalog must be
    /// asked.
    pub(super) free: Option<Free>,
    /// The catalog is not asked for tasks before this time, because it had none a moment ago.
    pub(super) ask_at_ms: i64,
    /// The last reported reason why no connected worker may run the stage.
    pub(super) waiting: Option<String>,
    /// Workers on which tasks of the stage failed.
    pub(super) blocklist: Blocklist,
    /// Deadline of the job, Unix milliseconds.
    pub(super) deadline_ms: Option<i64>,
}

impl StageEntry {
    pub(super) fn spec(&self, id: StageRef) -> &StageSpec {
        &self.job.spec.stages[id.stage as usize]
    }

    /// Records the failures of a task.
    pub(super) fn note(&mut self, exception: Exception) {
        self.longest_ms = self.longest_ms.max(exception.longest_ms);
        self.exceptions.insert(exception.task, exception);
    }

    /// Checks whether a worker has everything that the stage's tasks need.
    ///
    /// # Errors
    /// Returns the reason why the worker does not qualify.
    pub(super) fn suits(&self, id: StageRef, worker: &Abilities) -> Result<(), String> {
        placement::may_run(self.spec(id), &self.known, worker)
    }
}

/// A set of outputs shared by stages of one or several jobs.
pub(super) struct SetEntry {
    pub(super) key: StageKey,
    pub(super) timing: Timing,
    /// Stages of active jobs that write to this set.
    pub(super) stages: BTreeSet<StageRef>,
}
