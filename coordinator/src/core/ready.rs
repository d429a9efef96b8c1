//! Which tasks can be granted now. Whatever claims, grants or tells of work asks here, so that
//! tasks that cannot run now (their retry is not due, their store is away, every worker that is
//! free is passed over) never pass for work that is there.

use picofarm_catalog::{Free, Run};
use picofarm_proto::ids::{StageRef, WorkerId};

use super::{Core, StageEntry};

/// Tasks of a stage that can be granted now.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Ready {
    /// To any worker.
    pub plain: u64,
    /// To a worker with nothing else in hand: workers were lost while they ran them.
    pub suspects: u64,
    /// There may be more, which only the catalog knows.
    pub unknown: bool,
}

impl Ready {
    /// Whether there is nothing.
    pub(super) fn is_none(self) -> bool {
        self == Self::default()
    }

    /// As many as are known.
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

    /// Of these those that a worker gets, which has other leases in hand or none.
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
    /// Tasks that are nobody's and can be claimed now.
    pub(super) fn claimable(&self, now_ms: i64) -> Ready {
        if self.job.paused || now_ms < self.ask_at_ms {
            return Ready::default();
        }
        let Some(free) = self.free else {
            return Ready {
                unknown: true,
                ..Ready::default()
            };
        };
        Ready {
            plain: free.ready,
            suspects: free.suspects,
            // Some that were to wait are due.
            unknown: free.next_ms.is_some_and(|at| at <= now_ms),
        }
    }

    /// Whether it has or may have tasks that can be granted now, to any worker.
    pub(super) fn waits(&self, now_ms: i64) -> bool {
        !self.job.paused && (self.stage.is_due(now_ms) || !self.claimable(now_ms).is_none())
    }

    /// Whether it has or may have tasks that nobody runs, now or later.
    pub(super) fn has_pending(&self) -> bool {
        let nothing = |free: Free| free.ready + free.suspects + free.later == 0;
        !self.job.paused && (self.stage.pending_tasks() > 0 || !self.free.is_some_and(nothing))
    }
}

impl Core {
    /// Tasks of a stage in hand that can be granted now.
    pub(super) fn ready_here(&self, id: StageRef, now_ms: i64) -> Ready {
        self.ready_but(id, &self.done_for_others(id), now_ms)
    }

    /// The same without these tasks.
    fn ready_but(&self, id: StageRef, except: &[Run], now_ms: i64) -> Ready {
        let entry = &self.stages[&id];
        if entry.job.paused || !entry.stage.is_due(now_ms) {
            return Ready::default();
        }
        let (plain, suspects) = entry.stage.ready(now_ms, except);
        Ready {
            plain,
            suspects,
            unknown: false,
        }
    }

    /// Tasks of all stages that can be granted now, if there are workers for them.
    pub(super) fn ready_now(&self, now_ms: i64) -> u64 {
        let stages = self.stages.keys();
        stages.map(|id| self.ready(*id, now_ms).known()).sum()
    }

    /// Tasks of a stage that can be granted now, if there is a worker for them.
    pub(super) fn ready(&self, id: StageRef, now_ms: i64) -> Ready {
        let claimable = self.stages[&id].claimable(now_ms);
        self.ready_here(id, now_ms).and(claimable)
    }

    /// Tasks of a stage that this worker can be granted now.
    pub(super) fn ready_for(&self, id: StageRef, worker: WorkerId, now_ms: i64) -> Ready {
        let who = &self.workers[&worker];
        if who.quarantined || who.drains || self.may_run(id, worker, now_ms).is_err() {
            return Ready::default();
        }
        let here = self.ready_but(id, &self.not_for(id, worker, now_ms), now_ms);
        let claimable = self.stages[&id].claimable(now_ms);
        here.and(claimable).to_worker(who.leases.is_empty())
    }
}
