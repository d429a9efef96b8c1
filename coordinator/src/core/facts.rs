//! What this house knows of its workers and of the order of jobs, for those who ask why. Changes nothing.

use picofarm_proto::{
    ids::{JobId, StageRef},
    model::ConnectedWorker,
};

use super::{Core, StageEntry, WorkerEntry};
use crate::{explain::Candidate, place};

/// What the house knows at this moment.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Look {
    /// Active jobs, in the order in which they get workers.
    pub jobs: Vec<JobId>,
    /// Workers connected here.
    pub workers: Vec<ConnectedWorker>,
    /// Workers connected to other houses.
    pub elsewhere: u32,
    /// Houses alive, this one too.
    pub houses: u32,
}

/// What it knows with regard to one job.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct JobLook {
    /// Whether the workers here may run its tasks, and what they do.
    pub candidates: Vec<Candidate>,
    /// Jobs that go first and have tasks waiting that one of these workers may run.
    pub ahead: Vec<JobId>,
    /// Workers connected to other houses.
    pub elsewhere: u32,
    /// Of the task asked for, where a worker here has reported on it: its worker's name, share done, and since when.
    pub running: Option<(String, f32, i64)>,
}

impl Core {
    /// What is known now.
    pub(crate) fn look(&self) -> Look {
        let mut jobs: Vec<JobId> = self.stages.keys().map(|stage| stage.job).collect();
        jobs.dedup();
        let workers = self.workers.iter().map(|(id, worker)| ConnectedWorker {
            id: id.to_string(),
            name: worker.name.clone(),
            version: worker.version.clone(),
            renderer: worker.abilities.renderer.clone(),
            cores: worker.cores,
            leases: u32::try_from(worker.leases.len()).unwrap_or(u32::MAX),
            tasks: self.tasks_of(worker),
            since_ms: worker.since_ms,
            quarantined: worker.quarantined,
        });
        Look {
            jobs,
            workers: workers.collect(),
            elsewhere: self.elsewhere,
            houses: self.houses,
        }
    }

    fn tasks_of(&self, worker: &WorkerEntry) -> u64 {
        let ranges = worker.leases.iter().filter_map(|id| {
            let stage = self.stages.get(self.leases.get(id)?)?;
            stage.stage.leased_range(*id)
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

    /// What is known with regard to a job, and to one of its tasks.
    pub(crate) fn look_at(&self, job: JobId, task: Option<u64>) -> JobLook {
        let here = StageRef { job, stage: 0 };
        let Some(entry) = self.stages.get(&here) else {
            return JobLook {
                elsewhere: self.elsewhere,
                ..JobLook::default()
            };
        };
        let candidates: Vec<Candidate> = self
            .workers
            .values()
            .map(|worker| Candidate {
                name: worker.name.clone(),
                may_run: place::may_run(&entry.job.spec, &worker.abilities),
                idle: worker.credits > 0,
                quarantined: worker.quarantined,
            })
            .collect();
        let waits =
            |e: &StageEntry| e.stage.pending_tasks() > 0 || e.free.is_none_or(|free| free > 0);
        let able = |e: &StageEntry| {
            self.workers.values().any(|w| {
                place::may_run(&entry.job.spec, &w.abilities).is_ok()
                    && place::may_run(&e.job.spec, &w.abilities).is_ok()
            })
        };
        let mut ahead: Vec<JobId> = self
            .stages
            .range(..here)
            .filter(|(_, e)| waits(e) && able(e))
            .map(|(id, _)| id.job)
            .collect();
        ahead.dedup();
        JobLook {
            candidates,
            ahead,
            elsewhere: self.elsewhere,
            running: task.and_then(|task| self.runs(entry, task)),
        }
    }

    fn runs(&self, entry: &StageEntry, task: u64) -> Option<(String, f32, i64)> {
        entry.stage.leased().find_map(|(range, lease)| {
            let progress = self.progress.get(&range.id)?.get(&task)?;
            Some((
                self.name_of(lease.worker),
                progress.fraction,
                progress.since_ms,
            ))
        })
    }

    /// How many lines of history wait to be written.
    pub(crate) fn noted(&self) -> usize {
        self.changes.events.len()
    }
}
