//! Reports on jobs, for people. Every count is derived from ranges and outputs.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::{ids::JobId, model::JobSpec};

/// Where a job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Tasks are pending or running.
    Active,
    /// Every task is done.
    Done,
    /// Every task is done or dead, and at least one is dead.
    Failed,
    /// Stopped by a person; finished tasks stay.
    Cancelled,
}

/// Tasks of a job by state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct TaskCounts {
    /// All.
    pub total: u64,
    /// Output committed.
    pub done: u64,
    /// Part of `done` that was there before this job ran it.
    pub reused: u64,
    /// In a live lease and not done.
    pub leased: u64,
    /// Waiting.
    pub pending: u64,
    /// Given up.
    pub dead: u64,
}

impl std::ops::AddAssign for TaskCounts {
    fn add_assign(&mut self, other: Self) {
        self.total += other.total;
        self.done += other.done;
        self.reused += other.reused;
        self.leased += other.leased;
        self.pending += other.pending;
        self.dead += other.dead;
    }
}

/// Where a stage stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum StageState {
    /// It waits for others.
    Blocked,
    /// Its tasks may run.
    Open,
    /// Every task is done.
    Done,
    /// Every task is done or dead, and at least one is dead.
    Failed,
}

/// A stage as people see it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageStatus {
    /// Its name.
    pub name: String,
    /// What its tasks do.
    pub kind: String,
    /// State.
    pub state: StageState,
    /// The stages it needs.
    pub needs: Vec<String>,
    /// Counts.
    pub tasks: TaskCounts,
}

/// A task that runs now.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunningTask {
    /// Position of its stage in the job.
    pub stage: u32,
    /// Task index.
    pub index: u64,
    /// Worker's name.
    pub worker: String,
    /// Share done in [0, 1].
    pub fraction: f32,
    /// Seconds since the worker began it.
    pub seconds: f64,
    /// What it is at, in its own words.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub text: String,
    /// The same as figures: loss, samples_per_s, …
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub figures: BTreeMap<String, f64>,
}

/// A job as people see it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JobStatus {
    /// Id.
    pub id: JobId,
    /// Name.
    pub name: String,
    /// State.
    pub state: JobState,
    /// Counts.
    pub tasks: TaskCounts,
    /// Unix time of submission, milliseconds.
    pub submitted_at_ms: i64,
    /// Unix time of the end, milliseconds.
    pub ended_at_ms: Option<i64>,
    /// It is held: nothing of it is begun.
    pub paused: bool,
    /// Who submitted it.
    pub user: String,
    /// Its stages, in order.
    pub stages: Vec<StageStatus>,
    /// The job, without lists of files.
    pub spec: JobSpec,
    /// Mean seconds of a computed task on one worker, of the stage that runs; `None` before the first.
    pub mean_task_seconds: Option<f64>,
    /// Tasks that run now.
    pub running: Vec<RunningTask>,
    /// Workers connected to the coordinator.
    pub workers: u32,
    /// Results that workers have reported and that the coordinator has not found in their store.
    pub unverified: u64,
}

impl JobStatus {
    /// The deadline that stopped the job, as in its file.
    pub fn passed_deadline(&self) -> Option<&str> {
        let limits = &self.spec.limits;
        let deadline = limits.deadline_ms().ok().flatten()?;
        let passed = self.state == JobState::Cancelled && self.ended_at_ms? >= deadline;
        passed.then_some(&*limits.deadline)
    }
}

/// A job as a list shows it, without what it is made of.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct JobSummary {
    /// Id.
    pub id: JobId,
    /// Name.
    pub name: String,
    /// Who submitted it.
    pub user: String,
    /// Its project; empty = none.
    pub project: String,
    /// State.
    pub state: JobState,
    /// It is held: nothing of it is begun.
    pub paused: bool,
    /// Counts.
    pub tasks: TaskCounts,
    /// Unix time of submission, milliseconds.
    pub submitted_at_ms: i64,
    /// Unix time of the end, milliseconds.
    pub ended_at_ms: Option<i64>,
}

