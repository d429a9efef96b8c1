//! Handles a worker's messages about its leases: failures, returned leases, heartbeats.

use picofarm_proto::{
    ids::LeaseRef,
    messages::{EventKind, Failure, FailureKind, TaskProgress},
};

use super::{
    dispatch::Others,
    failing_workers::Trouble,
    history::EventDetails,
    message::{SessionId, ToWorker},
    state::Core,
};

impl Core {
    /// Charges a failed task to its budgets and removes it from the lease.
    pub(crate) fn failed(&mut self, session: SessionId, failure: &Failure, now_ms: i64) {
        if self.drop_second_run(session, failure.lease) {
            return self
                .outcome
                .acknowledge(session, failure.lease, failure.index, Ok(()));
        }
        let held = self
            .held_to_do(session, failure.lease, failure.index, now_ms)
            .cloned();
        let verdict = held.map(|range| {
            if let Some(worker) = self.workers.id_of(session) {
                self.count_failure(range.stage, worker, failure, now_ms);
            }
            self.leave(
                &range,
                failure.index,
                failure.kind,
                &failure.message,
                now_ms,
            );
            match failure.kind {
                FailureKind::Store => {
                    let why = format!("its tasks wait for their store: {}", failure.message);
                    self.take_back(range.id, &why);
                }
                _ => self.take_back_all(session, range.stage, now_ms),
            }
            self.perhaps_over(range.stage, now_ms);
        });
        self.outcome
            .acknowledge(session, failure.lease, failure.index, verdict);
    }

    /// Handles a report with impossible values on a task. It counts as a failure of the task and is
    /// refused with the reason, so the worker does not send it again.
    pub(crate) fn unusable(
        &mut self,
        session: SessionId,
        lease: LeaseRef,
        index: u64,
        why: &str,
        now_ms: i64,
    ) {
        let reason = format!("the worker's report cannot be used: {why}");
        if self.drop_second_run(session, lease) {
            return self.outcome.acknowledge(session, lease, index, Err(reason));
        }
        let held = self.held_to_do(session, lease, index, now_ms).cloned();
        let refusal = match held {
            Err(refusal) => refusal,
            Ok(range) => {
                let name = self.workers.session_name(session);
                tracing::warn!(worker = name, range = %lease.range, task = index, "{reason}");
                self.leave(&range, index, FailureKind::User, &reason, now_ms);
                self.take_back_all(session, range.stage, now_ms);
                self.perhaps_over(range.stage, now_ms);
                reason
            }
        };
        self.outcome
            .acknowledge(session, lease, index, Err(refusal));
    }

    /// Takes back a lease that its worker returns. The tasks that the worker had begun count as
    /// interrupted.
    pub(crate) fn released(
        &mut self,
        session: SessionId,
        lease: LeaseRef,
        reason: &str,
        now_ms: i64,
    ) {
        if self.drop_second_run(session, lease) {
            return self.outcome.acknowledge(session, lease, 0, Ok(()));
        }
        let held = self.held(session, lease, now_ms).cloned();
        let verdict = held.map(|range| {
            let about = EventDetails::message(reason)
                .tasks(range.lo, range.hi)
                .worker(self.workers.session_name(session));
            self.outcome
                .event(now_ms, range.stage, EventKind::Released, about);
            for task in self.begun_tasks(&range) {
                self.interrupted(&range, task, reason, now_ms);
            }
            if let Some(range) = self.range(range.id).cloned() {
                self.close(&range, false);
            }
            if let Some(worker) = self.workers.id_of(session) {
                self.blame(worker, Trouble::GaveBack, Others::None, now_ms);
            }
            self.perhaps_over(range.stage, now_ms);
        });
        self.outcome.acknowledge(session, lease, 0, verdict);
    }

    /// Extends the leases that a worker names, records its progress, and reports which leases are
    /// still live.
    pub(crate) fn heartbeat(
        &mut self,
        session: SessionId,
        leases: &[LeaseRef],
        progress: &[TaskProgress],
        now_ms: i64,
    ) {
        if let Some(entry) = self.workers.of_session_mut(session) {
            entry.heard_ms = now_ms;
        }
        let mut alive = Vec::with_capacity(leases.len());
        for lease in leases {
            if self.held(session, *lease, now_ms).is_ok() {
                self.renew(lease.range, now_ms);
                alive.push(*lease);
            } else if let Some(worker) = self.workers.id_of(session)
                && self.second_run(worker, *lease).is_some()
            {
                alive.push(*lease);
            }
        }
        for report in progress {
            let held = self.held_to_do(session, report.lease, report.index, now_ms);
            if held.is_err() {
                continue;
            }
            let range = report.lease.range;
            let task = self.leases.progress_mut(range, report.index, now_ms);
            task.first.get_or_insert(report.fraction);
            task.fraction = report.fraction;
            task.at = report.at.clone();
        }
        let ttl_ms = self.settings.lease_ms;
        self.outcome.send(
            session,
            ToWorker::Renewed {
                leases: alive,
                ttl_ms,
            },
        );
    }
}
