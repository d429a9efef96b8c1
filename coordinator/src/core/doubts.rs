//! Workers that are not trusted, and doubtful results.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_proto::ids::{Incarnation, WorkerId};

use super::{message::SessionId, stage_entry::SetId};

/// Most results for which the reporting worker is remembered.
const REPORTERS: usize = 100_000;
/// Most tasks for which differing results are remembered.
const DISPUTED: usize = 10_000;

/// Workers that are not trusted, and doubtful results.
#[derive(Debug, Default)]
pub(super) struct Doubts {
    blocked: BTreeMap<WorkerId, Blocked>,
    /// Sessions of workers on the coordinator's machine.
    here: BTreeSet<SessionId>,
    /// The worker that reported each result committed without a check of its store, by set and
    /// task.
    reporters: BTreeMap<(SetId, u64), WorkerId>,
    /// The differing results that workers reported for such a task.
    votes: BTreeMap<(SetId, u64), BTreeMap<WorkerId, String>>,
}

#[derive(Debug)]
struct Blocked {
    incarnation: Incarnation,
    store: String,
    why: String,
}

impl Doubts {
    /// Records which worker reported an unchecked result.
    pub(super) fn unverified(&mut self, set: SetId, task: u64, worker: WorkerId) {
        if self.reporters.len() >= REPORTERS {
            self.reporters.clear();
        }
        self.reporters.insert((set, task), worker);
    }

    /// Returns the reason why a worker gets no tasks.
    pub(super) fn blocked(&self, worker: WorkerId) -> Option<&str> {
        self.blocked.get(&worker).map(|blocked| &*blocked.why)
    }

    /// Unblocks a worker that was restarted, because somebody may have repaired it.
    pub(super) fn restarted(&mut self, worker: WorkerId, incarnation: Incarnation) {
        if self
            .blocked
            .get(&worker)
            .is_some_and(|b| b.incarnation != incarnation)
        {
            self.blocked.remove(&worker);
        }
    }

    /// Returns whether workers have reported different results of a task.
    pub(super) fn disputed(&self, set: SetId, task: u64) -> bool {
        self.votes.contains_key(&(set, task))
    }

    /// Records whether a session's worker runs on the coordinator's machine.
    pub(super) fn set_local(&mut self, session: SessionId, here: bool) {
        match here {
            true => self.here.insert(session),
            false => self.here.remove(&session),
        };
    }

    /// Returns whether a session's worker runs on the coordinator's machine.
    pub(super) fn is_local(&self, session: SessionId) -> bool {
        self.here.contains(&session)
    }

    /// Forgets the differing results of a task, because one was chosen. Returns the worker that
    /// reported the result recorded until now.
    pub(super) fn settle(&mut self, set: SetId, task: u64) -> Option<WorkerId> {
        self.votes.remove(&(set, task));
        self.reporters.remove(&(set, task))
    }

    /// Records that a worker reported a result that differs from the record. Returns `true` if two
    /// workers agree on it and neither of them reported the recorded result.
    pub(super) fn vote(&mut self, set: SetId, task: u64, worker: WorkerId, manifest: &str) -> bool {
        let key = (set, task);
        if self.reporters.get(&key) == Some(&worker) {
            return false;
        }
        if self.votes.len() >= DISPUTED {
            self.votes.clear();
        }
        let votes = self.votes.entry(key).or_default();
        let manifest = manifest.to_ascii_lowercase();
        if votes.insert(worker, manifest.clone()).as_ref() == Some(&manifest) {
            return false;
        }
        votes.values().filter(|vote| **vote == manifest).count() >= 2
    }

    /// Blocks a worker because of its results in a store.
    pub(super) fn block(
        &mut self,
        worker: WorkerId,
        incarnation: Incarnation,
        store: String,
        why: &str,
    ) {
        let why = format!("it gets no tasks until it is restarted, because {why}");
        let blocked = Blocked {
            incarnation,
            store,
            why,
        };
        self.blocked.insert(worker, blocked);
    }

    /// Unblocks the workers that were blocked because of a store.
    pub(super) fn forgive(&mut self, store: &str) {
        self.blocked.retain(|_, blocked| blocked.store != store);
    }
}
