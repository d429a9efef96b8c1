//! Submission, cancellation, retry and status.

use picofarm_catalog::{Changes, Job, ResultSet, Run, Timing};
use picofarm_proto::{
    ids::JobId,
    key::spec_hash,
    model::{EventKind, JobPlan, JobSpec, JobState, JobStatus, RunningTask, SpecError},
};

use super::{About, Core, Say};
use crate::{plan, stage::Stage, transition::RangeEvent};

/// Answer to a submission.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Submitted {
    pub job: JobId,
    pub existed: bool,
    pub plan: JobPlan,
}

impl Core {
    /// The latest job with exactly this spec.
    pub(crate) fn job_with(&self, hash: &str) -> Option<&Job> {
        self.order
            .iter()
            .rev()
            .map(|id| &self.jobs[id].job)
            .find(|job| job.spec_hash == hash)
    }

    /// What submitting would do, given the outputs that exist.
    pub(crate) fn plan(&self, spec: &JobSpec, existing: &[Run]) -> JobPlan {
        let job = self.job_with(&spec_hash(spec)).map(|job| job.id);
        plan::plan(spec, existing, job)
    }

    /// Checks that no job has put scenes of other settings into the data set this one names: their keys
    /// would be the same, their bytes not.
    ///
    /// # Errors
    /// [`SpecError`] at `output.dataset` that names the job and the first setting that differs.
    pub(crate) fn place_is_free(&self, spec: &JobSpec) -> Result<(), SpecError> {
        let set = ResultSet::of(spec);
        for id in &self.order {
            let entry = &self.jobs[id];
            let other = &entry.job.spec;
            let same_place = other.output.store == set.store && other.output.dataset == set.dataset;
            let holds = entry.job.state == JobState::Active || entry.stage.counts().done > 0;
            if same_place && holds && ResultSet::of(other).stage_key != set.stage_key {
                let what = plan::difference(other, spec).unwrap_or_default();
                return Err(SpecError::new(
                    "output.dataset",
                    format!(
                        "{:?} in {} holds scenes of job {id} ({:?}) with other settings{what}; \
                         name another data set, or use that job's settings",
                        set.dataset, set.store, other.name
                    ),
                ));
            }
        }
        Ok(())
    }

    /// Submits a job; one that is active or done already, or ended otherwise and is not to be submitted again,
    /// answers with itself.
    ///
    /// # Errors
    /// As [`Core::place_is_free`].
    pub(crate) fn submit(
        &mut self,
        spec: JobSpec,
        again: bool,
        existing: &[Run],
        timing: Timing,
        now_ms: i64,
    ) -> Result<Submitted, SpecError> {
        let plan = self.plan(&spec, existing);
        if let Some(job) = self.job_with(&plan.spec_hash) {
            let ended_badly = matches!(job.state, JobState::Failed | JobState::Cancelled);
            if !(again && ended_badly) {
                return Ok(Submitted {
                    job: job.id,
                    existed: true,
                    plan,
                });
            }
        }
        self.place_is_free(&spec)?;
        let id = JobId::from_uuid((self.make_id)());
        let set = ResultSet::of(&spec);
        let job = Job {
            id,
            spec_hash: plan.spec_hash.clone(),
            spec: spec.into(),
            state: JobState::Active,
            submitted_ms: now_ms,
            ended_ms: None,
        };
        let mut changes = Changes::default();
        changes.jobs.push(job.clone());
        let ranges = plan::expand(
            id,
            plan.total,
            existing,
            &mut Self::range_id(&mut self.make_id),
        );
        let stage = Stage::new(ranges, &mut changes);
        self.changes.append(changes);
        self.adopt(job, set, timing, stage);
        self.event(
            now_ms,
            id,
            EventKind::Submitted,
            About::message(format!("{} tasks, {} to run", plan.total, plan.run)),
        );
        for run in existing {
            let (lo, hi) = (run.lo, run.hi);
            let about = About::message(format!("outputs of tasks {lo}..{hi} exist already"));
            self.event(now_ms, id, EventKind::Reused, about.tasks(lo, hi));
        }
        self.end_if_over(id, now_ms);
        Ok(Submitted {
            job: id,
            existed: false,
            plan,
        })
    }

