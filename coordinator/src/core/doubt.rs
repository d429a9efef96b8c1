//! Handles reports that their store contradicts, and results on which workers disagree. A worker
//! that reported a missing result gets no more tasks until it is restarted.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use picofarm_catalog::{Range, RangeState};
use picofarm_proto::{
    ids::{Incarnation, StageRef, WorkerId},
    model::{EventKind, FailureKind, Finished, JobSpec, kinds::Manifest},
};

use super::{
    history::About,
    message::{Say, SessionId},
    state::Core,
    stores::store_of,
};

/// Most results for which the reporting worker is remembered.
const REPORTERS: usize = 100_000;
/// Most tasks for which differing results are remembered.
const DISPUTED: usize = 10_000;

/// A reported result, with everything needed to check its store.
#[derive(Debug, Clone)]
pub(crate) struct Reported {
    pub session: SessionId,
    pub worker: WorkerId,
    pub stage: StageRef,
    pub job: Arc<JobSpec>,
    pub store: String,
    /// Whether the worker runs on the coordinator's machine, so that both see the same folders.
    pub here: bool,
    pub report: Finished,
}

/// Workers that are not trusted, and doubtful results.
#[derive(Debug, Default)]
pub(super) struct Doubts {
    blocked: BTreeMap<WorkerId, Blocked>,
    /// Sessions of workers on the coordinator's machine.
    here: BTreeSet<SessionId>,
    /// The worker that reported each result committed without a check of its store, by set and
    /// task.
    reporters: BTreeMap<(usize, u64), WorkerId>,
    /// The differing results that workers reported for such a task.
    votes: BTreeMap<(usize, u64), BTreeMap<WorkerId, String>>,
}

#[derive(Debug)]
struct Blocked {
    incarnation: Incarnation,
    store: String,
    why: String,
}

impl Doubts {
    /// Records which worker reported an unchecked result.
    pub(super) fn unverified(&mut self, set: usize, task: u64, worker: WorkerId) {
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
    pub(super) fn disputed(&self, set: usize, task: u64) -> bool {
        self.votes.contains_key(&(set, task))
    }
}

impl Core {
    /// Returns the data with which a report's store is checked.
    pub(crate) fn reported(&self, session: SessionId, report: &Finished) -> Option<Reported> {
        let stage = self.stage_of(report)?;
        let entry = &self.stages[&stage];
        Some(Reported {
            session,
            worker: *self.sessions.get(&session)?,
            stage,
            job: Arc::clone(&entry.job.spec),
            store: store_of(&entry.spec(stage).task).to_owned(),
            here: self.doubts.here.contains(&session),
            report: report.clone(),
        })
    }

    /// Records whether a session's worker runs on the coordinator's machine.
    pub(crate) fn is_here(&mut self, session: SessionId, here: bool) {
        match here {
            true => self.doubts.here.insert(session),
            false => self.doubts.here.remove(&session),
        };
    }

    /// Handles a report that its store contradicts. The task runs again, and the worker gets no
    /// more tasks. If the worker only found an existing result, this is a failure of the task
    /// instead, because that result may be damaged.
    pub(crate) fn contradicted(
        &mut self,
        session: SessionId,
        report: &Finished,
        why: &str,
        now_ms: i64,
    ) {
        let Some(worker) = self.sessions.get(&session).copied() else {
            return;
        };
        self.alarm(session, report, why.to_owned(), now_ms);
        if !self.drop_double(session, report.lease)
            && let Ok(range) = self.held_to_do(session, report.lease, report.index, now_ms)
        {
            let range = range.clone();
            match report.adopted {
                true => {
                    self.leave(&range, report.index, FailureKind::User, why, now_ms);
                }
                false => self.withdraw(&range, report.index, why, now_ms),
            }
            self.perhaps_over(range.stage, now_ms);
        }
        self.acknowledge(session, report.lease, report.index, Err(why.to_owned()));
        if report.adopted {
            return;
        }
        let store = self.stage_of(report).map(|stage| {
            let entry = &self.stages[&stage];
            store_of(&entry.spec(stage).task).to_owned()
        });
        self.block(worker, store.unwrap_or_default(), why);
    }

