//! Decides which tasks can be granted now. All code that claims, grants or reports work uses this
//! module, so that tasks that cannot run now never count as available. A task cannot run now if its
//! retry is not due, its store is unavailable, or every free worker is excluded.

use picofarm_catalog::{Free, Run};
use picofarm_proto::ids::{StageRef, WorkerId};

use super::{stage_entry::StageEntry, state::Core};

/// Tasks of a stage that can be granted now.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Ready {
    /// Tasks for any worker.
    pub plain: u64,
    /// Tasks for a worker without other leases, because workers were lost while they ran them.
    pub suspects: u64,
    /// Whether the catalog may have more tasks.
    pub unknown: bool,
}

impl Ready {
    /// Returns whether there are no tasks.
    pub(super) fn is_none(self) -> bool {
        self == Self::default()
    }

    /// Returns the number of known tasks.
    pub(super) fn known(self) -> u64 {
        self.plain + self.suspects
    }

    fn and(self, other: Self) -> Self {
        Self {
            plain: self.plain + other.plain,
            suspects: self.suspects + other.suspects,
            unknown: self.unknown || other.unknown,
        }
    }

    /// Returns the tasks available to a worker that has other leases or none.
    fn to_worker(self, empty_handed: bool) -> Self {
        match empty_handed {
            true => self,
            false => Self {
                suspects: 0,
                ..self
            },
        }
    }
}

impl StageEntry {
    /// Returns the unclaimed tasks that can be claimed now.
    pub(super) fn claimable(&self, now_ms: i64) -> Ready {
        if self.is_paused() || now_ms < self.ask_at_ms() {
            return Ready::default();
        }
        let Some(free) = self.free() else {
            return Ready {
                unknown: true,
                ..Ready::default()
            };
        };
        Ready {
            plain: free.ready,
            suspects: free.suspects,
            // Some delayed tasks are due.
            unknown: free.next_ms.is_some_and(|at| at <= now_ms),
        }
    }

    /// Returns whether the stage has, or may have, tasks that can be granted to some worker now.
    pub(super) fn waits(&self, now_ms: i64) -> bool {
        !self.is_paused() && (self.held.is_due(now_ms) || !self.claimable(now_ms).is_none())
    }

    /// Returns whether the stage has, or may have, tasks that nobody runs yet.
    pub(super) fn has_pending(&self) -> bool {
        let nothing = |free: Free| free.ready + free.suspects + free.later == 0;
        !self.is_paused() && (self.held.pending_tasks() > 0 || !self.free().is_some_and(nothing))
    }
}

impl Core {
    /// Returns the claimed tasks of a stage that can be granted now.
    pub(super) fn ready_here(&self, id: StageRef, now_ms: i64) -> Ready {
        self.ready_but(id, &self.tasks_of_other_jobs(id), now_ms)
    }

    /// Like `ready_here`, without the tasks in `except`.
    fn ready_but(&self, id: StageRef, except: &[Run], now_ms: i64) -> Ready {
        let entry = &self.stages[&id];
        if entry.is_paused() || !entry.held.is_due(now_ms) {
            return Ready::default();
        }
        let (plain, suspects) = entry.held.ready(now_ms, except);
        Ready {
            plain,
            suspects,
            unknown: false,
        }
    }

    /// Returns the number of tasks of all stages that can be granted now, if there are workers for
    /// them.
    pub(super) fn ready_now(&self, now_ms: i64) -> u64 {
        let stages = self.stages.keys();
        stages.map(|id| self.ready(*id, now_ms).known()).sum()
    }

    /// Returns the tasks of a stage that can be granted now, if there is a worker for them.
    pub(super) fn ready(&self, id: StageRef, now_ms: i64) -> Ready {
        let claimable = self.stages[&id].claimable(now_ms);
        self.ready_here(id, now_ms).and(claimable)
    }

    /// Returns the tasks of a stage that can be granted to this worker now.
    pub(super) fn ready_for(&self, id: StageRef, worker: WorkerId, now_ms: i64) -> Ready {
        let who = &self.workers[&worker];
        if who.quarantined || who.drains || self.may_run(id, worker, now_ms).is_err() {
            return Ready::default();
        }
        let here = self.ready_but(id, &self.excluded_tasks(id, worker, now_ms), now_ms);
        let claimable = self.stages[&id].claimable(now_ms);
        here.and(claimable).to_worker(who.leases.is_empty())
    }
}
