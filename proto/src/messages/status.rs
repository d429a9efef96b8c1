//! Reports on jobs for users. Every count is derived from ranges and outputs.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::{ids::JobId, spec::JobSpec};

/// The state of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Tasks are pending or running.
    Active,
    /// Every task is done.
    Done,
    /// Every task is done or dead, and at least one is dead.
    Failed,
    /// Stopped by a user. Results of finished tasks stay.
    Cancelled,
}

/// Tasks of a job by state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct TaskCounts {
    /// All tasks.
    pub total: u64,
    /// Tasks with a committed output.
    pub done: u64,
    /// Part of `done` with an output that existed before this job ran the task.
    pub reused: u64,
    /// Unfinished tasks in a live lease.
    pub leased: u64,
    /// Waiting tasks.
    pub pending: u64,
    /// Given-up tasks.
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

/// The state of a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum StageState {
    /// The stage waits for others.
    Blocked,
    /// Its tasks may run.
    Open,
    /// Every task is done.
    Done,
    /// Every task is done or dead, and at least one is dead.
    Failed,
}

/// A stage as shown to users.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageStatus {
    /// Name.
    pub name: String,
    /// Kind of its tasks.
    pub kind: String,
    /// State.
    pub state: StageState,
    /// The stages that it needs.
    pub needs: Vec<String>,
    /// Counts.
    pub tasks: TaskCounts,
}

/// A running task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunningTask {
    /// Position of its stage in the job.
    pub stage: u32,
    /// Task index.
    pub index: u64,
    /// Name of the worker.
    pub worker: String,
    /// Completed fraction in [0, 1].
    pub fraction: f32,
    /// Seconds since the worker began it.
    pub seconds: f64,
    /// Its current step in its own words.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub text: String,
    /// Its figures: loss, samples_per_s, …
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub figures: BTreeMap<String, f64>,
}

/// A job as shown to users.
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
    /// Whether the job is paused, so that no further task begins.
    pub paused: bool,
    /// The submitter.
    pub user: String,
    /// Its stages, in order.
    pub stages: Vec<StageStatus>,
    /// The job, without lists of files.
    pub spec: JobSpec,
    /// Mean seconds of a computed task on one worker, for the running stage; `None` before the
    /// first.
    pub mean_task_seconds: Option<f64>,
    /// Running tasks.
    pub running: Vec<RunningTask>,
    /// Workers connected to the coordinator.
    pub workers: u32,
    /// Reported results that the coordinator has not found in their store.
    pub unverified: u64,
}

impl JobStatus {
    /// Returns the deadline that stopped the job, as written in the job file.
    pub fn passed_deadline(&self) -> Option<&str> {
        let limits = &self.spec.limits;
        let deadline = limits.deadline_ms().ok().flatten()?;
        let passed = self.state == JobState::Cancelled && self.ended_at_ms? >= deadline;
        passed.then_some(&*limits.deadline)
    }
}

/// A job as shown in a list, without its content.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct JobSummary {
    /// Id.
    pub id: JobId,
    /// Number, which counts the jobs of a farm from 1.
    pub number: u64,
    /// Name.
    pub name: String,
    /// The submitter.
    pub user: String,
    /// Its project; empty means none.
    pub project: String,
    /// State.
    pub state: JobState,
    /// Whether the job is paused, so that no further task begins.
    pub paused: bool,
    /// Counts.
    pub tasks: TaskCounts,
    /// Unix time of submission, milliseconds.
    pub submitted_at_ms: i64,
    /// Unix time of the end, milliseconds.
    pub ended_at_ms: Option<i64>,
    /// Seconds until its open stages are done, at the pace of its workers, if known.
    pub left_s: Option<u64>,
}

