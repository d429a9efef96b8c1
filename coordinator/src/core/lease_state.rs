//! Looks up leases, and changes and ends them.

use picofarm_catalog::{Range, RangeState};
use picofarm_proto::ids::{LeaseRef, RangeId};

use super::{message::SessionId, state::Core, transition::RangeEvent};

impl Core {
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
        if let Some(stage) = self.leases.stage_of(id)
            && let Some(entry) = self.stages.get_mut(&stage)
        {
            entry.held.set_until(id, to_ms);
        }
    }

    /// Applies an event to a leased range, and forgets the lease if the event has ended it.
    pub(super) fn mark(&mut self, range: &Range, event: &RangeEvent) {
        let entry = self
            .stages
            .get_mut(&range.stage)
            .expect("a lease has a stage");
        let left = self
            .outcome
            .apply(&mut entry.held, range, event)
            .expect("callers checked that the lease has the task to do");
        if let RangeEvent::Finish { task, .. } | RangeEvent::Leave { task, .. } = event {
            self.leases.task_over(range.id, *task);
        }
        if left.is_none() {
            self.lease_over(range.id);
        }
    }

    /// Forgets a lease.
    pub(super) fn lease_over(&mut self, id: RangeId) {
        self.leases.end(id);
        self.store_faults.lease_over(id);
        self.load.lease_over(id);
        self.workers.lease_over(id);
    }

    /// Returns a leased range.
    pub(super) fn range(&self, id: RangeId) -> Option<&Range> {
        let stage = self.leases.stage_of(id)?;
        self.stages[&stage].held.leased_range(id)
    }

    /// Returns the range of a live lease of this session's worker.
    pub(super) fn held(
        &self,
        session: SessionId,
        lease: LeaseRef,
        now_ms: i64,
    ) -> Result<&Range, String> {
        let worker = self
            .workers
            .id_of(session)
            .ok_or("the session is no longer this worker's")?;
        let incarnation = self.workers[&worker].incarnation;
        let (range, state) = self
            .leases
            .stage_of(lease.range)
            .and_then(|stage| self.stages[&stage].held.lease(lease))
            .ok_or("the lease is no longer live: it ran out, was cancelled, or is finished")?;
        if state.worker != worker || state.incarnation != incarnation {
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

    /// Returns the tasks of a lease that its worker runs, as far as is known. If the worker has
    /// reported nothing, this is the first unfinished task.
    pub(super) fn running_tasks(&self, range: &Range) -> Vec<u64> {
        let todo = |task: &u64| range.has_to_do(*task);
        let reported = self.leases.running(range.id).map(|(task, _)| task);
        let mut tasks: Vec<u64> = reported.filter(todo).collect();
        if tasks.is_empty() {
            tasks.extend((range.lo..range.hi).find(todo));
        }
        tasks
    }

    /// Returns the tasks of a lease that its worker has begun, as far as is known. While a worker
    /// runs tasks of another lease, it has usually begun none of this one.
    pub(super) fn begun_tasks(&self, range: &Range) -> Vec<u64> {
        let runs = |id: &RangeId| self.leases.is_running(*id);
        let RangeState::Leased(lease) = &range.state else {
            return Vec::new();
        };
        let holder = self.workers.get(&lease.worker);
        let elsewhere =
            holder.is_some_and(|w| w.leases.iter().any(|id| *id != range.id && runs(id)));
        match elsewhere && !runs(&range.id) {
            true => Vec::new(),
            false => self.running_tasks(range),
        }
    }
}
