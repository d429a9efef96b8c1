//! Reports this instance's additions to the catalog's knowledge of jobs.

use std::collections::BTreeMap;

use picofarm_catalog::JobRecord;
use picofarm_proto::{
    ids::{JobId, StageRef},
    messages::{JobState, JobStatus, RunningTask, StageState, StageStatus},
    spec::JobSpec,
};

use super::state::Core;

/// This instance's additions to the catalog's knowledge of jobs.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Overlay {
    /// Running tasks, by job.
    running: BTreeMap<JobId, Vec<RunningTask>>,
    /// Mean seconds of a task, by stage.
    means: BTreeMap<StageRef, Option<f64>>,
    /// Workers connected to any instance.
    workers: u32,
}

impl Overlay {
    /// Adds this instance's knowledge to a job's status.
    pub(crate) fn complete(&mut self, status: &mut JobStatus) {
        status.workers = self.workers;
        status.running = self.running.remove(&status.id).unwrap_or_default();
        for (ordinal, stage) in (0..).zip(&status.stages) {
            let id = StageRef {
                job: status.id,
                stage: ordinal,
            };
            // The estimate uses the last running stage, because the earlier ones are nearly done.
            if stage.state == StageState::Open
                && let Some(mean) = self.means.get(&id)
            {
                status.mean_task_seconds = *mean;
            }
        }
    }
}

/// Converts the catalog's record of a job to a status.
pub(crate) fn recorded_status(record: JobRecord) -> JobStatus {
    let counts = record.counts();
    let JobRecord {
        job,
        stages,
        timing,
        unverified,
    } = record;
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
            project: job.spec.project.clone(),
            after: job.spec.after.clone(),
            // Lists of files may be long, so they are left out.
            stages: job.spec.stages.iter().map(|s| s.only(0, 0)).collect(),
        },
        mean_task_seconds: timing.mean(),
        running: Vec::new(),
        workers: 0,
        unverified,
    }
}

impl Core {
    /// Returns this instance's knowledge of one job, or of all jobs.
    pub(crate) fn overlay(&self, one: Option<JobId>, now_ms: i64) -> Overlay {
        let mut overlay = Overlay {
            workers: self.everywhere(),
            ..Overlay::default()
        };
        let stages = self.stages.iter();
        for (id, entry) in stages.filter(|(id, _)| one.is_none_or(|job| id.job == job)) {
            let mean = self.stages.mean_seconds(entry);
            overlay.means.insert(*id, mean);
            for (range, lease) in entry.held.leased() {
                if !self.leases.is_running(range.id) {
                    continue;
                }
                let running = overlay.running.entry(id.job).or_default();
                let tasks = self.leases.running(range.id);
                running.extend(tasks.map(|(index, progress)| RunningTask {
                    stage: id.stage,
                    index,
                    worker: self.workers.name(lease.worker),
                    fraction: progress.fraction,
                    text: progress.at.text.clone(),
                    figures: progress.at.figures.clone(),
                    seconds: (now_ms - progress.since_ms).max(0) as f64 / 1000.0,
                }));
            }
        }
        for running in overlay.running.values_mut() {
            running.sort_by_key(|r| (r.stage, r.index));
        }
        overlay
    }

    /// Returns the number of workers connected to this instance.
    pub(crate) fn connected(&self) -> u32 {
        self.workers.count()
    }

    /// Returns the number of workers connected to any instance.
    pub(crate) fn everywhere(&self) -> u32 {
        self.workers.count() + self.peers.workers()
    }
}
