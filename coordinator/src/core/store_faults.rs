//! Stores that tasks wait for because they are unavailable, full, forbidden or not mounted. If
//! one worker fails at a store, that worker waits for increasing times while others continue. If
//! several workers fail and none succeeds, the store waits: one task at a time tries it, at
//! increasing intervals, however many tasks wait for it. Meanwhile workers do other work.

use std::collections::{BTreeMap, HashMap};

use picofarm_proto::{
    ids::{RangeId, StageRef, WorkerId},
    spec::TaskSpec,
};

use super::{budget::Backoff, candidate::NotEligible};

/// Longest delay between tries of a store, milliseconds.
const MOST_MS: u32 = 300_000;
/// A worker without failures for this long is forgotten, milliseconds.
const FORGET_MS: i64 = 2 * MOST_MS as i64;
/// Longest reason stored, characters.
const MOST_WORDS: usize = 600;
/// The store is blamed, not the workers, once this many workers have failed and none has succeeded.
const SEVERAL: usize = 2;
/// Most tasks remembered that wait for damaged inputs.
const DAMAGED: usize = 4096;

/// The stores at which tasks failed last.
#[derive(Debug, Default)]
pub(super) struct StoreFaults {
    /// State of each store, by location.
    rows: BTreeMap<String, StoreFault>,
    /// How often each task found its inputs damaged.
    damaged: HashMap<(StageRef, u64), u32>,
}

#[derive(Debug, Default)]
struct StoreFault {
    /// Whether several workers failed at the store and none has used it since.
    shut: bool,
    wait: RetryDelay,
    /// The lease that currently tries the store.
    trying: Option<RangeId>,
    /// Workers that failed to use the store. Others may be able to.
    workers: BTreeMap<WorkerId, FaultyWorker>,
    why: String,
}

/// A worker that failed to use a store.
#[derive(Debug, Default)]
struct FaultyWorker {
    wait: RetryDelay,
    /// The worker's lease that currently tries the store.
    trying: Option<RangeId>,
    /// Whether another worker has used the store since, so that the fault is this worker's own.
    alone: bool,
    why: String,
}

#[derive(Debug, Default, Clone, Copy)]
struct RetryDelay {
    tries: u32,
    until_ms: i64,
}

impl RetryDelay {
    fn failed(&mut self, backoff: &Backoff, now_ms: i64) {
        // Failures of tasks that ran at the same time count once.
        if now_ms >= self.until_ms {
            self.tries += 1;
            self.until_ms = now_ms + backoff.after(self.tries);
        }
    }
}

/// Returns the store blamed for a task's failure to store its result.
pub(super) fn store_of(task: &TaskSpec) -> &str {
    task.results().store.trim_end_matches('/')
}

fn patient(backoff: &Backoff) -> Backoff {
    Backoff {
        first_ms: backoff.first_ms,
        most_ms: MOST_MS,
    }
}

impl StoreFaults {
    /// Records that a worker could not use a store.
    pub(super) fn failed(
        &mut self,
        store: &str,
        worker: WorkerId,
        why: &str,
        backoff: &Backoff,
        now_ms: i64,
    ) {
        let backoff = &patient(backoff);
        let row = self.rows.entry(store.to_owned()).or_default();
        let old = |faulty: &FaultyWorker| faulty.wait.until_ms + FORGET_MS < now_ms;
        row.workers.retain(|_, faulty| !old(faulty));
        let faulty = row.workers.entry(worker).or_default();
        faulty.wait.failed(backoff, now_ms);
        faulty.trying = None;
        faulty.why = why.chars().take(MOST_WORDS).collect();
        if faulty.alone {
            return;
        }
        row.why.clone_from(&faulty.why);
        let several = row.workers.values().filter(|f| !f.alone).count() >= SEVERAL;
        if row.shut || several {
            row.shut = true;
            row.trying = None;
            row.wait.failed(backoff, now_ms);
        }
    }

    /// Records that a worker has used a store.
    pub(super) fn worked(&mut self, store: &str, worker: WorkerId) {
        let Some(row) = self.rows.get_mut(store) else {
            return;
        };
        row.shut = false;
        row.wait = RetryDelay::default();
        row.trying = None;
        row.workers.remove(&worker);
        for faulty in row.workers.values_mut() {
            faulty.alone = true;
        }
        if row.workers.is_empty() {
            self.rows.remove(store);
        }
    }

