//! Jobs and their stages, as stored in a catalog.

use std::sync::Arc;

use picofarm_proto::{
    ids::{JobId, StageRef},
    key::{StageKey, stage_key},
    messages::{JobState, StageState, TaskCounts},
    spec::{JobSpec, StageSpec},
};

use crate::task::Exception;

/// A submitted job.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Its id.
    pub id: JobId,
    /// Hash that identifies equal submissions, in hexadecimal: SHA-256 of the canonical spec and,
    /// if needed, of the group of users in which jobs with the same spec are considered equal.
    pub spec_hash: String,
    /// The submitted spec.
    pub spec: Arc<JobSpec>,
    /// The job's state.
    pub state: JobState,
    /// Unix time of submission, milliseconds.
    pub submitted_ms: i64,
    /// Unix time of the end, milliseconds.
    pub ended_ms: Option<i64>,
    /// Whether the job is paused, so that none of its tasks are started.
    pub paused: bool,
    /// The user who submitted it.
    pub user: String,
}

/// A stage of a job; its tasks are `0..tasks`.
#[derive(Debug, Clone, PartialEq)]
pub struct StageRecord {
    /// Its name.
    pub id: StageRef,
    /// Positions of the stages that this stage depends on.
    pub needs: Vec<u32>,
    /// Whether the stage begins even if tasks of those stages were given up.
    pub tolerate_dead: bool,
    /// Whether existing outputs are ignored.
    pub force: bool,
    /// The result set that the stage writes.
    pub set: ResultSet,
    /// Number of tasks.
    pub tasks: u64,
}

impl Job {
    /// Returns the job's stages, in order.
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
                set: ResultSet::of_stage(stage),
                tasks: stage.tasks(),
            })
            .collect()
    }
}

/// A job and its progress.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRecord {
    /// The job.
    pub job: Job,
    /// Its stages, in order.
    pub stages: Vec<StageCounts>,
    /// The duration of its tasks.
    pub timing: Timing,
    /// Number of results that workers have reported but the coordinator has not yet found in their
    /// store.
    pub unverified: u64,
}

/// A stage's state and progress.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StageCounts {
    /// Whether its tasks may run.
    pub state: StageState,
    /// Last committed number of its tasks in each state.
    pub counts: TaskCounts,
}

impl JobRecord {
    /// Returns the number of tasks in each state, over all stages.
    pub fn counts(&self) -> TaskCounts {
        let mut counts = TaskCounts::default();
        for stage in &self.stages {
            counts += stage.counts;
        }
        counts
    }
}

/// The place of a job's results and the hash of everything that determines them. Jobs with the same
/// result set share outputs.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ResultSet {
    /// URL or path of the store.
    pub store: String,
    /// Folder of the data set.
    pub dataset: String,
    /// Hash of everything that determines a result, except the task's index.
    pub stage_key: StageKey,
}

impl ResultSet {
    /// Returns the result set that a stage writes. A stage that does not write a data set gets a
    /// place that no data set can have.
    pub fn of_stage(stage: &StageSpec) -> Self {
        let results = stage.task.results();
        Self {
            store: results.store.to_owned(),
            dataset: results.folder,
            stage_key: stage_key(stage),
        }
    }
}

/// Number, total duration and total size of computed outputs.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Timing {
    /// Number of outputs.
    pub tasks: u64,
    /// Sum of their seconds.
    pub seconds: f64,
    /// Sum of their bytes.
    pub bytes: f64,
}

impl Timing {
    /// Returns the mean number of seconds per task; `None` if there is none yet.
    pub fn mean(&self) -> Option<f64> {
        (self.tasks > 0).then(|| self.seconds / self.tasks as f64)
    }
}

/// The reasons why a job's tasks wait, as far as the catalog knows.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Holdups {
    /// Pending tasks of open stages that may run at once.
    pub ready: u64,
    /// Pending tasks that may not run before a time.
    pub waiting: u64,
    /// The earliest of these times, in Unix milliseconds.
    pub next_ms: Option<i64>,
    /// A few of the tasks that failed most often.
    pub failed: Vec<Exception>,
    /// The jobs that must be done before any task begins, and are not.
    pub after: Vec<FormerJob>,
}

/// A job that another one waits for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FormerJob {
    /// Its id.
    pub job: JobId,
    /// Its number in lists.
    pub number: u64,
    /// Its state.
    pub state: JobState,
}
