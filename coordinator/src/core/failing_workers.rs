//! Workers that fail or return every task, because of a full disk, a wrong mount or a machine about
//! to end. Such a worker rests for increasing times, whatever the kind of failure, until a task
//! succeeds on it.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_proto::ids::{StageRef, WorkerId};

use super::budget::Backoff;

/// Consecutive returned leases without penalty, because a worker that ends returns all its leases.
const FREE: u32 = 3;
/// A worker is at fault once this many stages and stores have failed on it without a success in
/// between.
const SUBJECTS: usize = 3;
/// The count restarts after this long without trouble, milliseconds.
const FORGET_MS: i64 = 300_000;

/// The workers without a success since their last failure.
#[derive(Debug, Default)]
pub(super) struct FailingWorkers(BTreeMap<WorkerId, Troubles>);

/// A failure on a worker.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Trouble {
    /// A task of this stage failed, or was lost with the worker.
    Stage(StageRef),
    /// The worker could not use this store.
    Store(String),
    /// The worker returned a task or a lease.
    GaveBack,
}

#[derive(Debug, Default)]
struct Troubles {
    subjects: BTreeSet<Trouble>,
    given_back: u32,
    tries: u32,
    until_ms: i64,
    last_ms: i64,
}

impl FailingWorkers {
    /// Records a failure on a worker. `others`: whether other workers could take its work.
    pub(super) fn failed(
        &mut self,
        worker: WorkerId,
        trouble: Trouble,
        others: bool,
        backoff: &Backoff,
        now_ms: i64,
    ) {
        let row = self.0.entry(worker).or_default();
        if row.last_ms.max(row.until_ms) + FORGET_MS < now_ms {
            *row = Troubles::default();
        }
        row.last_ms = now_ms;
        let blamed = if trouble == Trouble::GaveBack {
            row.given_back = row.given_back.saturating_add(1);
            row.given_back > FREE
        } else {
            if row.subjects.len() < SUBJECTS {
                row.subjects.insert(trouble);
            }
            // If the worker is the only one, its tasks may be as much at fault.
            others && row.subjects.len() >= SUBJECTS
        };
        // Failures of tasks that ran on the worker at the same time count once.
        if blamed && now_ms >= row.until_ms {
            row.tries = row.tries.saturating_add(1);
            row.until_ms = now_ms + backoff.after(row.tries);
        }
    }

    /// Records a success on a worker.
    pub(super) fn succeeded(&mut self, worker: WorkerId) {
        self.0.remove(&worker);
    }

    /// Returns how much longer a worker rests, milliseconds, or `None` if it does not.
    pub(super) fn rests(&self, worker: WorkerId, now_ms: i64) -> Option<i64> {
        let left = self.0.get(&worker)?.until_ms - now_ms;
        (left > 0).then_some(left)
    }

    /// Returns whether the next lease of a worker is a try. A try has one task.
    pub(super) fn is_try(&self, worker: WorkerId) -> bool {
        self.0.get(&worker).is_some_and(|row| row.tries > 0)
    }

    /// Forgets workers without recent trouble.
    pub(super) fn tidy(&mut self, now_ms: i64) {
        self.0
            .retain(|_, row| row.last_ms.max(row.until_ms) + FORGET_MS >= now_ms);
    }
}

#[cfg(test)]
mod tests {
    use picofarm_proto::ids::JobId;
    use uuid::Uuid;

    use super::*;

    const BACKOFF: Backoff = Backoff {
        first_ms: 1_000,
        most_ms: 60_000,
    };

    fn worker(n: u128) -> WorkerId {
        WorkerId::from_uuid(Uuid::from_u128(n))
    }

    fn stage(n: u128) -> Trouble {
        Trouble::Stage(StageRef {
            job: JobId::from_uuid(Uuid::from_u128(n)),
            stage: 0,
        })
    }

    #[test]
    fn a_worker_that_gives_everything_back_gets_ever_less() {
        let (mut failing, mut now, mut leases) = (FailingWorkers::default(), 0, 0);
        // The worker asks again every millisecond.
        while now < 60_000 {
            if failing.rests(worker(1), now).is_none() {
                leases += 1;
                failing.failed(worker(1), Trouble::GaveBack, false, &BACKOFF, now);
            }
            now += 1;
        }
        assert!((5..=10).contains(&leases), "{leases} leases in a minute");
        assert!(failing.is_try(worker(1)) && failing.rests(worker(2), 0).is_none());
        failing.succeeded(worker(1));
        assert_eq!(failing.rests(worker(1), 4), None);
    }

    #[test]
    fn failures_of_one_stage_are_not_the_workers_and_those_of_three_are() {
        let mut failing = FailingWorkers::default();
        for _ in 0..9 {
            failing.failed(worker(1), stage(1), true, &BACKOFF, 0);
        }
        failing.failed(worker(1), stage(2), true, &BACKOFF, 0);
        assert_eq!(failing.rests(worker(1), 0), None);
        let store = Trouble::Store("s3://b/x".into());
        failing.failed(worker(1), store, true, &BACKOFF, 0);
        assert_eq!(failing.rests(worker(1), 0), Some(1_000));
        for n in 1..=9 {
            failing.failed(worker(2), stage(n), false, &BACKOFF, 0);
        }
        assert_eq!(failing.rests(worker(2), 0), None, "it is the only one");
    }

    #[test]
    fn trouble_long_ago_is_forgotten() {
        let mut failing = FailingWorkers::default();
        for hour in 0..9 {
            let now = hour * 3_600_000;
            failing.failed(worker(1), Trouble::GaveBack, true, &BACKOFF, now);
            assert_eq!(failing.rests(worker(1), now), None);
        }
        failing.tidy(9 * 3_600_000);
        assert!(failing.0.is_empty());
    }
}
