//! Workers on which one task of a stage after another fails: a full disk, a broken driver. Such a worker gets no more of
//! that stage for a while, as long as others may run it.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_proto::ids::WorkerId;

/// Different tasks that fail on a worker in a row until it is passed over.
const TASKS: usize = 3;
/// For how long, milliseconds.
const AVOID_MS: i64 = 600_000;

/// The workers on which tasks of one stage failed.
#[derive(Debug, Default)]
pub(super) struct Blocklist(BTreeMap<WorkerId, Row>);

#[derive(Debug)]
struct Row {
    tasks: BTreeSet<u64>,
    last_ms: i64,
}

impl Blocklist {
    /// A task failed on a worker.
    pub(super) fn failed(&mut self, worker: WorkerId, task: u64, now_ms: i64) {
        let row = self.0.entry(worker).or_insert(Row {
            tasks: BTreeSet::new(),
            last_ms: now_ms,
        });
        if row.last_ms + AVOID_MS < now_ms {
            row.tasks.clear();
        }
        // More are not needed to know.
        if row.tasks.len() < TASKS {
            row.tasks.insert(task);
        }
        row.last_ms = now_ms;
    }

    /// A task went well on a worker.
    pub(super) fn succeeded(&mut self, worker: WorkerId) {
        self.0.remove(&worker);
    }

    /// Whether a worker is to be passed over; then for how much longer, milliseconds.
    pub(super) fn avoids(&self, worker: WorkerId, now_ms: i64) -> Option<i64> {
        let row = self.0.get(&worker)?;
        let left = row.last_ms + AVOID_MS - now_ms;
        (row.tasks.len() >= TASKS && left > 0).then_some(left)
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    #[test]
    fn three_tasks_in_a_row_and_a_worker_is_passed_over_for_a_while() {
        let worker = WorkerId::from_uuid(Uuid::from_u128(1));
        let mut blocklist = Blocklist::default();
        for task in [1, 2, 2, 2] {
            blocklist.failed(worker, task, 0);
        }
        assert_eq!(
            blocklist.avoids(worker, 0),
            None,
            "one task that fails is its own"
        );
        blocklist.failed(worker, 3, 10);
        assert_eq!(blocklist.avoids(worker, 10), Some(AVOID_MS));
        assert_eq!(blocklist.avoids(worker, 10 + AVOID_MS), None);
        blocklist.failed(worker, 4, 20 + 2 * AVOID_MS);
        assert_eq!(
            blocklist.avoids(worker, 20 + 2 * AVOID_MS),
            None,
            "long ago"
        );
    }

    #[test]
    fn a_task_that_goes_well_clears_the_worker() {
        let worker = WorkerId::from_uuid(Uuid::from_u128(1));
        let mut blocklist = Blocklist::default();
        for task in 0..3 {
            blocklist.failed(worker, task, 0);
        }
        blocklist.succeeded(worker);
        assert_eq!(blocklist.avoids(worker, 1), None);
    }
}
