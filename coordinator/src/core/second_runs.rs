//! Tasks that run a second time, because the first run is slow.

use std::collections::BTreeMap;

use picofarm_proto::ids::{LeaseRef, RangeId, StageRef, WorkerId};

/// Interval at which idle workers are considered, milliseconds.
const INTERVAL_MS: i64 = 200;

/// A task that runs a second time. It is not a range: the catalog does not know it, and it
/// disappears with its instance.
#[derive(Debug, Clone, Copy)]
pub(super) struct SecondRun {
    /// The lease of the first run.
    pub first: LeaseRef,
    pub stage: StageRef,
    pub task: u64,
    pub worker: WorkerId,
}

/// Tasks that run a second time, by the lease of the second run.
#[derive(Default)]
pub(super) struct SecondRuns {
    runs: BTreeMap<RangeId, SecondRun>,
    /// Next time at which idle workers are given parts of other leases.
    next_ms: i64,
}

impl SecondRuns {
    /// Returns whether idle workers are to be given parts of other leases now. Then it is not due
    /// again for a moment.
    pub(super) fn is_due(&mut self, now_ms: i64) -> bool {
        let due = now_ms >= self.next_ms;
        if due {
            self.next_ms = now_ms + INTERVAL_MS;
        }
        due
    }

    pub(super) fn insert(&mut self, lease: RangeId, run: SecondRun) {
        self.runs.insert(lease, run);
    }

    pub(super) fn get(&self, lease: RangeId) -> Option<&SecondRun> {
        self.runs.get(&lease)
    }

    pub(super) fn remove(&mut self, lease: RangeId) {
        self.runs.remove(&lease);
    }

    /// Forgets the second runs of a worker.
    pub(super) fn remove_worker(&mut self, worker: WorkerId) {
        self.runs.retain(|_, run| run.worker != worker);
    }

    /// Returns whether a task of a lease runs a second time.
    pub(super) fn contains(&self, first: LeaseRef, task: u64) -> bool {
        let mut runs = self.runs.values();
        runs.any(|run| run.first == first && run.task == task)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (RangeId, &SecondRun)> {
        self.runs.iter().map(|(lease, run)| (*lease, run))
    }
}
