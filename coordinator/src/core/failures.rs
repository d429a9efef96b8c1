//! Failed attempts: whether the task, the worker or the store is at fault, and the cost to each.

use picofarm_catalog::{Range, RangeState};
use picofarm_proto::{
    ids::{RangeId, StageRef, WorkerId},
    messages::{EventKind, FailureKind},
};

use super::{
    budget::{self, Attempt, Verdict},
    dispatch::Others,
    failing_workers::Trouble,
    history::EventDetails,
    message::SessionId,
    state::Core,
    store_faults::store_of,
    transition::RangeEvent,
};

impl Core {
    /// Removes a failed task from its lease. Returns whether the failure counts against the task.
    pub(super) fn leave(
        &mut self,
        range: &Range,
        task: u64,
        kind: FailureKind,
        message: &str,
        now_ms: i64,
    ) -> bool {
        let RangeState::Leased(lease) = &range.state else {
            return false;
        };
        let worker = lease.worker;
        let counts = self.counts(range, task, kind, worker, message, now_ms);
        let attempt = Attempt {
            kind,
            message,
            ms: self.attempt_ms(range.id, task, now_ms),
            counts,
            at_once: false,
        };
        let verdict = self.charge(range, task, attempt, now_ms);
        let event = match verdict.retry_at_ms {
            None => EventKind::Dead,
            // The task was returned, so nothing is wrong with it.
            _ if matches!(
                kind,
                FailureKind::Interrupted | FailureKind::Store | FailureKind::Damaged
            ) =>
            {
                EventKind::Released
            }
            Some(_) => EventKind::Failed,
        };
        let blamed = matches!(kind, FailureKind::User | FailureKind::Crash) && !counts;
        let about = match (&verdict.exception, blamed) {
            (Some(e), _) if e.dead => e.last_error.clone(),
            (_, true) => format!(
                "{message}; not counted, as one task of the stage after another fails on this worker alone"
            ),
            _ => message.to_owned(),
        };
        let about = EventDetails::message(about)
            .task(task)
            .worker(self.workers.name(worker));
        self.outcome.event(now_ms, range.stage, event, about);
        counts
    }

    /// Removes a task from a lease that its worker returns. The first time, the task is pending at
    /// once.
    pub(super) fn interrupted(&mut self, range: &Range, task: u64, reason: &str, now_ms: i64) {
        let attempt = Attempt {
            kind: FailureKind::Interrupted,
            message: reason,
            ms: self.attempt_ms(range.id, task, now_ms),
            counts: !self.came_further(range, task),
            at_once: true,
        };
        let Some(range) = self.range(range.id).cloned() else {
            return;
        };
        let verdict = self.charge(&range, task, attempt, now_ms);
        if verdict.retry_at_ms.is_none() {
            let why = verdict.exception.map(|e| e.last_error).unwrap_or_default();
            let worker = match &range.state {
                RangeState::Leased(lease) => self.workers.name(lease.worker),
                _ => String::new(),
            };
            let about = EventDetails::message(why).task(task).worker(worker);
            self.outcome
                .event(now_ms, range.stage, EventKind::Dead, about);
        }
    }

    /// Removes a task from the lease of an untrusted worker. The task is pending at once,
    /// without a charge.
    pub(super) fn withdraw(&mut self, range: &Range, task: u64, message: &str, now_ms: i64) {
        let attempt = Attempt {
            kind: FailureKind::Interrupted,
            message,
            ms: 0,
            counts: false,
            at_once: true,
        };
        self.charge(range, task, attempt, now_ms);
        let worker = match &range.state {
            RangeState::Leased(lease) => self.workers.name(lease.worker),
            _ => String::new(),
        };
        let about = EventDetails::message(message).task(task).worker(worker);
        self.outcome
            .event(now_ms, range.stage, EventKind::Released, about);
    }

    /// Returns how long a task has run under a lease, as far as is known, milliseconds.
    fn attempt_ms(&self, range: RangeId, task: u64, now_ms: i64) -> u64 {
        let progress = self.leases.progress(range, task);
        progress.map_or(0, |p| (now_ms - p.since_ms).max(0).unsigned_abs())
    }

    /// Returns whether a resumable task made progress under this lease.
    fn came_further(&self, range: &Range, task: u64) -> bool {
        let resumes = self.stages[&range.stage].spec().task.resumes();
        let progress = self.leases.progress(range.id, task);
        resumes && progress.is_some_and(|p| p.first.is_some_and(|first| p.fraction > first))
    }

