//! Jobs and their stages, as a catalog keeps them.

use std::sync::Arc;

use picofarm_proto::{
    ids::{JobId, StageRef},
    key::{StageKey, stage_key},
    model::{JobSpec, JobState, StageSpec, StageState, TaskCounts},
};

use crate::task::Exception;

/// One submission.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Its id.
    pub id: JobId,
    /// What tells whether two submissions are the same job: SHA-256 of the canonical spec, where need be with among whose
    /// jobs an equal one is looked for, hexadecimal.
    pub spec_hash: String,
    /// What was submitted.
    pub spec: Arc<JobSpec>,
    /// Where it stands.
    pub state: JobState,
    /// Unix time of submission, milliseconds.
    pub submitted_ms: i64,
    /// Unix time of the end, milliseconds.
    pub ended_ms: Option<i64>,
    /// It is held: nothing of it is begun.
    pub paused: bool,
    /// Who submitted it.
    pub user: String,
}

/// A stage of a job: its tasks are `0..tasks`.
#[derive(Debug, Clone, PartialEq)]
pub struct StageRecord {
    /// Its name.
    pub id: StageRef,
    /// Positions of the stages that it needs.
    pub needs: Vec<u32>,
    /// It begins although tasks of those were given up.
    pub tolerate_dead: bool,
    /// Outputs that exist do not count.
    pub force: bool,
    /// Where its results go.
    pub set: ResultSet,
    /// Number of tasks.
    pub tasks: u64,
}

impl Job {
    /// The job's stages, in order.
    pub fn stages(&self) -> Vec<StageRecord> {
        let stages = self.spec.stages.iter().enumerate();
        stages
            .map(|(ordinal, stage)| StageRecord {
                id: StageRef {
                    job: self.id,
                    stage: ordinal as u32,
                },
                needs: stage
                    .needs
                    .iter()
                    .filter_map(|need| Some(self.spec.stage(need)?.0 as u32))
                    .collect(),
                tolerate_dead: stage.tolerate_dead,
                force: stage.force,
                set: ResultSet::of(stage),
                tasks: stage.tasks(),
            })
            .collect()
    }
}

/// A job and how far it is.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRecord {
    /// The job.
    pub job: Job,
    /// Its stages, in order.
    pub stages: Vec<StageCounts>,
    /// How long its tasks took.
    pub timing: Timing,
    /// Results that workers have reported and that the coordinator has not found in their store.
    pub unverified: u64,
}

/// Where a stage stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StageCounts {
    /// Whether its tasks may run.
    pub state: StageState,
    /// Its tasks by state, as last committed.
    pub counts: TaskCounts,
}

impl JobRecord {
    /// Tasks of all stages by state.
    pub fn counts(&self) -> TaskCounts {
        let mut counts = TaskCounts::default();
        for stage in &self.stages {
            counts += stage.counts;
        }
        counts
    }
}

/// Where the results of a job's tasks live and what shapes them: two jobs with the same set share outputs.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ResultSet {
    /// URL or path of the store.
    pub store: String,
    /// Folder of the data set.
    pub dataset: String,
    /// Hash of everything that shapes a result but the task's index.
    pub stage_key: StageKey,
}

impl ResultSet {
    /// The set a stage's tasks write to. What is no data set has a place that none can have.
    pub fn of(stage: &StageSpec) -> Self {
        let results = stage.task.results();
        Self {
            store: results.store.to_owned(),
            dataset: results.folder,
            stage_key: stage_key(stage),
        }
    }
}

/// Computed outputs and the seconds they took together.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Timing {
    /// How many.
    pub tasks: u64,
    /// Sum of their seconds.
    pub seconds: f64,
    /// Sum of their bytes.
    pub bytes: f64,
}

impl Timing {
    /// Mean seconds a task; `None` before the first.
    pub fn mean(&self) -> Option<f64> {
        (self.tasks > 0).then(|| self.seconds / self.tasks as f64)
    }
}

/// What a job's tasks wait for, as far as the catalog knows.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Holdups {
    /// Pending tasks of open stages that may run at once.
    pub ready: u64,
    /// Pending tasks that may not run before a time.
    pub waiting: u64,
    /// The first of these times, Unix milliseconds.
    pub next_ms: Option<i64>,
    /// The tasks that failed most often, a few of them.
    pub failed: Vec<Exception>,
}