    /// Blocks the worker that reported a result which another one has replaced. `by` reported the
    /// replacement.
    pub(crate) fn overruled(
        &mut self,
        by: SessionId,
        report: &Finished,
        message: String,
        now_ms: i64,
    ) {
        let Some(stage) = self.stage_of(report) else {
            return;
        };
        let entry = &self.stages[&stage];
        let (key, store) = (
            (entry.set, report.index),
            store_of(&entry.spec(stage).task).to_owned(),
        );
        self.doubts.votes.remove(&key);
        let liar = self.doubts.reporters.remove(&key);
        let message = match liar {
            Some(liar) => format!(
                "{message} The first was reported by worker {}.",
                self.name_of(liar)
            ),
            None => message,
        };
        self.alarm(by, report, message.clone(), now_ms);
        if let Some(liar) = liar.filter(|liar| self.sessions.get(&by) != Some(liar)) {
            self.block(liar, store, &message);
        }
    }

    /// Records that a worker reported a result that differs from the record, in a store that cannot
    /// be checked. Returns `true` if two workers agree on it and neither of them reported the
    /// recorded result.
    pub(crate) fn outvoted(&mut self, session: SessionId, report: &Finished) -> bool {
        let (Some(worker), Some(stage)) =
            (self.sessions.get(&session).copied(), self.stage_of(report))
        else {
            return false;
        };
        let entry = &self.stages[&stage];
        // Results without a manifest depend on the content of the store at the time.
        if entry.spec(stage).task.results().manifest == Manifest::None {
            return false;
        }
        let key = (entry.set, report.index);
        if self.doubts.reporters.get(&key) == Some(&worker) {
            return false;
        }
        if self.doubts.votes.len() >= DISPUTED {
            self.doubts.votes.clear();
        }
        let votes = self.doubts.votes.entry(key).or_default();
        let manifest = report.manifest_sha256.to_ascii_lowercase();
        if votes.insert(worker, manifest.clone()).as_ref() == Some(&manifest) {
            return false;
        }
        votes.values().filter(|vote| **vote == manifest).count() >= 2
    }

    /// Unblocks workers that were blocked because of a store, after that store turned out not to be
    /// the one that the workers use.
    pub(crate) fn forgive(&mut self, store: &str) {
        self.doubts
            .blocked
            .retain(|_, blocked| blocked.store != store);
    }

    /// Gives a worker no more tasks and takes back its leases.
    fn block(&mut self, worker: WorkerId, store: String, why: &str) {
        let Some(entry) = self.workers.get(&worker) else {
            return;
        };
        let (session, incarnation) = (entry.session, entry.incarnation);
        tracing::error!(
            worker = entry.name,
            "the worker gets no more tasks until it is restarted: {why}"
        );
        self.doubts.blocked.insert(
            worker,
            Blocked {
                incarnation,
                store,
                why: format!("it gets no tasks until it is restarted, because {why}"),
            },
        );
        let leased = self.stages.values().flat_map(|entry| entry.stage.leased());
        let mine = leased.filter(|(_, lease)| lease.worker == worker);
        let mine: Vec<Range> = mine.map(|(range, _)| range.clone()).collect();
        for range in mine {
            debug_assert!(matches!(range.state, RangeState::Leased(_)));
            let revoke = Say::Revoke {
                lease: range.lease(),
                reason: format!("the coordinator does not believe this worker: {why}"),
            };
            self.say.push((session, revoke));
            self.close(&range, false);
        }
    }

    /// Runs a task again until two workers agree on its result.
    pub(super) fn undecided(
        &mut self,
        range: &Range,
        session: SessionId,
        task: u64,
        message: &str,
        now_ms: i64,
    ) {
        self.leave(range, task, FailureKind::User, message, now_ms);
        // Differing results are no sign that this worker is at fault.
        if let (Some(worker), Some(entry)) = (
            self.sessions.get(&session),
            self.stages.get_mut(&range.stage),
        ) {
            entry.blocklist.succeeded(*worker);
        }
        let about = About::message(message)
            .task(task)
            .worker(self.session_name(session));
        self.event(now_ms, range.stage, EventKind::Alarm, about);
        self.perhaps_over(range.stage, now_ms);
    }
}