/// The effect of a submission.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JobPlan {
    /// SHA-256 of the canonical spec, hexadecimal.
    pub spec_hash: String,
    /// Number of tasks.
    pub total: u64,
    /// Tasks with an existing output.
    pub reuse: u64,
    /// Tasks whose output is in the store without a record: workers look at each, and take
    /// it over. The client counts them, where it can read the store.
    pub taken: u64,
    /// Tasks that will run.
    pub run: u64,
    /// The job that already has this exact spec.
    pub existing_job: Option<JobId>,
    /// The effect on each stage, with reasons.
    pub stages: Vec<StagePlan>,
    /// Settings that are probably mistakes, and stages that no connected worker can run, in words.
    pub warnings: Vec<String>,
}

/// An estimated quantity.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// Lower bound.
    pub low: f64,
    /// Upper bound.
    pub high: f64,
}

impl Estimate {
    /// Creates an estimate around `middle` with an uncertainty of the factor `spread` (at least 1)
    /// in both directions.
    pub fn within(middle: f64, spread: f64) -> Self {
        Self {
            low: middle / spread,
            high: middle * spread,
        }
    }

    /// Returns the estimate of the sum of two quantities.
    pub fn plus(self, other: Self) -> Self {
        Self {
            low: self.low + other.low,
            high: self.high + other.high,
        }
    }

    /// Returns the estimate of a multiple of the quantity.
    pub fn times(self, factor: f64) -> Self {
        Self {
            low: self.low * factor,
            high: self.high * factor,
        }
    }
}

/// The effect of a submission on a stage.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StagePlan {
    /// Name of the stage.
    pub name: String,
    /// Kind of its tasks.
    pub kind: String,
    /// Number of tasks.
    pub total: u64,
    /// Tasks with an existing output.
    pub reuse: u64,
    /// Tasks whose output is in the store without a record: workers look at each, and take
    /// it over. The client counts them, where it can read the store.
    pub taken: u64,
    /// Tasks that will run.
    pub run: u64,
    /// Approximate memory of each task, bytes; 0 if unknown until a worker has read the inputs.
    pub memory_bytes: u64,
    /// Connected workers that can run its tasks.
    pub workers: u32,
    /// Seconds of one task on one worker; `None` if unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_seconds: Option<Estimate>,
    /// Bytes that one task stores; `None` if unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_bytes: Option<Estimate>,
    /// Whether the estimates come from tasks that this farm has run; otherwise they are rules of
    /// thumb.
    pub measured: bool,
    /// The reasons why tasks run, in words.
    pub reasons: Vec<String>,
}

/// The kind of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// The job was accepted.
    Submitted,
    /// A range was granted to a worker.
    Leased,
    /// A task's output was committed.
    Committed,
    /// A task's output existed already.
    Reused,
    /// A task failed and will run again.
    Failed,
    /// A task was given up.
    Dead,
    /// A lease ran out.
    Expired,
    /// A worker returned a lease.
    Released,
    /// The job was cancelled.
    Cancelled,
    /// Dead tasks became pending again.
    Retried,
    /// The job ended.
    Ended,
    /// Tasks are pending, but no connected worker may run them.
    Waiting,
    /// An error that must not happen, e.g. two different results of one task.
    Alarm,
    /// A stage's tasks may run, because the stages that it needs are done.
    Opened,
    /// A user paused the job.
    Paused,
    /// A user resumed the job.
    Resumed,
    /// A line that a task logged on its worker.
    Log,
}

/// One line of a job's history.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Event {
    /// Position in the history, ascending.
    pub sequence: u64,
    /// Unix time, milliseconds.
    pub at_ms: i64,
    /// The job.
    pub job: JobId,
    /// Position of the stage concerned, if any.
    pub stage: Option<u32>,
    /// Kind of the event.
    pub kind: EventKind,
    /// Task concerned, if any.
    pub task: Option<u64>,
    /// First of the tasks concerned, if any.
    pub lo: Option<u64>,
    /// One past the last of them.
    pub hi: Option<u64>,
    /// Name of the worker concerned, if any.
    pub worker: String,
    /// Description.
    pub message: String,
    /// Seconds that the task took, if it ended.
    pub seconds: f64,
}