    /// Checks whether a worker may be given tasks that use a store.
    ///
    /// # Errors
    /// Why not, and when it is tried again.
    pub(super) fn may_use(
        &self,
        store: &str,
        worker: WorkerId,
        now_ms: i64,
    ) -> Result<(), NotEligible> {
        let Some(row) = self.rows.get(store) else {
            return Ok(());
        };
        let own = row.workers.get(&worker);
        let own_ms = own.map_or(0, |own| own.wait.until_ms);
        let (until_ms, trying) = match row.shut {
            true => (row.wait.until_ms.max(own_ms), row.trying.is_some()),
            false => (own_ms, own.is_some_and(|own| own.trying.is_some())),
        };
        let when = if until_ms > now_ms {
            format!("next try in {} s", (until_ms - now_ms + 999) / 1000)
        } else if trying {
            "a task is trying it now".to_owned()
        } else {
            return Ok(());
        };
        let why = own.map_or(&row.why, |own| &own.why);
        Err(NotEligible::Store(format!(
            "waits for store {store}: {why}; {when}"
        )))
    }

    /// Returns whether a worker's lease that uses a store is a try. A try has one task.
    pub(super) fn is_try(&self, store: &str, worker: WorkerId) -> bool {
        let row = self.rows.get(store);
        row.is_some_and(|row| row.shut || row.workers.contains_key(&worker))
    }

    /// Records that a worker's lease that uses a store begins.
    pub(super) fn lease_begun(&mut self, store: &str, worker: WorkerId, lease: RangeId) {
        let Some(row) = self.rows.get_mut(store) else {
            return;
        };
        if row.shut {
            row.trying = Some(lease);
        }
        if let Some(faulty) = row.workers.get_mut(&worker) {
            faulty.trying = Some(lease);
        }
    }

    /// Records the end of a lease.
    pub(super) fn lease_over(&mut self, lease: RangeId) {
        for row in self.rows.values_mut() {
            let workers = row.workers.values_mut().map(|faulty| &mut faulty.trying);
            for trying in workers.chain([&mut row.trying]) {
                if *trying == Some(lease) {
                    *trying = None;
                }
            }
        }
    }

    /// Records that a task found its inputs damaged. Waiting does not repair a store, so only the
    /// task waits. Returns the delay, milliseconds.
    pub(super) fn damaged(&mut self, task: (StageRef, u64), backoff: &Backoff) -> i64 {
        if self.damaged.len() >= DAMAGED && !self.damaged.contains_key(&task) {
            self.damaged.clear();
        }
        let times = self.damaged.entry(task).or_default();
        *times += 1;
        patient(backoff).after(*times)
    }

