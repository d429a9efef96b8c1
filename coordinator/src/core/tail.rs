//! The end of a stage. When no task is pending, idle workers help slow ones.
//!
//! *Trimming* gives the second half of the lease with the most unfinished tasks to an idle worker,
//! and tells the holder the new end of its lease. *Doubling* runs a task that takes far longer than
//! the mean of its stage on a second worker, and commits the run that ends first. Both work because
//! tasks are pure: two workers that run the same task publish the same bytes, and the second finds
//! the output.

use picofarm_catalog::{Mark, Range};
use picofarm_proto::{
    ids::{Epoch, LeaseRef, RangeId, StageRef, WorkerId},
    messages::{EventKind, Lease},
};

use super::{
    history::EventDetails,
    message::{SessionId, ToWorker},
    second_runs::SecondRun,
    state::Core,
    transition::RangeEvent,
};

/// A task is doubled when it has taken this multiple of the mean of its stage.
const SLOW: f64 = 3.0;

impl Core {
    /// Gives idle workers a part of other workers' leases. Call it when all pending tasks have been
    /// granted. It searches only a few times a second, because it visits every lease.
    pub(super) fn help(&mut self, asking: &[WorkerId], now_ms: i64) {
        // A worker that asks for leases ahead of time is not idle.
        let idle = |worker: &&WorkerId| {
            let who = &self.workers[*worker];
            who.wants_leases() && who.leases.is_empty()
        };
        let mut idle: Vec<WorkerId> = asking.iter().filter(idle).copied().collect();
        if idle.is_empty() || !self.second_runs.is_due(now_ms) {
            return;
        }
        let mut stages: Vec<StageRef> = self
            .stages
            .iter()
            // Tasks that wait after a failure do not prevent help.
            .filter(|(_, e)| !e.is_paused() && !e.waits(now_ms) && e.held.leased_tasks() > 0)
            // Half the work of a resumable task would be wasted, and the task has saved its
            // progress.
            .filter(|(_, e)| !e.spec().task.resumes())
            .map(|(id, _)| *id)
            .collect();
        stages.sort_by_cached_key(|id| self.rank(*id));
        for stage in stages {
            let mut others = Vec::new();
            let mut waiting = idle.into_iter();
            for worker in waiting.by_ref() {
                if self.may_run(stage, worker, now_ms).is_err() {
                    others.push(worker);
                } else if self.trim(stage, worker, now_ms) {
                    // The tasks cut off are pending now, and this worker is the first to get them.
                    let able = self.able(stage, now_ms);
                    self.grant(stage, worker, able, now_ms);
                } else if !self.run_twice(stage, worker, now_ms) {
                    others.push(worker);
                    break;
                }
            }
            others.extend(waiting);
            idle = others;
        }
    }

    /// Cuts the second half off the lease of a stage that has the most unfinished tasks, if the
    /// remainder is long enough.
    fn trim(&mut self, id: StageRef, idle: WorkerId, now_ms: i64) -> bool {
        let entry = &self.stages[&id];
        let Some(mean) = self.stages.mean_seconds(entry) else {
            return false;
        };
        let longest = entry
            .held
            .leased()
            .filter(|(range, lease)| range.crashes == 0 && lease.worker != idle)
            .map(|(range, lease)| {
                let todo = lease.marks.iter().filter(|m| **m == Mark::Todo).count();
                (todo, range, lease)
            })
            .max_by_key(|(todo, ..)| *todo);
        let Some((todo, range, lease)) = longest else {
            return false;
        };
        if todo < 2 || todo as f64 * mean * 1000.0 < f64::from(self.settings.worth_ms) {
            return false;
        }
        // A lease is worked through in order, so the running task stays.
        let mut left = (range.lo..)
            .zip(&lease.marks)
            .filter(|(_, m)| **m == Mark::Todo);
        let Some((at, _)) = left.nth(todo.div_ceil(2)) else {
            return false;
        };
        let from = usize::try_from(at - range.lo).expect("a lease is small");
        if lease.marks[from..].iter().any(|m| *m != Mark::Todo) {
            return false;
        }
        // Small tasks run side by side, so that the holder may have begun these, too.
        if self.leases.running(range.id).any(|(task, _)| task >= at) {
            return false;
        }
        let (range, holder) = (range.clone(), lease.worker);
        if let Some(entry) = self.workers.get(&holder) {
            let trim = ToWorker::Trim {
                lease: range.lease(),
                hi: at,
            };
            self.outcome.send(entry.session, trim);
        }
        let about = EventDetails::message("an idle worker takes the rest over")
            .tasks(at, range.hi)
            .worker(self.workers.name(holder));
        self.outcome.event(now_ms, id, EventKind::Released, about);
        self.mark(&range, &RangeEvent::Trim { at });
        true
    }