    /// Stops a job: its leases are revoked, finished tasks stay. One that has ended stays as it is.
    pub(crate) fn cancel(&mut self, id: JobId, now_ms: i64) -> Option<JobStatus> {
        let entry = self.jobs.get_mut(&id)?;
        if entry.job.state == JobState::Active {
            entry.job.state = JobState::Cancelled;
            entry.job.ended_ms = Some(now_ms);
            self.changes
                .job_states
                .insert(id, (JobState::Cancelled, Some(now_ms)));
            self.event(now_ms, id, EventKind::Cancelled, About::default());
            let leases: Vec<_> = self.jobs[&id]
                .stage
                .leased()
                .map(|(range, lease)| (range.clone(), lease.worker))
                .collect();
            for (range, worker) in leases {
                if let Some(entry) = self.workers.get(&worker) {
                    self.say.push((
                        entry.session,
                        Say::Revoke {
                            lease: range.lease(),
                            reason: "the job was cancelled".into(),
                        },
                    ));
                }
                self.close(&range, false);
            }
        }
        self.status(id, now_ms)
    }

    /// Makes given-up tasks of a job pending again with fresh budgets; `None` = no such job.
    ///
    /// # Errors
    /// When the job was cancelled.
    pub(crate) fn retry(&mut self, id: JobId, now_ms: i64) -> Option<Result<u64, String>> {
        let entry = self.jobs.get_mut(&id)?;
        if entry.job.state == JobState::Cancelled {
            return Some(Err(format!(
                "job {id} was cancelled; submit it again instead (finished tasks are reused)"
            )));
        }
        let mut retried = 0;
        for range in entry.stage.dead() {
            retried += range.len();
            entry
                .stage
                .apply(
                    &range,
                    &RangeEvent::Retry,
                    &mut Self::range_id(&mut self.make_id),
                    &mut self.changes,
                )
                .expect("a dead range can be retried");
            for (_, exception) in entry.exceptions.range_mut(range.lo..range.hi) {
                exception.failures = 0;
                exception.crashes = 0;
                exception.dead = false;
                self.changes
                    .exceptions
                    .insert((id, exception.task), exception.clone());
            }
        }
        if retried > 0 {
            entry.job.state = JobState::Active;
            entry.job.ended_ms = None;
            self.changes.job_states.insert(id, (JobState::Active, None));
            let about = About::message(format!("{retried} dead tasks are pending again"));
            self.event(now_ms, id, EventKind::Retried, about);
        }
        Some(Ok(retried))
    }

    /// A job as people see it.
    pub(crate) fn status(&self, id: JobId, now_ms: i64) -> Option<JobStatus> {
        let entry = self.jobs.get(&id)?;
        let mut running = Vec::new();
        for (range, lease) in entry.stage.leased() {
            let Some(tasks) = self.progress.get(&range.id) else {
                continue;
            };
            running.extend(tasks.iter().map(|(index, progress)| RunningTask {
                index: *index,
                worker: self.name_of(lease.worker),
                fraction: progress.fraction,
                seconds: (now_ms - progress.since_ms).max(0) as f64 / 1000.0,
            }));
        }
        running.sort_by_key(|r| r.index);
        Some(JobStatus {
            id,
            name: entry.job.spec.name.clone(),
            state: entry.job.state,
            tasks: entry.stage.counts(),
            submitted_at_ms: entry.job.submitted_ms,
            ended_at_ms: entry.job.ended_ms,
            spec: (*entry.job.spec).clone(),
            mean_task_seconds: self.sets[entry.set].timing.mean(),
            running,
            workers: self.connected(),
        })
    }

    /// All jobs, in order of submission.
    pub(crate) fn list(&self, now_ms: i64) -> Vec<JobStatus> {
        self.order
            .iter()
            .filter_map(|id| self.status(*id, now_ms))
            .collect()
    }

    /// Number of connected workers.
    pub(crate) fn connected(&self) -> u32 {
        u32::try_from(self.workers.len()).unwrap_or(u32::MAX)
    }
}
