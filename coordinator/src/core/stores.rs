//! Stores that tasks wait for: away, full, forbidden. A store is tried by one task at a time and ever more rarely, however
//! many tasks wait for it; meanwhile workers do other work.

use std::collections::BTreeMap;

use picofarm_proto::{
    ids::{RangeId, WorkerId},
    model::TaskSpec,
};

use crate::budget::Backoff;

/// Longest wait between tries of a store, milliseconds.
const MOST_MS: u32 = 300_000;
/// Rows of workers that have not failed for so long are forgotten, milliseconds.
const FORGET_MS: i64 = 2 * MOST_MS as i64;
/// Longest reason kept, characters.
const MOST_WORDS: usize = 600;

/// The stores on which tasks failed last, by location.
#[derive(Debug, Default)]
pub(super) struct Stores(BTreeMap<String, Row>);

#[derive(Debug)]
struct Row {
    /// Nobody has used it since it failed.
    shut: bool,
    wait: Wait,
    /// The lease that tries it now.
    trying: Option<RangeId>,
    /// Workers that failed to use it: others may be able to.
    workers: BTreeMap<WorkerId, Wait>,
    why: String,
}

#[derive(Debug, Default, Clone, Copy)]
struct Wait {
    tries: u32,
    until_ms: i64,
}

impl Wait {
    fn failed(&mut self, backoff: &Backoff, now_ms: i64) {
        // Others that were at it when it failed say the same of the same time.
        if now_ms >= self.until_ms {
            self.tries += 1;
            self.until_ms = now_ms + backoff.after(self.tries);
        }
    }
}

/// The store that a task's failure to store is put down to.
pub(super) fn store_of(task: &TaskSpec) -> &str {
    task.results().store.trim_end_matches('/')
}

impl Stores {
    /// A worker could not use a store.
    pub(super) fn failed(
        &mut self,
        store: &str,
        worker: WorkerId,
        why: &str,
        backoff: &Backoff,
        now_ms: i64,
    ) {
        let backoff = &Backoff {
            first_ms: backoff.first_ms,
            most_ms: MOST_MS,
        };
        let row = self.0.entry(store.to_owned()).or_insert_with(|| Row {
            shut: true,
            wait: Wait::default(),
            trying: None,
            workers: BTreeMap::new(),
            why: String::new(),
        });
        row.shut = true;
        row.trying = None;
        row.why = why.chars().take(MOST_WORDS).collect();
        row.wait.failed(backoff, now_ms);
        let old = |wait: &Wait| wait.until_ms + FORGET_MS < now_ms;
        row.workers.retain(|_, wait| !old(wait));
        row.workers
            .entry(worker)
            .or_default()
            .failed(backoff, now_ms);
    }

    /// A worker has used a store.
    pub(super) fn worked(&mut self, store: &str, worker: WorkerId) {
        let Some(row) = self.0.get_mut(store) else {
            return;
        };
        row.shut = false;
        row.wait = Wait::default();
        row.trying = None;
        row.workers.remove(&worker);
        if row.workers.is_empty() {
            self.0.remove(store);
        }
    }

    /// Whether a worker may be given tasks that use a store.
    ///
    /// # Errors
    /// Why not, and when it is tried again.
    pub(super) fn may_use(&self, store: &str, worker: WorkerId, now_ms: i64) -> Result<(), String> {
        let Some(row) = self.0.get(store) else {
            return Ok(());
        };
        let own = row.workers.get(&worker).map_or(0, |wait| wait.until_ms);
        let until_ms = match row.shut {
            true => row.wait.until_ms.max(own),
            false => own,
        };
        let when = if until_ms > now_ms {
            format!("next try in {} s", (until_ms - now_ms + 999) / 1000)
        } else if row.shut && row.trying.is_some() {
            "a task is trying it now".to_owned()
        } else {
            return Ok(());
        };
        Err(format!("waits for store {store}: {}; {when}", row.why))
    }

    /// Whether a lease that uses a store is a try of it: then it has one task.
    pub(super) fn is_try(&self, store: &str) -> bool {
        self.0.get(store).is_some_and(|row| row.shut)
    }

    /// A lease that uses a store begins.
    pub(super) fn begun(&mut self, store: &str, lease: RangeId) {
        if let Some(row) = self.0.get_mut(store).filter(|row| row.shut) {
            row.trying = Some(lease);
        }
    }

    /// A lease is over, however it ended.
    pub(super) fn over(&mut self, lease: RangeId) {
        for row in self.0.values_mut() {
            if row.trying == Some(lease) {
                row.trying = None;
            }
        }
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
        let mut stores = Stores::default();
        let mut now = 0;
        let mut waits = Vec::new();
        for _ in 0..12 {
            // All that were at it say so, which counts once.
            for w in 0..50 {
                stores.failed(S, worker(w), "full", &backoff(), now);
            }
            let why = stores.may_use(S, worker(99), now).unwrap_err();
            assert!(why.contains(S) && why.contains("full") && why.contains("next try in"));
            let begun = now;
            while stores.may_use(S, worker(99), now).is_err() {
                now += 500;
            }
            waits.push(now - begun);
            assert!(stores.is_try(S));
            stores.begun(S, range(1));
            let why = stores.may_use(S, worker(98), now).unwrap_err();
            assert!(why.contains("trying it now"), "{why}");
            stores.over(range(1));
        }
        assert_eq!(waits[..3], [1_000, 2_000, 4_000]);
        assert_eq!(*waits.last().unwrap(), i64::from(MOST_MS));
        assert_eq!(stores.may_use("s3://other", worker(1), now), Ok(()));
    }

    #[test]
    fn a_store_that_works_again_is_open_to_all_but_those_that_failed() {
        let mut stores = Stores::default();
        stores.failed(S, worker(1), "no keys", &backoff(), 0);
        stores.worked(S, worker(2));
        assert!(!stores.is_try(S));
        assert_eq!(stores.may_use(S, worker(3), 0), Ok(()));
        assert!(stores.may_use(S, worker(1), 0).is_err());
        assert_eq!(stores.may_use(S, worker(1), 1_000), Ok(()));
        stores.worked(S, worker(1));
        assert!(stores.0.is_empty());
    }

    #[test]
    fn a_try_that_ends_without_a_word_leaves_the_store_to_the_next() {
        let mut stores = Stores::default();
        stores.failed(S, worker(1), "away", &backoff(), 0);
        stores.begun(S, range(7));
        assert!(stores.may_use(S, worker(2), 5_000).is_err());
        stores.over(range(7));
        assert_eq!(stores.may_use(S, worker(2), 5_000), Ok(()));
    }
}
