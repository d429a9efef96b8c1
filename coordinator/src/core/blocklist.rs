//! Workers on which one task of a stage after another fails, because of a full disk or a broken
//! driver. Such a worker gets no more tasks of that stage for increasing times, as long as other
//! workers may run it. Its failures are not charged to the tasks.

use std::collections::BTreeMap;

use picofarm_proto::{ids::WorkerId, messages::FailureKind};

use super::budget::Backoff;

/// A worker is excluded after this many different tasks in a row failed on it.
const TASKS: usize = 3;
/// Longest exclusion, milliseconds.
const AVOID_MS: u32 = 600_000;
/// An exclusion is this many times as long as the delay of a task after a failure.
const LONGER: u32 = 4;

/// The workers on which tasks of one stage failed.
#[derive(Debug, Default)]
pub(super) struct Blocklist(BTreeMap<WorkerId, WorkerFailures>);

#[derive(Debug, Default)]
struct WorkerFailures {
    /// The failed tasks, with the kind of failure charged to each.
    tasks: BTreeMap<u64, FailureKind>,
    tries: u32,
    until_ms: i64,
    /// End of the exclusion if no other worker may run the stage, Unix milliseconds.
    alone_until_ms: i64,
    last_ms: i64,
}

impl Blocklist {
    /// Records that a task failed on a worker.
    pub(super) fn failed(
        &mut self,
        worker: WorkerId,
        task: u64,
        kind: FailureKind,
        backoff: &Backoff,
        now_ms: i64,
    ) {
        let row = self.0.entry(worker).or_default();
        if row.last_ms.max(row.until_ms) + i64::from(AVOID_MS) < now_ms {
            *row = WorkerFailures::default();
        }
        // Further tasks are not needed for the decision.
        if row.tasks.len() < TASKS {
            row.tasks.entry(task).or_insert(kind);
        }
        row.last_ms = now_ms;
        // Failures of tasks that ran on the worker at the same time count once.
        if row.tasks.len() >= TASKS && now_ms >= row.until_ms.min(row.alone_until_ms) {
            let longer = Backoff {
                first_ms: backoff.first_ms.saturating_mul(LONGER),
                most_ms: AVOID_MS,
            };
            row.tries = row.tries.saturating_add(1);
            row.until_ms = now_ms + longer.after(row.tries);
            // The only worker of a stage rests briefly: its tasks may be as much at fault, and a
            // wrong job must fail soon on a laptop.
            let alone = i64::from(backoff.first_ms);
            row.alone_until_ms = row.until_ms.min(now_ms + alone);
        }
    }

    /// Records that a task succeeded on a worker.
    pub(super) fn succeeded(&mut self, worker: WorkerId) {
        self.0.remove(&worker);
    }

    /// Returns whether tasks failed on a worker one after another without a success since.
    pub(super) fn doubts(&self, worker: WorkerId) -> bool {
        self.0
            .get(&worker)
            .is_some_and(|row| row.tasks.len() >= TASKS)
    }

    /// Returns how much longer a worker is excluded, milliseconds.
    pub(super) fn avoids(&self, worker: WorkerId, now_ms: i64) -> Option<i64> {
        let left = self.0.get(&worker)?.until_ms - now_ms;
        (left > 0).then_some(left)
    }

    /// Like `avoids`, for the only worker of the stage.
    pub(super) fn avoids_alone(&self, worker: WorkerId, now_ms: i64) -> Option<i64> {
        let left = self.0.get(&worker)?.alone_until_ms - now_ms;
        (left > 0).then_some(left)
    }

    /// Returns, once, the tasks that failed on a worker before its exclusion, with the kind of
    /// failure charged to each.
    pub(super) fn take_charged(&mut self, worker: WorkerId) -> Vec<(u64, FailureKind)> {
        let Some(row) = self.0.get_mut(&worker) else {
            return Vec::new();
        };
        let charged = |(task, kind): (&u64, &mut FailureKind)| {
            let charged = std::mem::replace(kind, FailureKind::Interrupted);
            (charged != FailureKind::Interrupted).then_some((*task, charged))
        };
        row.tasks.iter_mut().filter_map(charged).collect()
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    const BACKOFF: Backoff = Backoff {
        first_ms: 2_000,
        most_ms: 300_000,
    };

    fn worker() -> WorkerId {
        WorkerId::from_uuid(Uuid::from_u128(1))
    }

    fn fail(blocklist: &mut Blocklist, task: u64, now_ms: i64) {
        blocklist.failed(worker(), task, FailureKind::User, &BACKOFF, now_ms);
    }

    #[test]
    fn three_tasks_in_a_row_and_a_worker_is_passed_over_for_ever_longer() {
        let mut blocklist = Blocklist::default();
        for task in [1, 2, 2, 2] {
            fail(&mut blocklist, task, 0);
        }
        let avoids = |b: &Blocklist, now| b.avoids(worker(), now);
        assert_eq!(
            avoids(&blocklist, 0),
            None,
            "one task that fails is its own"
        );
        let mut now = 10;
        let mut waits = Vec::new();
        for task in 3..13 {
            // All running tasks fail at once, which counts once.
            fail(&mut blocklist, task, now);
            fail(&mut blocklist, task + 100, now);
            waits.push(avoids(&blocklist, now).unwrap());
            assert!(blocklist.avoids_alone(worker(), now).unwrap() <= 2_000);
            now += waits[waits.len() - 1];
            assert_eq!(avoids(&blocklist, now), None);
        }
        assert_eq!(waits[..3], [8_000, 16_000, 32_000]);
        assert_eq!(waits[9], i64::from(AVOID_MS));
        fail(&mut blocklist, 4, now + 2 * i64::from(AVOID_MS));
        assert_eq!(avoids(&blocklist, now + 2 * i64::from(AVOID_MS)), None);
    }

    #[test]
    fn a_task_that_goes_well_clears_the_worker() {
        let mut blocklist = Blocklist::default();
        for task in 0..3 {
            fail(&mut blocklist, task, 0);
        }
        assert!(blocklist.doubts(worker()));
        blocklist.succeeded(worker());
        assert_eq!(blocklist.avoids(worker(), 1), None);
    }

    #[test]
    fn what_was_charged_is_taken_back_once() {
        let mut blocklist = Blocklist::default();
        for task in 0..3 {
            fail(&mut blocklist, task, 0);
        }
        let charged = blocklist.take_charged(worker());
        assert_eq!(charged, [0, 1, 2].map(|task| (task, FailureKind::User)));
        assert_eq!(blocklist.take_charged(worker()), []);
        assert!(blocklist.doubts(worker()));
    }
}