    /// Charges a failure to the worker or the store at fault. Returns whether it counts against the
    /// task.
    fn counts(
        &mut self,
        range: &Range,
        task: u64,
        kind: FailureKind,
        worker: WorkerId,
        message: &str,
        now_ms: i64,
    ) -> bool {
        let id = range.stage;
        let backoff = self.settings.backoff;
        let others = self.others(id, worker, now_ms);
        let entry = self.stages.get_mut(&id).expect("a lease has a stage");
        match kind {
            FailureKind::Interrupted => {
                self.blame(worker, Trouble::GaveBack, others, now_ms);
                !self.came_further(range, task)
            }
            // The object is at fault. It is replaced or becomes available again.
            FailureKind::Damaged => false,
            FailureKind::Store => {
                let store = store_of(&entry.spec().task).to_owned();
                self.store_faults
                    .failed(&store, worker, message, &backoff, now_ms);
                self.blame(worker, Trouble::Store(store), others, now_ms);
                false
            }
            FailureKind::User | FailureKind::Crash => {
                entry.blocklist.failed(worker, task, kind, &backoff, now_ms);
                let doubts = entry.blocklist.doubts(worker);
                self.blame(worker, Trouble::Stage(id), others, now_ms);
                if doubts && others == Others::Good {
                    self.take_charges_back(id, worker);
                }
                !(doubts && others == Others::Good)
            }
        }
    }

    /// Records a failure on a worker, whatever its kind.
    pub(super) fn blame(
        &mut self,
        worker: WorkerId,
        trouble: Trouble,
        others: Others,
        now_ms: i64,
    ) {
        let backoff = self.settings.backoff;
        let others = others == Others::Good;
        self.failing_workers
            .failed(worker, trouble, others, &backoff, now_ms);
    }

    /// Moves the charges of a stage's tasks on a worker to the worker. Tasks that were given up
    /// meanwhile stay given up; `retry` restarts those.
    fn take_charges_back(&mut self, id: StageRef, worker: WorkerId) {
        let entry = self.stages.get_mut(&id).expect("a lease has a stage");
        for (task, kind) in entry.blocklist.take_charged(worker) {
            if let Some(exception) = entry.refund(task, kind) {
                self.outcome.record_exception(exception);
            }
        }
    }

    /// Charges an attempt to its task and removes the task from the lease.
    fn charge(&mut self, range: &Range, task: u64, attempt: Attempt<'_>, now_ms: i64) -> Verdict {
        let entry = self
            .stages
            .get_mut(&range.stage)
            .expect("a lease has a stage");
        let mut backoff = self.settings.backoff;
        if attempt.kind == FailureKind::Crash && entry.spec().task.resumes() {
            // The task continues from its saved progress, so repeated losses of workers do not mean
            // that it never ends.
            backoff.most_ms = backoff.first_ms;
        }
        let mut verdict = budget::charge(
            entry.exception(task),
            budget::fresh(range.stage, task),
            attempt,
            &entry.job_spec().limits,
            &backoff,
            now_ms,
        );
        if attempt.kind == FailureKind::Damaged {
            let wait = self
                .store_faults
                .damaged((range.stage, task), &self.settings.backoff);
            verdict.retry_at_ms = Some(now_ms + wait);
        }
        let crashes = verdict.exception.as_ref().map_or(0, |e| e.crashes);
        if let Some(exception) = &verdict.exception {
            self.outcome.record_exception(exception.clone());
            entry.note_exception(exception.clone());
        }
        self.mark(
            range,
            &RangeEvent::Leave {
                task,
                retry_at_ms: verdict.retry_at_ms,
                crashes,
            },
        );
        verdict
    }

    /// Takes the rest of a lease from its worker, which is free for other work.
    pub(super) fn take_back(&mut self, id: RangeId, why: &str) {
        let Some(range) = self.range(id).cloned() else {
            return;
        };
        if let RangeState::Leased(lease) = &range.state
            && let Some(entry) = self.workers.get(&lease.worker)
        {
            self.outcome
                .revoke(entry.session, range.lease(), why.to_owned());
        }
        self.close(&range, false);
    }

    /// Takes back the leases that a session's worker would not be given now: those of a stage that
    /// fails on it, or all if every task fails.
    pub(super) fn take_back_all(&mut self, session: SessionId, stage: StageRef, now_ms: i64) {
        let Some(worker) = self.workers.id_of(session) else {
            return;
        };
        let rests = self.failing_workers.rests(worker, now_ms).is_some();
        if !rests && self.passed_over(stage, worker, now_ms).is_none() {
            return;
        }
        let leases: Vec<RangeId> = self.workers[&worker].leases.iter().copied().collect();
        for id in leases {
            if rests || self.leases.stage_of(id) == Some(stage) {
                self.take_back(id, "one task after another fails on this worker");
            }
        }
    }
}
