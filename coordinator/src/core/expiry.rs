//! Leases that run out, and workers that are lost.

use picofarm_catalog::{Range, RangeState};
use picofarm_proto::{
    ids::{Incarnation, WorkerId},
    messages::{EventKind, FailureKind},
};

use super::{history::EventDetails, message::SessionId, state::Core};

impl Core {
    /// Extends a worker's leases that would run out now. Its heartbeat has arrived and waits only
    /// because this coordinator is busy.
    pub(crate) fn spare(&mut self, session: SessionId, now_ms: i64) {
        let worker = self.workers.id_of(session);
        let Some(entry) = worker.and_then(|worker| self.workers.get(&worker)) else {
            return;
        };
        for range in entry.leases.clone() {
            let over = |range: &Range| matches!(&range.state, RangeState::Leased(l) if l.until_ms <= now_ms);
            if self.range(range).is_some_and(over) {
                self.renew(range, now_ms);
            }
        }
    }

    /// Takes back every lease that has run out. Call it a few times a second.
    pub(crate) fn expire(&mut self, now_ms: i64) {
        let over: Vec<Range> = self
            .leases
            .iter()
            .filter_map(|(id, _)| self.range(id))
            .filter(|range| matches!(&range.state, RangeState::Leased(l) if l.until_ms <= now_ms))
            .cloned()
            .collect();
        for range in over {
            let why = self.silence(&range, now_ms);
            self.lost(&range, &why, now_ms);
        }
    }

    /// Returns the reason why a lease ran out: its worker is gone, or it is connected and silent.
    fn silence(&self, range: &Range, now_ms: i64) -> String {
        let RangeState::Leased(lease) = &range.state else {
            return "the lease ran out".to_owned();
        };
        let name = self.workers.name(lease.worker);
        let tasks = self.running_tasks(range);
        let tasks = match &tasks[..] {
            [] => String::new(),
            [task] => format!(" while it ran task {task}"),
            many => {
                let many: Vec<String> = many.iter().map(u64::to_string).collect();
                format!(" while it ran tasks {}", many.join(", "))
            }
        };
        match self.workers.get(&lease.worker) {
            None => format!(
                "worker {name} was lost (connection closed){tasks}: its process or machine ended, or the network was cut; a \
                 process that takes too much memory ends so"
            ),
            Some(entry) => format!(
                "worker {name} fell silent{tasks}: it is connected, but was not heard of for {} s; it is frozen, suspended \
                 or overloaded",
                (now_ms - entry.heard_ms).max(0) / 1000
            ),
        }
    }

    /// Handles a worker that was lost without a goodbye. The running task is charged with a crash,
    /// and the rest of the range is halved.
    pub(crate) fn lost(&mut self, range: &Range, why: &str, now_ms: i64) {
        let Some((_, lease)) = self.stages[&range.stage].held.lease(range.lease()) else {
            return;
        };
        let (worker, incarnation) = (lease.worker, lease.incarnation);
        let name = self.workers.name(worker);
        if let Some(entry) = self.workers.get(&worker) {
            self.outcome
                .revoke(entry.session, range.lease(), why.to_owned());
        }
        let about = EventDetails::message(why)
            .tasks(range.lo, range.hi)
            .worker(&*name);
        self.outcome
            .event(now_ms, range.stage, EventKind::Expired, about);
        let running_tasks = self.running_tasks(range);
        let mut counted = Vec::new();
        for task in running_tasks {
            if let Some(range) = self.range(range.id).cloned()
                && self.leave(&range, task, FailureKind::Crash, why, now_ms)
            {
                counted.push((range.stage, task));
            }
        }
        self.refunds.remember(worker, incarnation, counted);
        // If the last task was removed, the lease is already closed.
        if let Some(range) = self.range(range.id).cloned() {
            self.close(&range, true);
        }
        self.perhaps_over(range.stage, now_ms);
    }

    /// Refunds the charges of a worker that reconnected, because only its connection was broken.
    /// Tasks that were given up meanwhile stay given up; `retry` restarts those.
    pub(super) fn refund(&mut self, worker: WorkerId, incarnation: Incarnation) {
        for (stage, task) in self.refunds.take(worker, incarnation) {
            let Some(entry) = self.stages.get_mut(&stage) else {
                continue;
            };
            if let Some(exception) = entry.refund(task, FailureKind::Crash) {
                self.outcome.record_exception(exception);
            }
        }
    }
}
