//! The life of a lease after its grant: heartbeat, failure, return, expiry.

use picofarm_catalog::{Range, RangeState};
use picofarm_proto::{
    ids::{Incarnation, LeaseRef, RangeId, WorkerId},
    model::{EventKind, Failure, FailureKind, TaskProgress},
};

use super::{
    dispatch::Others,
    history::About,
    message::{Say, SessionId},
    progress::Progress,
    sick::Trouble,
    state::Core,
    transition::RangeEvent,
};

/// Most lost workers that are remembered.
const CHARGED: usize = 4096;

impl Core {
    /// Charges a failed task to its budgets and removes it from the lease.
    pub(crate) fn failed(&mut self, session: SessionId, failure: &Failure, now_ms: i64) {
        if self.drop_double(session, failure.lease) {
            return self.acknowledge(session, failure.lease, failure.index, Ok(()));
        }
        let held = self
            .held_to_do(session, failure.lease, failure.index, now_ms)
            .cloned();
        let verdict = held.map(|range| {
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
        self.acknowledge(session, failure.lease, failure.index, verdict);
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
        if self.drop_double(session, lease) {
            return self.acknowledge(session, lease, index, Err(reason));
        }
        let held = self.held_to_do(session, lease, index, now_ms).cloned();
        let refusal = match held {
            Err(refusal) => refusal,
            Ok(range) => {
                let name = self.session_name(session);
                tracing::warn!(worker = name, range = %lease.range, task = index, "{reason}");
                self.leave(&range, index, FailureKind::User, &reason, now_ms);
                self.take_back_all(session, range.stage, now_ms);
                self.perhaps_over(range.stage, now_ms);
                reason
            }
        };
        self.acknowledge(session, lease, index, Err(refusal));
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
        if self.drop_double(session, lease) {
            return self.acknowledge(session, lease, 0, Ok(()));
        }
        let held = self.held(session, lease, now_ms).cloned();
        let verdict = held.map(|range| {
            let about = About::message(reason)
                .tasks(range.lo, range.hi)
                .worker(self.session_name(session));
            self.event(now_ms, range.stage, EventKind::Released, about);
            for task in self.begun(&range) {
                self.interrupted(&range, task, reason, now_ms);
            }
            if let Some(range) = self.range(range.id).cloned() {
                self.close(&range, false);
            }
            if let Some(worker) = self.sessions.get(&session).copied() {
                self.blame(worker, Trouble::GaveBack, Others::None, now_ms);
            }
            self.perhaps_over(range.stage, now_ms);
        });
        self.acknowledge(session, lease, 0, verdict);
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
        if let Some(worker) = self.sessions.get(&session)
            && let Some(entry) = self.workers.get_mut(worker)
        {
            entry.heard_ms = now_ms;
        }
        let mut alive = Vec::with_capacity(leases.len());
        for lease in leases {
            if self.held(session, *lease, now_ms).is_ok() {
                self.renew(lease.range, now_ms);
                alive.push(*lease);
            } else if let Some(worker) = self.sessions.get(&session)
                && self.doubled(*worker, *lease).is_some()
            {
                alive.push(*lease);
            }
        }
        for report in progress {
            let held = self.held_to_do(session, report.lease, report.index, now_ms);
            if held.is_err() {
                continue;
            }
            let tasks = self.progress.entry(report.lease.range).or_default();
            let task = tasks
                .entry(report.index)
                .or_insert_with(|| Progress::since(now_ms));
            task.first.get_or_insert(report.fraction);
            task.fraction = report.fraction;
            task.at = report.at.clone();
        }
        let ttl_ms = self.settings.lease_ms;
        self.say.push((
            session,
            Say::Renewed {
                leases: alive,
                ttl_ms,
            },
        ));
    }

    /// Extends a worker's leases that would run out now. Its heartbeat has arrived and waits only
    /// because this coordinator is busy.
    pub(crate) fn spare(&mut self, session: SessionId, now_ms: i64) {
        let Some(entry) = self
            .sessions
            .get(&session)
            .and_then(|w| self.workers.get(w))
        else {
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
            .keys()
            .filter_map(|id| self.range(*id))
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
        let name = self.name_of(lease.worker);
        let tasks = self.in_hand(range);
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

    /// Returns the tasks of a lease that its worker runs, as far as is known. If the worker has
    /// reported nothing, this is the first unfinished task.
    pub(super) fn in_hand(&self, range: &Range) -> Vec<u64> {
        let todo = |task: &u64| range.has_to_do(*task);
        let reported = self.progress.get(&range.id).into_iter();
        let reported = reported.flat_map(|tasks| tasks.keys().copied());
        let mut tasks: Vec<u64> = reported.filter(todo).collect();
        if tasks.is_empty() {
            tasks.extend((range.lo..range.hi).find(todo));
        }
        tasks
    }

    /// Returns the tasks of a lease that its worker has begun, as far as is known. A worker runs
    /// one at a time.
    fn begun(&self, range: &Range) -> Vec<u64> {
        let runs = |id: &RangeId| self.progress.get(id).is_some_and(|tasks| !tasks.is_empty());
        let RangeState::Leased(lease) = &range.state else {
            return Vec::new();
        };
        let holder = self.workers.get(&lease.worker);
        let elsewhere =
            holder.is_some_and(|w| w.leases.iter().any(|id| *id != range.id && runs(id)));
        match elsewhere && !runs(&range.id) {
            true => Vec::new(),
            false => self.in_hand(range),
        }
    }

    /// Handles a worker that was lost without a goodbye. The running task is charged with a crash,
    /// and the rest of the range is halved.
    pub(crate) fn lost(&mut self, range: &Range, why: &str, now_ms: i64) {
        let Some((_, lease)) = self.stages[&range.stage].stage.lease(range.lease()) else {
            return;
        };
        let (worker, incarnation) = (lease.worker, lease.incarnation);
        let name = self.name_of(worker);
        if let Some(entry) = self.workers.get(&worker) {
            let revoke = Say::Revoke {
                lease: range.lease(),
                reason: why.to_owned(),
            };
            self.say.push((entry.session, revoke));
        }
        let about = About::message(why).tasks(range.lo, range.hi).worker(&*name);
        self.event(now_ms, range.stage, EventKind::Expired, about);
        let in_hand = self.in_hand(range);
        if self.charged.len() > CHARGED {
            self.charged.clear();
        }
        let charged = self
            .charged
            .entry(worker)
            .or_insert((incarnation, Vec::new()));
        if charged.0 != incarnation {
            *charged = (incarnation, Vec::new());
        }
        let mut counted = Vec::new();
        for task in in_hand {
            if let Some(range) = self.range(range.id).cloned()
                && self.leave(&range, task, FailureKind::Crash, why, now_ms)
            {
                counted.push((range.stage, task));
            }
        }
        if let Some((_, charged)) = self.charged.get_mut(&worker) {
            charged.extend(counted);
        }
        // If the last task was removed, the lease is already closed.
        if let Some(range) = self.range(range.id).cloned() {
            self.close(&range, true);
        }
        self.perhaps_over(range.stage, now_ms);
    }

    /// Refunds the charges of a worker that reconnected, because only its connection was broken.
    /// Tasks that were given up meanwhile stay given up; `retry` restarts those.
    pub(super) fn refund(&mut self, worker: WorkerId, incarnation: Incarnation) {
        let Some((of, tasks)) = self.charged.remove(&worker) else {
            return;
        };
        for (stage, task) in tasks.into_iter().filter(|_| of == incarnation) {
            let Some(entry) = self.stages.get_mut(&stage) else {
                continue;
            };
            if let Some(exception) = entry.exceptions.get_mut(&task)
                && !exception.dead
                && exception.crashes > 0
            {
                exception.crashes -= 1;
                self.changes
                    .exceptions
                    .insert((stage, task), exception.clone());
            }
        }
    }

    /// Ends a lease. Its unfinished tasks become pending.
    pub(super) fn close(&mut self, range: &Range, halve: bool) {
        self.mark(range, &RangeEvent::Close { halve });
    }

    /// Extends a lease by one period from now.
    pub(super) fn renew(&mut self, id: RangeId, now_ms: i64) {
        let until_ms = now_ms + i64::from(self.settings.lease_ms);
        self.set_until(id, |_| until_ms);
    }

    /// Sets the end of a lease to a function of its current end.
    pub(super) fn set_until(&mut self, id: RangeId, to_ms: impl FnOnce(i64) -> i64) {
        if let Some(stage) = self.leases.get(&id)
            && let Some(entry) = self.stages.get_mut(stage)
        {
            entry.stage.set_until(id, to_ms);
        }
    }

    /// Applies an event to a leased range, and forgets the lease if the event has ended it.
    pub(super) fn mark(&mut self, range: &Range, event: &RangeEvent) {
        let entry = self
            .stages
            .get_mut(&range.stage)
            .expect("a lease has a stage");
        let left = entry
            .stage
            .apply(
                range,
                event,
                &mut Self::range_id(&mut self.make_id),
                &mut self.changes,
            )
            .expect("callers checked that the lease has the task to do");
        if let RangeEvent::Finish { task, .. } | RangeEvent::Leave { task, .. } = event
            && let Some(tasks) = self.progress.get_mut(&range.id)
        {
            tasks.remove(task);
        }
        if left.is_none() {
            self.lease_over(range.id);
        }
    }

    /// Forgets a lease.
    pub(super) fn lease_over(&mut self, id: RangeId) {
        self.leases.remove(&id);
        self.away.over(id);
        self.load.over(id);
        self.progress.remove(&id);
        for worker in self.workers.values_mut() {
            if worker.leases.remove(&id) && worker.leases.is_empty() {
                worker.quarantined = false;
            }
        }
    }

    /// Returns a leased range.
    pub(super) fn range(&self, id: RangeId) -> Option<&Range> {
        let stage = self.leases.get(&id)?;
        self.stages[stage].stage.leased_range(id)
    }

    /// Returns the range of a live lease of this session's worker.
    fn held(&self, session: SessionId, lease: LeaseRef, now_ms: i64) -> Result<&Range, String> {
        let worker = self
            .sessions
            .get(&session)
            .ok_or("the session is no longer this worker's")?;
        let incarnation = self.workers[worker].incarnation;
        let (range, state) = self
            .leases
            .get(&lease.range)
            .and_then(|stage| self.stages[stage].stage.lease(lease))
            .ok_or("the lease is no longer live: it ran out, was cancelled, or is finished")?;
        if state.worker != *worker || state.incarnation != incarnation {
            return Err("the lease is another worker's now".into());
        }
        if state.until_ms <= now_ms {
            return Err("the lease has run out".into());
        }
        Ok(range)
    }

    /// Like [`Core::held`], but requires that the lease still has this task to do.
    pub(super) fn held_to_do(
        &self,
        session: SessionId,
        lease: LeaseRef,
        task: u64,
        now_ms: i64,
    ) -> Result<&Range, String> {
        let range = self.held(session, lease, now_ms)?;
        if range.has_to_do(task) {
            Ok(range)
        } else {
            Err("this lease does not have that task to do".into())
        }
    }

    pub(super) fn session_name(&self, session: SessionId) -> String {
        self.sessions
            .get(&session)
            .map(|worker| self.name_of(*worker))
            .unwrap_or_default()
    }

    pub(super) fn acknowledge(
        &mut self,
        session: SessionId,
        lease: LeaseRef,
        index: u64,
        verdict: Result<(), String>,
    ) {
        let (accepted, reason) = match verdict {
            Ok(()) => (true, String::new()),
            Err(reason) => (false, reason),
        };
        self.say.push((
            session,
            Say::Acknowledge {
                lease,
                index,
                accepted,
                reason,
            },
        ));
    }
}
