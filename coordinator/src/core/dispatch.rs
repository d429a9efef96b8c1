//! Grants pending tasks to workers with credit. Works in memory, and only when something has
//! changed.

use std::cmp::Reverse;

use picofarm_catalog::RangeState;
use picofarm_proto::{
    ids::{StageRef, WorkerId},
    messages::{EventKind, Lease},
};

use super::{
    candidate::NotEligible, history::EventDetails, message::ToWorker, state::Core,
    store_faults::store_of, transition::RangeEvent, words::span,
};

/// The other workers that may run a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Others {
    /// At least one of them does not fail on its tasks.
    Good,
    /// There are others, and its tasks fail on all of them too.
    Failed,
    /// There is no other worker.
    None,
}

impl Core {
    /// Grants all claimed tasks that can be granted now.
    pub(crate) fn dispatch(&mut self, now_ms: i64) {
        self.end_second_runs();
        let waiting: Vec<StageRef> = self
            .stages
            .iter()
            .filter(|(_, e)| e.waits(now_ms))
            .map(|(id, _)| *id)
            .collect();
        for stage in &waiting {
            self.explain_waiting(*stage, now_ms);
        }
        let asking: Vec<WorkerId> = self.workers.asking().map(|(id, _)| *id).collect();
        if asking.is_empty() {
            return;
        }
        let mut waiting: Vec<(StageRef, u64)> = waiting
            .into_iter()
            .filter(|stage| !self.ready_here(*stage, now_ms).is_none())
            .map(|stage| (stage, self.able(stage, now_ms)))
            .collect();
        // Granting proceeds in rounds, so that the first worker does not take everything, and by
        // rank, which each grant changes.
        let mut granted = true;
        while granted {
            granted = false;
            for worker in &asking {
                waiting.sort_by_cached_key(|(stage, _)| self.rank(*stage));
                granted |= waiting
                    .iter()
                    .any(|(stage, able)| self.grant(*stage, *worker, *able, now_ms));
            }
        }
        self.help(&asking, now_ms);
    }

    /// Returns the precedence of a stage: higher priority first, then the user with the fewest
    /// leases, then the job with the fewest leases, then the earlier submission. Of users, and of
    /// jobs, with as many leases, the one that got a lease longest ago is first, because a single
    /// worker has no lease each time it asks.
    pub(super) fn rank(&self, id: StageRef) -> impl Ord + use<> {
        let job = self.stages[&id].job();
        (
            Reverse(job.spec.priority),
            self.load.leases_of_user(&job.user),
            self.load.turn_of_user(&job.user),
            self.load.leases_of_job(job.id),
            self.load.turn_of_job(job.id),
            id,
        )
    }

    pub(super) fn priority(&self, id: StageRef) -> i32 {
        self.stages[&id].job_spec().priority
    }

    /// Checks whether a connected worker may run a stage's tasks now.
    ///
    /// # Errors
    /// Returns the reason why not.
    pub(super) fn may_run(
        &self,
        id: StageRef,
        worker: WorkerId,
        now_ms: i64,
    ) -> Result<(), NotEligible> {
        if let Some(why) = self.doubts.blocked(worker) {
            return Err(why.into());
        }
        let entry = &self.stages[&id];
        entry.suits(&self.workers[&worker].abilities)?;
        let store = store_of(&entry.spec().task);
        self.store_faults.may_use(store, worker, now_ms)?;
        let most = entry.job_spec().limits.max_workers;
        if most > 0 && !self.load.may_join(id.job, worker, most) {
            return Err(NotEligible::from(format!(
                "limits.max_workers = {most}, and so many work on the job"
            )));
        }
        if let Err((needs, left)) = self.has_time(id, worker, now_ms) {
            return Err(NotEligible::from(format!(
                "a task is taken to need {}, and the worker ends in {}",
                span(needs),
                span(left)
            )));
        }
        if let Some(ms) = self.failing_workers.rests(worker, now_ms) {
            return Err(NotEligible::from(format!(
                "it failed, or gave back, one lease after another; it gets no tasks for another {}",
                span(ms)
            )));
        }
        if self.failing_workers.is_try(worker) && !self.workers[&worker].leases.is_empty() {
            return Err(NotEligible::from(
                "it failed, or gave back, one lease after another; one task is trying it now",
            ));
        }
        let user = &self.stages[&id].job().user;
        self.within_quota(user, worker, 0)
            .and_then(|()| self.may_publish(user))
            .map_err(NotEligible::Quota)?;
        match self.passed_over(id, worker, now_ms) {
            Some(0) => Err(
                "tasks of the stage failed on it one after another; one task is trying it now"
                    .into(),
            ),
            Some(ms) => Err(NotEligible::from(format!(
                "tasks of the stage failed on it one after another; it is passed over for another {}",
                span(ms)
            ))),
            None => Ok(()),
        }
    }

