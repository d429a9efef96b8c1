//! Handles reports that their store contradicts, and results on which workers disagree. A worker
//! that reported a missing result gets no more tasks until it is restarted.

use std::sync::Arc;

use picofarm_catalog::{Range, RangeState};
use picofarm_proto::{
    ids::{StageRef, WorkerId},
    messages::{EventKind, FailureKind, Finished},
    spec::{JobSpec, kinds::Manifest},
};

use super::{history::EventDetails, message::SessionId, state::Core, store_faults::store_of};

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

impl Core {
    /// Returns the data with which a report's store is checked.
    pub(crate) fn reported(&self, session: SessionId, report: &Finished) -> Option<Reported> {
        let stage = self.stage_of(report)?;
        let entry = &self.stages[&stage];
        Some(Reported {
            session,
            worker: self.workers.id_of(session)?,
            stage,
            job: Arc::clone(&entry.job().spec),
            store: store_of(&entry.spec().task).to_owned(),
            here: self.doubts.is_local(session),
            report: report.clone(),
        })
    }

    /// Records whether a session's worker runs on the coordinator's machine.
    pub(crate) fn set_local(&mut self, session: SessionId, here: bool) {
        self.doubts.set_local(session, here);
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
        let Some(worker) = self.workers.id_of(session) else {
            return;
        };
        self.alarm(session, report, why.to_owned(), now_ms);
        if !self.drop_second_run(session, report.lease)
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
        self.outcome
            .acknowledge(session, report.lease, report.index, Err(why.to_owned()));
        if report.adopted {
            return;
        }
        let store = self.stage_of(report).map(|stage| {
            let entry = &self.stages[&stage];
            store_of(&entry.spec().task).to_owned()
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
        let store = store_of(&entry.spec().task).to_owned();
        let liar = self.doubts.settle(entry.set(), report.index);
        let message = match liar {
            Some(liar) => format!(
                "{message} The first was reported by worker {}.",
                self.workers.name(liar)
            ),
            None => message,
        };
        self.alarm(by, report, message.clone(), now_ms);
        if let Some(liar) = liar.filter(|liar| self.workers.id_of(by) != Some(*liar)) {
            self.block(liar, store, &message);
        }
    }

    /// Records that a worker reported a result that differs from the record, in a store that cannot
    /// be checked. Returns `true` if two workers agree on it and neither of them reported the
    /// recorded result.
    pub(crate) fn outvoted(&mut self, session: SessionId, report: &Finished) -> bool {
        let (Some(worker), Some(stage)) = (self.workers.id_of(session), self.stage_of(report))
        else {
            return false;
        };
        let entry = &self.stages[&stage];
        // Results without a manifest depend on the content of the store at the time.
        if entry.spec().task.results().manifest == Manifest::None {
            return false;
        }
        let (set, manifest) = (entry.set(), &report.manifest_sha256);
        self.doubts.vote(set, report.index, worker, manifest)
    }

    /// Unblocks workers that were blocked because of a store, after that store turned out not to be
    /// the one that the workers use.
    pub(crate) fn forgive(&mut self, store: &str) {
        self.doubts.forgive(store);
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
        self.doubts.block(worker, incarnation, store, why);
        let leased = self.stages.values().flat_map(|entry| entry.held.leased());
        let mine = leased.filter(|(_, lease)| lease.worker == worker);
        let mine: Vec<Range> = mine.map(|(range, _)| range.clone()).collect();
        for range in mine {
            debug_assert!(matches!(range.state, RangeState::Leased(_)));
            self.outcome.revoke(
                session,
                range.lease(),
                format!("the coordinator does not believe this worker: {why}"),
            );
            self.close(&range, false);
        }
    }

    /// Runs a task again until two workers agree on its result.
    pub(super) fn rerun_undecided(
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
            self.workers.id_of(session),
            self.stages.get_mut(&range.stage),
        ) {
            entry.blocklist.succeeded(worker);
        }
        let about = EventDetails::message(message)
            .task(task)
            .worker(self.workers.session_name(session));
        self.outcome
            .event(now_ms, range.stage, EventKind::Alarm, about);
        self.perhaps_over(range.stage, now_ms);
    }
}
