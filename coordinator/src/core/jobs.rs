//! Submission, the end of jobs, and what is known of them here.

use std::collections::{BTreeMap, HashMap};

use picofarm_catalog::{Job, JobRecord, NewEvent, Range, ResultSet, Run, Timing};
use picofarm_proto::{
    ids::{JobId, StageRef},
    key::spec_hash,
    model::{
        EventKind, JobSpec, JobState, JobStatus, RunningTask, SpecError, StageSpec, StageState,
        StageStatus,
    },
};

use super::{Core, Say};
use crate::plan;

/// A job ready to be recorded.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Prepared {
    pub job: Job,
    /// Nobody's.
    pub ranges: Vec<Range>,
    pub events: Vec<NewEvent>,
}

/// Checks that no job has put scenes of other settings into the data set that a stage names: their keys would be the
/// same, their bytes not. `others` are the jobs that write there.
///
/// # Errors
/// [`SpecError`] at `output.dataset` that names the job and the first setting that differs.
pub(crate) fn place_is_free(stage: &StageSpec, others: &[Job]) -> Result<(), SpecError> {
    let set = ResultSet::of(stage);
    for other in others {
        for there in &other.spec.stages {
            let theirs = ResultSet::of(there);
            if (&theirs.store, &theirs.dataset) != (&set.store, &set.dataset)
                || theirs.stage_key == set.stage_key
            {
                continue;
            }
            let changes = plan::changes(there, stage).join(", ");
            return Err(SpecError::new(
                "output.dataset",
                format!(
                    "{:?} in {} holds scenes of job {} ({:?}) with other settings: {changes}; \
                     name another data set, or use that job's settings",
                    set.dataset, set.store, other.id, other.spec.name
                ),
            ));
        }
    }
    Ok(())
}

/// The job that stands for a spec already: the latest with the same hash, unless it ended badly and the spec is to run
/// again.
pub(crate) fn stands_for(latest: Option<Job>, again: bool) -> Option<Job> {
    latest.filter(|job| !(again && matches!(job.state, JobState::Failed | JobState::Cancelled)))
}

impl Core {
    /// Lays a job out as ranges, given the outputs that exist, by stage.
    pub(crate) fn prepare(
        &mut self,
        spec: JobSpec,
        user: String,
        existing: &[Vec<Run>],
        now_ms: i64,
    ) -> Prepared {
        let id = JobId::from_uuid((self.make_id)());
        let job = Job {
            id,
            spec_hash: spec_hash(&spec),
            spec: spec.into(),
            state: JobState::Active,
            submitted_ms: now_ms,
            ended_ms: None,
            paused: false,
            user,
        };
        let mut ranges = Vec::new();
        let mut reused = Vec::new();
        let (mut total, mut there) = (0, 0);
        for (stage, existing) in job.stages().into_iter().zip(existing) {
            let existing: &[Run] = if stage.force { &[] } else { existing };
            let mut ids = Self::range_id(&mut self.make_id);
            ranges.extend(plan::expand(stage.id, stage.tasks, existing, &mut ids));
            total += stage.tasks;
            there += existing.iter().map(|r| r.hi - r.lo).sum::<u64>();
            reused.extend(existing.iter().map(|run| (stage.id.stage, *run)));
        }
        let message = format!("{total} tasks, {} to run", total - there);
        let mut events = vec![NewEvent::of(id, now_ms, EventKind::Submitted, message)];
        for (stage, run) in reused {
            let message = format!("outputs of tasks {}..{} exist already", run.lo, run.hi);
            let event = NewEvent::of(id, now_ms, EventKind::Reused, message);
            events.push(NewEvent {
                stage: Some(stage),
                tasks: Some(run),
                ..event
            });
        }
        Prepared {
            job,
            ranges,
            events,
        }
    }

    /// A job is held, or goes on: what is pending goes back, what runs goes on.
    pub(crate) fn paused(&mut self, job: JobId, paused: bool) {
        for (_, entry) in self.stages.iter_mut().filter(|(id, _)| id.job == job) {
            entry.job.paused = paused;
            entry.free = None;
            if paused {
                entry.stage.give_pending(&mut self.changes);
            }
        }
    }

    /// Jobs whose time is over.
    pub(crate) fn overdue(&self, now_ms: i64) -> BTreeMap<JobId, String> {
        let late = self.stages.iter().filter(|(_, entry)| {
            let deadline = entry.deadline_ms;
            deadline.is_some_and(|at| at <= now_ms)
        });
        late.map(|(id, entry)| (id.job, entry.job.spec.limits.deadline.clone()))
            .collect()
    }

