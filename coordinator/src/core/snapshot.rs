//! Reports this instance's workers and the order of jobs, for explanations. Changes nothing.

use picofarm_proto::{
    ids::{JobId, StageRef, WorkerId},
    messages::ConnectedWorker,
};

use super::{
    candidate::{Candidate, RunningOn},
    pools::PoolFit,
    stage_entry::StageEntry,
    state::Core,
    words::span,
    workers::WorkerEntry,
};

/// A snapshot of the instance's knowledge.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FarmSnapshot {
    /// Active jobs, in the order in which they get workers.
    pub jobs: Vec<JobId>,
    /// Tasks that could be leased now if there were workers: unclaimed ones and those claimed by
    /// this instance.
    pub ready: u64,
    /// Workers connected to this instance.
    pub workers: Vec<ConnectedWorker>,
    /// Workers connected to other instances.
    pub elsewhere: u32,
    /// Live instances, including this one.
    pub instances: u32,
}

/// A snapshot of the instance's knowledge with regard to one job.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct JobSnapshot {
    /// Whether each worker of this instance may run the job's tasks, and its current work.
    pub candidates: Vec<Candidate>,
    /// Tasks that wait only because workers run them for other jobs with the same outputs.
    pub shared: u64,
    /// Tasks that wait for a worker without other leases.
    pub suspects: u64,
    /// Jobs of higher precedence with waiting tasks that one of these workers may run.
    pub ahead: Vec<JobId>,
    /// Workers connected to other instances.
    pub elsewhere: u32,
    /// Progress of the requested task, if a worker of this instance has reported on it.
    pub running: Option<RunningOn>,
    /// Pools of workers that other programs start.
    pub pools: Vec<PoolFit>,
    /// Why the jobs of the job's user may publish nothing more.
    pub over_bytes: Option<String>,
}

impl Core {
    /// Returns the current state.
    pub(crate) fn farm_snapshot(&self, now_ms: i64) -> FarmSnapshot {
        let mut stages: Vec<StageRef> = self.stages.keys().copied().collect();
        stages.sort_by_cached_key(|id| self.rank(*id));
        let mut jobs: Vec<JobId> = Vec::new();
        for stage in stages {
            if !jobs.contains(&stage.job) {
                jobs.push(stage.job);
            }
        }
        let workers = self.workers.iter().map(|(id, worker)| ConnectedWorker {
            id: id.to_string(),
            name: worker.name.clone(),
            version: worker.version.clone(),
            renderer: worker
                .abilities
                .kinds
                .get("render")
                .cloned()
                .unwrap_or_default(),
            cores: worker.abilities.cores,
            leases: u32::try_from(worker.leases.len()).unwrap_or(u32::MAX),
            tasks: self.unfinished_tasks(worker),
            since_ms: worker.since_ms,
            quarantined: worker.quarantined,
            note: self.worker_note(*id, worker, now_ms),
        });
        FarmSnapshot {
            jobs,
            ready: self.ready_now(now_ms),
            workers: workers.collect(),
            elsewhere: self.peers.workers(),
            instances: self.peers.instances(),
        }
    }

    /// Returns how long a worker has been silent, if longer than expected. A worker
    /// sends a heartbeat every sixth of a lease period, even without a lease.
    fn silent_ms(&self, worker: &WorkerEntry, now_ms: i64) -> Option<i64> {
        let silent = now_ms - worker.heard_ms;
        let long = silent > i64::from(self.settings.lease_ms) / 2;
        long.then_some(silent)
    }

    /// Returns why a worker gets no tasks, or when it ends.
    fn worker_note(&self, id: WorkerId, worker: &WorkerEntry, now_ms: i64) -> String {
        if let Some(ms) = self.silent_ms(worker, now_ms) {
            return format!(
                "not heard of for {}: frozen, suspended or overloaded",
                span(ms)
            );
        }
        if worker.drains {
            return "asked to end".into();
        }
        if let Some(ms) = self.failing_workers.rests(id, now_ms) {
            return format!(
                "failed, or gave back, one lease after another: no tasks for another {}",
                span(ms)
            );
        }
        worker
            .ends_ms
            .map_or_else(String::new, |at| format!("ends in {}", span(at - now_ms)))
    }