    /// Runs the slowest task of a stage a second time, if it is slow and runs only once.
    fn run_twice(&mut self, id: StageRef, idle: WorkerId, now_ms: i64) -> bool {
        let entry = &self.stages[&id];
        let Some(mean) = self.stages.mean_seconds(entry) else {
            return false;
        };
        let slow_ms = i64::from(self.settings.slow_ms).max((SLOW * mean * 1000.0) as i64);
        let slowest = entry
            .held
            .leased()
            .filter(|(range, lease)| range.crashes == 0 && lease.worker != idle)
            .filter_map(|(range, _)| {
                let mut tasks = self.leases.running(range.id).filter(|(task, p)| {
                    now_ms - p.since_ms >= slow_ms
                        && !self.second_runs.contains(range.lease(), *task)
                });
                let (task, progress) = tasks.next()?;
                Some((progress.since_ms, range.lease(), task))
            })
            .min();
        let Some((since_ms, first, task)) = slowest else {
            return false;
        };
        let lease = LeaseRef {
            range: self.outcome.new_range_id(),
            epoch: Epoch(0),
        };
        let entry = &self.stages[&id];
        let grant = Lease {
            lease,
            job: id.job,
            lo: task,
            hi: task + 1,
            skip: Vec::new(),
            ttl_ms: self.settings.lease_ms,
            stage: entry.spec().only(task, task + 1),
            ordinal: id.stage,
            key: *self.stages.key_of(entry),
            traceparent: String::new(),
        };
        let second = SecondRun {
            first,
            stage: id,
            task,
            worker: idle,
        };
        self.second_runs.insert(lease.range, second);
        let who = self.workers.get_mut(&idle).expect("it is asking");
        who.credits -= 1;
        who.leases.insert(lease.range);
        let (session, name) = (who.session, who.name.clone());
        self.outcome.send(session, ToWorker::Lease(Box::new(grant)));
        let seconds = (now_ms - since_ms) / 1000;
        let message = format!(
            "a second time, as the first has taken {seconds} s and others took {mean:.1} s"
        );
        let about = EventDetails::message(message).task(task).worker(name);
        self.outcome.event(now_ms, id, EventKind::Leased, about);
        true
    }

    /// Returns the second run that a worker runs under this lease, with the range of the first run,
    /// if that range still has the task to do.
    pub(super) fn second_run(
        &self,
        worker: WorkerId,
        lease: LeaseRef,
    ) -> Option<(SecondRun, &Range)> {
        let run = self.second_runs.get(lease.range)?;
        if lease.epoch != Epoch(0) || run.worker != worker {
            return None;
        }
        let (range, state) = self.stages.get(&run.stage)?.held.lease(run.first)?;
        let at = usize::try_from(run.task.checked_sub(range.lo)?).ok()?;
        (state.marks.get(at) == Some(&Mark::Todo)).then_some((*run, range))
    }

    /// Forgets second runs of tasks that are no longer to be done, and tells their workers. Also
    /// forgets the second runs of disconnected workers.
    pub(super) fn end_second_runs(&mut self) {
        let over: Vec<(RangeId, WorkerId)> = self
            .second_runs
            .iter()
            .filter(|(id, run)| {
                let lease = LeaseRef {
                    range: *id,
                    epoch: Epoch(0),
                };
                self.workers.get(&run.worker).is_none()
                    || self.second_run(run.worker, lease).is_none()
            })
            .map(|(id, run)| (id, run.worker))
            .collect();
        for (id, worker) in over {
            self.second_runs.remove(id);
            if let Some(entry) = self.workers.get_mut(&worker)
                && entry.leases.remove(&id)
            {
                let revoke = ToWorker::Revoke {
                    lease: LeaseRef {
                        range: id,
                        epoch: Epoch(0),
                    },
                    reason: "the task was finished, or taken back, where it ran first".into(),
                };
                self.outcome.send(entry.session, revoke);
            }
        }
    }

    /// Forgets a second run that its worker returned or failed. This has no further effect. Returns
    /// `false` if the lease is not a second run.
    pub(super) fn drop_second_run(&mut self, session: SessionId, lease: LeaseRef) -> bool {
        let Some(worker) = self.workers.id_of(session) else {
            return false;
        };
        let run = self.second_runs.get(lease.range);
        if run.is_none_or(|run| run.worker != worker) {
            return false;
        }
        self.second_runs.remove(lease.range);
        if let Some(entry) = self.workers.get_mut(&worker) {
            entry.leases.remove(&lease.range);
        }
        true
    }
}
