//! Grants: pending tasks to workers with credit, in memory and only when something has changed.

use picofarm_catalog::RangeState;
use picofarm_proto::{
    ids::{StageRef, WorkerId},
    model::{EventKind, Lease},
};

use super::{About, Core, Say};
use crate::{place, transition::RangeEvent};

impl Core {
    /// Grants whatever is in hand and can be granted now.
    pub(crate) fn dispatch(&mut self, now_ms: i64) {
        let waiting: Vec<StageRef> = self
            .stages
            .iter()
            .filter(|(_, e)| e.stage.pending_tasks() > 0 || e.free != Some(0))
            .map(|(id, _)| *id)
            .collect();
        for stage in &waiting {
            self.explain_waiting(*stage, now_ms);
        }
        let hungry: Vec<WorkerId> = self
            .workers
            .iter()
            .filter(|(_, w)| w.credits > 0 && !w.quarantined)
            .map(|(id, _)| *id)
            .collect();
        if hungry.is_empty() {
            return;
        }
        let waiting: Vec<(StageRef, u64)> = waiting
            .into_iter()
            .filter(|stage| self.stages[stage].stage.pending_tasks() > 0)
            .map(|stage| (stage, self.able(stage)))
            .collect();
        // In rounds, so that the first worker does not take everything.
        let mut granted = true;
        while granted {
            granted = false;
            for worker in &hungry {
                granted |= waiting
                    .iter()
                    .any(|(stage, able)| self.grant(*stage, *worker, *able, now_ms));
            }
        }
    }

    /// Grants one lease of a stage to a worker, if both can; `able` workers may run it.
    fn grant(&mut self, id: StageRef, worker: WorkerId, able: u64, now_ms: i64) -> bool {
        let entry = &self.stages[&id];
        let who = &self.workers[&worker];
        if who.credits == 0
            || who.quarantined
            || place::may_run(&entry.job.spec, &who.abilities).is_err()
        {
            return false;
        }
        // A range under suspicion runs alone on its worker, so that it cannot draw others into its crash.
        let Some(range) = entry.stage.front(now_ms, who.leases.is_empty()).cloned() else {
            return false;
        };
        let count = self.lease_size(entry, able, range.len());
        let entry = self.stages.get_mut(&id).expect("looked up above");
        let who = self.workers.get_mut(&worker).expect("looked up above");
        let granted = entry
            .stage
            .apply(
                &range,
                &RangeEvent::Grant {
                    count,
                    worker,
                    incarnation: who.incarnation,
                    until_ms: now_ms + i64::from(self.settings.lease_ms),
                },
                &mut Self::range_id(&mut self.make_id),
                &mut self.changes,
            )
            .expect("a pending range can be granted")
            .expect("a grant leaves a leased range");
        debug_assert!(matches!(granted.state, RangeState::Leased(_)));
        who.credits -= 1;
        who.leases.insert(granted.id);
        who.quarantined = granted.crashes > 0;
        self.leases.insert(granted.id, id);
        let lease = Lease {
            lease: granted.lease(),
            job: id.job,
            lo: granted.lo,
            hi: granted.hi,
            skip: Vec::new(),
            ttl_ms: self.settings.lease_ms,
            spec: (*entry.job.spec).clone(),
        };
        self.say.push((who.session, Say::Lease(Box::new(lease))));
        let about = About::message(format!("tasks {}..{}", granted.lo, granted.hi))
            .tasks(granted.lo, granted.hi)
            .worker(who.name.clone());
        self.event(now_ms, id.job, EventKind::Leased, about);
        true
    }

    /// Number of connected workers that may run a stage's tasks.
    fn able(&self, id: StageRef) -> u64 {
        let spec = &self.stages[&id].job.spec;
        self.workers
            .values()
            .filter(|w| place::may_run(spec, &w.abilities).is_ok())
            .count() as u64
    }

    /// Where workers are connected but none may run a job, its history says why, once for each reason.
    fn explain_waiting(&mut self, id: StageRef, now_ms: i64) {
        let entry = &self.stages[&id];
        let mut reasons = self
            .workers
            .values()
            .map(|w| (&w.name, place::may_run(&entry.job.spec, &w.abilities)));
        let Some((name, Err(reason))) = reasons.next() else {
            return;
        };
        if reasons.any(|(_, verdict)| verdict.is_ok()) {
            return;
        }
        if entry.waiting.as_deref() == Some(&*reason) {
            return;
        }
        let name = name.clone();
        tracing::warn!(job = %id.job, worker = name, "no connected worker may run this job: {reason}");
        self.stages.get_mut(&id).expect("looked up above").waiting = Some(reason.clone());
        let message = format!("no connected worker may run this job: {reason}");
        self.event(
            now_ms,
            id.job,
            EventKind::Waiting,
            About::message(message).worker(name),
        );
    }
}