    /// A job that is no longer active: its leases are revoked, what is not done goes back to the catalog.
    pub(crate) fn drop_job(&mut self, job: JobId, reason: &str) {
        let stages: Vec<StageRef> = self
            .stages
            .keys()
            .copied()
            .filter(|stage| stage.job == job)
            .collect();
        for id in stages {
            let leases: Vec<_> = self.stages[&id]
                .stage
                .leased()
                .map(|(range, lease)| (range.clone(), lease.worker))
                .collect();
            for (range, worker) in leases {
                if let Some(entry) = self.workers.get(&worker) {
                    let revoke = Say::Revoke {
                        lease: range.lease(),
                        reason: reason.to_owned(),
                    };
                    self.say.push((entry.session, revoke));
                }
                self.close(&range, false);
            }
            if let Some(mut entry) = self.stages.remove(&id) {
                entry.stage.give_pending(&mut self.changes);
            }
        }
    }

    /// Given-up tasks of an active job are pending again.
    pub(crate) fn retried(&mut self, job: JobId) {
        for (_, entry) in self.stages.iter_mut().filter(|(id, _)| id.job == job) {
            entry.exceptions.clear();
            entry.free = None;
        }
    }

    /// A job as people see it.
    pub(crate) fn status(&self, record: JobRecord, now_ms: i64) -> JobStatus {
        let counts = record.counts();
        let JobRecord {
            job,
            stages,
            timing,
        } = record;
        let mut running = Vec::new();
        let mut mean = timing.mean();
        for (id, entry) in self.stages.iter().filter(|(id, _)| id.job == job.id) {
            // Of the stages that run, the last: the others are nearly done.
            let runs = stages.get(id.stage as usize);
            if runs.is_some_and(|s| s.state == StageState::Open) {
                mean = self.sets[entry.set].timing.mean();
            }
            for (range, lease) in entry.stage.leased() {
                let Some(tasks) = self.progress.get(&range.id) else {
                    continue;
                };
                running.extend(tasks.iter().map(|(index, progress)| RunningTask {
                    stage: id.stage,
                    index: *index,
                    worker: self.name_of(lease.worker),
                    fraction: progress.fraction,
                    text: progress.at.text.clone(),
                    figures: progress.at.figures.clone(),
                    seconds: (now_ms - progress.since_ms).max(0) as f64 / 1000.0,
                }));
            }
        }
        running.sort_by_key(|r| (r.stage, r.index));
        let stages = job.spec.stages.iter().zip(stages);
        JobStatus {
            id: job.id,
            name: job.spec.name.clone(),
            state: job.state,
            tasks: counts,
            submitted_at_ms: job.submitted_ms,
            ended_at_ms: job.ended_ms,
            paused: job.paused && job.state == JobState::Active,
            user: job.user,
            stages: stages
                .map(|(spec, stage)| StageStatus {
                    name: spec.name.clone(),
                    kind: spec.task.kind().to_owned(),
                    state: stage.state,
                    needs: spec.needs.clone(),
                    tasks: stage.counts,
                })
                .collect(),
            spec: JobSpec {
                name: job.spec.name.clone(),
                priority: job.spec.priority,
                limits: job.spec.limits.clone(),
                nonce: job.spec.nonce.clone(),
                // Lists of files may be long.
                stages: job.spec.stages.iter().map(|s| s.only(0, 0)).collect(),
            },
            mean_task_seconds: mean,
            running,
            workers: self.connected() + self.elsewhere,
        }
    }

    /// Number of workers connected to this house.
    pub(crate) fn connected(&self) -> u32 {
        u32::try_from(self.workers.len()).unwrap_or(u32::MAX)
    }

    /// Number of workers connected to any house.
    pub(crate) fn everywhere(&self) -> u32 {
        self.connected() + self.elsewhere
    }

    /// Result sets whose times are not known yet, of these jobs.
    pub(crate) fn untimed(&self, jobs: &[Job]) -> Vec<ResultSet> {
        let sets = jobs.iter().flat_map(|job| job.stages());
        let mut sets: Vec<_> = sets.map(|stage| stage.set).collect();
        sets.retain(|set| !self.set_ids.contains_key(set));
        sets
    }
}

/// What is known of result sets.
pub(crate) type Timings = HashMap<ResultSet, Timing>;