    pub(super) fn unfinished_tasks(&self, worker: &WorkerEntry) -> u64 {
        let ranges = worker.leases.iter().filter_map(|id| {
            let stage = self.leases.stage_of(*id)?;
            self.stages.get(&stage)?.held.leased_range(*id)
        });
        ranges
            .map(|range| match &range.state {
                picofarm_catalog::RangeState::Leased(lease) => {
                    let todo =
                        |mark: &&picofarm_catalog::Mark| **mark == picofarm_catalog::Mark::Todo;
                    lease.marks.iter().filter(todo).count() as u64
                }
                _ => 0,
            })
            .sum()
    }

    /// Returns the state with regard to a stage and to one of its tasks. For a job as a whole, the
    /// stage is the first one with waiting tasks.
    pub(crate) fn job_snapshot(
        &self,
        job: JobId,
        stage: Option<u32>,
        task: Option<u64>,
        now_ms: i64,
    ) -> JobSnapshot {
        let waits = |e: &StageEntry| e.waits(now_ms);
        let first = |is: &dyn Fn(&StageEntry) -> bool| {
            let mut of_job = self.stages.iter().filter(|(id, _)| id.job == job);
            of_job.find(|(_, e)| is(e)).map(|(id, _)| id.stage)
        };
        let stage = stage.or_else(|| first(&waits).or_else(|| first(&StageEntry::has_pending)));
        let here = StageRef {
            job,
            stage: stage.unwrap_or(0),
        };
        let Some(entry) = self.stages.get(&here) else {
            return JobSnapshot {
                elsewhere: self.peers.workers(),
                ..JobSnapshot::default()
            };
        };
        let candidates: Vec<Candidate> = self
            .workers
            .iter()
            .map(|(id, worker)| Candidate {
                name: worker.name.clone(),
                may_run: match worker.drains {
                    true => Err("it is asked to end".into()),
                    false => self.may_run(here, *id, now_ms),
                },
                lacks_memory: entry.lacks_memory(&worker.abilities),
                idle: worker.credits > 0,
                gets: !self.ready_for(here, *id, now_ms).is_none(),
                lacks_time: self.lacks_time(here, *id, now_ms),
                quarantined: worker.quarantined,
                silent_ms: self.silent_ms(worker, now_ms),
            })
            .collect();
        let able = |other: StageRef| {
            self.workers.keys().any(|w| {
                self.may_run(here, *w, now_ms).is_ok() && self.may_run(other, *w, now_ms).is_ok()
            })
        };
        let rank = self.rank(here);
        let mut first: Vec<StageRef> = self
            .stages
            .iter()
            .filter(|(id, e)| id.job != job && waits(e) && self.rank(**id) < rank && able(**id))
            .map(|(id, _)| *id)
            .collect();
        first.sort_by_cached_key(|id| self.rank(*id));
        let mut ahead: Vec<JobId> = first.into_iter().map(|id| id.job).collect();
        ahead.dedup();
        JobSnapshot {
            candidates,
            shared: self.waits_for_others(here),
            suspects: self.ready(here, now_ms).suspects,
            ahead,
            elsewhere: self.peers.workers(),
            running: task.and_then(|task| self.running_on(entry, task)),
            pools: self.pools_for(here, now_ms),
            over_bytes: self.may_publish(&entry.job().user).err(),
        }
    }

    fn running_on(&self, entry: &StageEntry, task: u64) -> Option<RunningOn> {
        entry.held.leased().find_map(|(range, lease)| {
            let progress = self.leases.progress(range.id, task)?;
            Some(RunningOn {
                worker: self.workers.name(lease.worker),
                fraction: progress.fraction,
                text: progress.at.text.clone(),
                since_ms: progress.since_ms,
            })
        })
    }

    /// Returns the number of history lines that wait to be written.
    pub(crate) fn new_events(&self) -> usize {
        self.outcome.events()
    }
}