    /// Returns how much longer a worker gets no task of a stage because the tasks fail on it,
    /// milliseconds; 0 while one of them is a try. If they fail on every worker, the tasks are at
    /// fault and no worker is excluded.
    pub(super) fn passed_over(&self, id: StageRef, worker: WorkerId, now_ms: i64) -> Option<i64> {
        let blocklist = &self.stages[&id].blocklist;
        if !blocklist.doubts(worker) {
            return None;
        }
        let left = match self.others(id, worker, now_ms) {
            Others::Good => blocklist.avoids(worker, now_ms),
            Others::None => blocklist.avoids_alone(worker, now_ms),
            Others::Failed => return None,
        };
        let mut leases = self.workers.get(&worker)?.leases.iter();
        left.or_else(|| {
            leases
                .any(|lease| self.leases.stage_of(*lease) == Some(id))
                .then_some(0)
        })
    }

    /// Classifies the other workers that may run a stage.
    pub(super) fn others(&self, id: StageRef, than: WorkerId, now_ms: i64) -> Others {
        let entry = &self.stages[&id];
        let others = self.workers.iter().filter(|(worker, w)| {
            **worker != than
                && !w.drains
                && now_ms - w.heard_ms <= i64::from(self.settings.lease_ms)
                && self.failing_workers.rests(**worker, now_ms).is_none()
                && entry.suits(&w.abilities).is_ok()
                && self.has_time(id, **worker, now_ms).is_ok()
        });
        let mut found = Others::None;
        for (worker, _) in others {
            if !entry.blocklist.doubts(*worker) {
                return Others::Good;
            }
            found = Others::Failed;
        }
        found
    }

    /// Grants one lease of a stage to a worker, if both are ready; `able` workers may run the
    /// stage.
    pub(super) fn grant(&mut self, id: StageRef, worker: WorkerId, able: u64, now_ms: i64) -> bool {
        let entry = &self.stages[&id];
        let who = &self.workers[&worker];
        if !who.wants_leases() || self.may_run(id, worker, now_ms).is_err() {
            return false;
        }
        // A suspect range runs alone on its worker, so that a crash affects no other lease.
        let others = self.excluded_tasks(id, worker, now_ms);
        let suspects = who.leases.is_empty();
        let Some((range, run)) = entry.held.front(now_ms, suspects, &others) else {
            return false;
        };
        let range = range.clone();
        let store = store_of(&entry.spec().task).to_owned();
        // A task that may run for days must not delay others, and a try has a single task.
        let alone = self.store_faults.is_try(&store, worker)
            || entry.spec().task.resumes()
            || entry.blocklist.doubts(worker)
            || self.failing_workers.is_try(worker);
        let count = match alone {
            true => 1,
            false => self
                .lease_size(entry, able, run.hi - run.lo, now_ms)
                .min(self.most_that_fit(id, worker, now_ms)),
        };
        let key = *self.stages.key_of(entry);
        let entry = self.stages.get_mut(&id).expect("looked up above");
        let who = self.workers.get_mut(&worker).expect("looked up above");
        let grant = RangeEvent::Grant {
            at: run.lo,
            count,
            worker,
            incarnation: who.incarnation,
            until_ms: now_ms + i64::from(self.settings.lease_ms),
        };
        let granted = self
            .outcome
            .apply(&mut entry.held, &range, &grant)
            .expect("a pending range can be granted")
            .expect("a grant leaves a leased range");
        debug_assert!(matches!(granted.state, RangeState::Leased(_)));
        who.credits -= 1;
        who.leases.insert(granted.id);
        who.quarantined = granted.crashes > 0;
        self.leases.begin(granted.id, id);
        self.store_faults.lease_begun(&store, worker, granted.id);
        self.load.lease_begun(granted.id, entry.job(), worker);
        let lease = Lease {
            lease: granted.lease(),
            job: id.job,
            lo: granted.lo,
            hi: granted.hi,
            skip: Vec::new(),
            ttl_ms: self.settings.lease_ms,
            stage: entry.spec().only(granted.lo, granted.hi),
            ordinal: id.stage,
            key,
            traceparent: String::new(),
        };
        self.outcome
            .send(who.session, ToWorker::Lease(Box::new(lease)));
        let about = EventDetails::message(format!("tasks {}..{}", granted.lo, granted.hi))
            .tasks(granted.lo, granted.hi)
            .worker(who.name.clone());
        self.outcome.event(now_ms, id, EventKind::Leased, about);
        true
    }

    /// Returns the number of connected workers that may run a stage's tasks.
    pub(super) fn able(&self, id: StageRef, now_ms: i64) -> u64 {
        let able = |worker: &&WorkerId| self.may_run(id, **worker, now_ms).is_ok();
        self.workers.keys().filter(able).count() as u64
    }

    /// Records in the history why no connected worker may run a job, once for each reason.
    fn explain_waiting(&mut self, id: StageRef, now_ms: i64) {
        let entry = &self.stages[&id];
        let mut reasons = self
            .workers
            .values()
            .map(|w| (&w.name, entry.suits(&w.abilities)));
        let Some((name, Err(reason))) = reasons.next() else {
            return;
        };
        if reasons.any(|(_, verdict)| verdict.is_ok()) {
            return;
        }
        let name = name.clone();
        let entry = self.stages.get_mut(&id).expect("looked up above");
        if !entry.waits_because(&reason) {
            return;
        }
        tracing::warn!(job = %id.job, worker = name, "no connected worker may run this job: {reason}");
        let message = format!("no connected worker may run this job: {reason}");
        self.outcome.event(
            now_ms,
            id,
            EventKind::Waiting,
            EventDetails::message(message).worker(name),
        );
    }
}