    /// Forgets the damage recorded for a finished task.
    pub(super) fn mended(&mut self, task: (StageRef, u64)) {
        self.damaged.remove(&task);
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    const S: &str = "s3://b/x";

    fn worker(n: u128) -> WorkerId {
        WorkerId::from_uuid(Uuid::from_u128(n))
    }

    fn range(n: u128) -> RangeId {
        RangeId::from_uuid(Uuid::from_u128(n))
    }

    fn backoff() -> Backoff {
        Backoff {
            first_ms: 1_000,
            most_ms: 4_000,
        }
    }

    #[test]
    fn one_task_at_a_time_tries_a_store_and_ever_more_rarely() {
        let mut stores = StoreFaults::default();
        let mut now = 0;
        let mut waits = Vec::new();
        for _ in 0..12 {
            // All running tasks report the failure, which counts once.
            for w in 0..50 {
                stores.failed(S, worker(w), "full", &backoff(), now);
            }
            let why = stores
                .may_use(S, worker(99), now)
                .unwrap_err()
                .words()
                .to_owned();
            assert!(why.contains(S) && why.contains("full") && why.contains("next try in"));
            let begun = now;
            while stores.may_use(S, worker(99), now).is_err() {
                now += 500;
            }
            waits.push(now - begun);
            assert!(stores.is_try(S, worker(99)));
            stores.lease_begun(S, worker(99), range(1));
            let why = stores
                .may_use(S, worker(98), now)
                .unwrap_err()
                .words()
                .to_owned();
            assert!(why.contains("trying it now"), "{why}");
            stores.lease_over(range(1));
        }
        assert_eq!(waits[..3], [1_000, 2_000, 4_000]);
        assert_eq!(*waits.last().unwrap(), i64::from(MOST_MS));
        assert_eq!(stores.may_use("s3://other", worker(1), now), Ok(()));
    }

    #[test]
    fn one_worker_that_cannot_use_a_store_stops_no_other() {
        let mut stores = StoreFaults::default();
        let (mut now, mut waits) = (0, Vec::new());
        for _ in 0..12 {
            stores.failed(S, worker(1), "wrong keys", &backoff(), now);
            assert_eq!(stores.may_use(S, worker(2), now), Ok(()));
            assert!(!stores.is_try(S, worker(2)));
            let why = stores
                .may_use(S, worker(1), now)
                .unwrap_err()
                .words()
                .to_owned();
            assert!(why.contains(S) && why.contains("wrong keys"), "{why}");
            // The result is the same whether or not others use the store.
            if now > 60_000 {
                stores.worked(S, worker(2));
            }
            let begun = now;
            while stores.may_use(S, worker(1), now).is_err() {
                now += 500;
            }
            waits.push(now - begun);
            // The worker tries the store with one task at a time.
            assert!(stores.is_try(S, worker(1)));
            stores.lease_begun(S, worker(1), range(1));
            assert!(stores.may_use(S, worker(1), now).is_err());
            stores.lease_over(range(1));
        }
        assert_eq!(waits[..3], [1_000, 2_000, 4_000]);
        assert_eq!(*waits.last().unwrap(), i64::from(MOST_MS));
        // A second worker with the same wrong keys is noticed once the store works.
        stores.failed(S, worker(3), "wrong keys", &backoff(), now);
        assert_eq!(stores.may_use(S, worker(2), now), Ok(()));
        stores.worked(S, worker(2));
        stores.failed(S, worker(1), "wrong keys", &backoff(), now);
        stores.failed(S, worker(3), "wrong keys", &backoff(), now);
        assert_eq!(stores.may_use(S, worker(2), now), Ok(()));
    }

    #[test]
    fn a_task_that_reads_what_is_damaged_waits_alone() {
        let mut stores = StoreFaults::default();
        let stage = StageRef {
            job: picofarm_proto::ids::JobId::from_uuid(Uuid::nil()),
            stage: 0,
        };
        let waits: Vec<i64> = (0..3)
            .map(|_| stores.damaged((stage, 7), &backoff()))
            .collect();
        assert_eq!(waits, [1_000, 2_000, 4_000]);
        assert_eq!(stores.may_use(S, worker(1), 0), Ok(()));
        stores.mended((stage, 7));
        assert_eq!(stores.damaged((stage, 7), &backoff()), 1_000);
    }

    #[test]
    fn a_store_that_works_again_is_open_to_all_but_those_that_failed() {
        let mut stores = StoreFaults::default();
        stores.failed(S, worker(1), "no keys", &backoff(), 0);
        stores.failed(S, worker(4), "no keys", &backoff(), 0);
        assert!(stores.may_use(S, worker(3), 0).is_err());
        stores.worked(S, worker(2));
        assert!(!stores.is_try(S, worker(2)));
        assert_eq!(stores.may_use(S, worker(3), 0), Ok(()));
        assert!(stores.may_use(S, worker(1), 0).is_err());
        assert_eq!(stores.may_use(S, worker(1), 1_000), Ok(()));
        stores.worked(S, worker(1));
        stores.worked(S, worker(4));
        assert!(stores.rows.is_empty());
    }

    #[test]
    fn a_try_that_ends_without_a_word_leaves_the_store_to_the_next() {
        let mut stores = StoreFaults::default();
        stores.failed(S, worker(1), "away", &backoff(), 0);
        stores.failed(S, worker(2), "away", &backoff(), 0);
        stores.lease_begun(S, worker(1), range(7));
        assert!(stores.may_use(S, worker(2), 5_000).is_err());
        stores.lease_over(range(7));
        assert_eq!(stores.may_use(S, worker(2), 5_000), Ok(()));
    }
}