/// What a submission would do.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JobPlan {
    /// SHA-256 of the canonical spec, hexadecimal.
    pub spec_hash: String,
    /// Tasks.
    pub total: u64,
    /// Tasks whose output exists.
    pub reuse: u64,
    /// Tasks whose output lies in the store without a record of it: workers look at each, and take it over. The client counts
    /// them, where it can read the store.
    pub taken: u64,
    /// Tasks that will run.
    pub run: u64,
    /// The job that has this exact spec already.
    pub existing_job: Option<JobId>,
    /// The same by stage, with the reasons.
    pub stages: Vec<StagePlan>,
    /// Settings that are probably not meant, and stages that no connected worker can run; in words.
    pub warnings: Vec<String>,
}

/// An estimated quantity.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// At least.
    pub low: f64,
    /// At most.
    pub high: f64,
}

impl Estimate {
    /// `middle` with an uncertainty of the factor `spread` (at least 1) in both directions.
    pub fn within(middle: f64, spread: f64) -> Self {
        Self {
            low: middle / spread,
            high: middle * spread,
        }
    }

    /// The estimate of a sum of two quantities.
    pub fn plus(self, other: Self) -> Self {
        Self {
            low: self.low + other.low,
            high: self.high + other.high,
        }
    }

    /// The estimate of a multiple of the quantity.
    pub fn times(self, factor: f64) -> Self {
        Self {
            low: self.low * factor,
            high: self.high * factor,
        }
    }
}

/// What a submission would do in a stage.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StagePlan {
    /// Its name.
    pub name: String,
    /// What its tasks do.
    pub kind: String,
    /// Tasks.
    pub total: u64,
    /// Tasks whose output exists.
    pub reuse: u64,
    /// Tasks whose output lies in the store without a record of it: workers look at each, and take it over. The client counts
    /// them, where it can read the store.
    pub taken: u64,
    /// Tasks that will run.
    pub run: u64,
    /// About how much memory each takes; 0 = not known before a worker has seen what it reads.
    pub memory_bytes: u64,
    /// Connected workers that can run its tasks.
    pub workers: u32,
    /// Seconds that one task takes on one of them; `None` = not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_seconds: Option<Estimate>,
    /// Bytes that one task stores; `None` = not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_bytes: Option<Estimate>,
    /// Whether the estimates come from tasks that this farm has run; otherwise they are rules of thumb.
    pub measured: bool,
    /// Why tasks run, in words.
    pub reasons: Vec<String>,
}

/// What happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// Job accepted.
    Submitted,
    /// Range granted to a worker.
    Leased,
    /// Task's output committed.
    Committed,
    /// Task's output was there already.
    Reused,
    /// Task failed and will be tried again.
    Failed,
    /// Task given up.
    Dead,
    /// A lease ran out.
    Expired,
    /// A worker gave a lease back.
    Released,
    /// Job cancelled.
    Cancelled,
    /// Dead tasks made pending again.
    Retried,
    /// Job ended.
    Ended,
    /// Tasks are pending, but no connected worker may run them.
    Waiting,
    /// Something that must not happen did, e.g. two different results of one task.
    Alarm,
    /// A stage's tasks may run: what it needs is done.
    Opened,
    /// Job held by a person.
    Paused,
    /// Job let go on.
    Resumed,
    /// A line that a task logged on its worker.
    Log,
}

/// One line of a job's history.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Event {
    /// Position in the history, growing.
    pub sequence: u64,
    /// Unix time, milliseconds.
    pub at_ms: i64,
    /// The job.
    pub job: JobId,
    /// Position of the stage that it concerns, where it concerns one.
    pub stage: Option<u32>,
    /// What.
    pub kind: EventKind,
    /// Task, where it concerns one.
    pub task: Option<u64>,
    /// First of the tasks it concerns, where it concerns any.
    pub lo: Option<u64>,
    /// One past the last of them.
    pub hi: Option<u64>,
    /// Worker's name, where one is concerned.
    pub worker: String,
    /// In words.
    pub message: String,
    /// Seconds the task took, where it ended.
    pub seconds: f64,
}
