//! The facts from which explanations follow.

use picofarm_catalog::{Holdups, TaskRecord};
use picofarm_proto::{
    ids::JobId,
    messages::{Event, JobState, RunningTask, StageStatus, TaskCounts},
    spec::Limits,
};

use crate::core::{Candidate, PoolFit, RunningOn};

/// The facts that decide whether a job's tasks run.
#[derive(Debug, Clone, PartialEq)]
pub struct JobFacts {
    /// Id of the job.
    pub job: JobId,
    /// State of the job.
    pub state: JobState,
    /// Whether a user has paused the job.
    pub paused: bool,
    /// Stages of the job.
    pub stages: Vec<StageStatus>,
    /// Task counts of the job.
    pub counts: TaskCounts,
    /// The conditions that the tasks wait for.
    pub holdups: Holdups,
    /// Workers connected to the answering coordinator.
    pub candidates: Vec<Candidate>,
    /// Tasks that workers run for other jobs with the same outputs.
    pub shared: u64,
    /// Tasks that wait for a worker without other leases, because workers were lost while they ran
    /// them.
    pub suspects: u64,
    /// The deadline that stopped the job, as written in the job file.
    pub deadline: Option<String>,
    /// Jobs of higher precedence with tasks waiting for the same workers.
    pub ahead: Vec<JobId>,
    /// Number of further such jobs that the caller may not see.
    pub unseen: u64,
    /// Workers connected to other coordinators.
    pub elsewhere: u32,
    /// Pools of workers that other programs start.
    pub pools: Vec<PoolFit>,
    /// Why the jobs of the user may publish nothing more.
    pub over_bytes: Option<String>,
    /// Currently running tasks.
    pub running: Vec<RunningTask>,
    /// Latest history line that explains an interruption: a failure, a returned task or an expired
    /// lease.
    pub setback: Option<Event>,
    /// Unix time, milliseconds.
    pub now_ms: i64,
}

/// The facts about a task.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskFacts {
    /// Index of the task.
    pub index: u64,
    /// Job of the task.
    pub job: JobId,
    /// The catalog's record.
    pub record: TaskRecord,
    /// History of the task, oldest first.
    pub events: Vec<Event>,
    /// Budgets of the job.
    pub limits: Limits,
    /// The other job that committed the result, if any: its id, name and history line.
    pub elsewhere: Option<(JobId, String, Event)>,
    /// Progress of the task, if a worker has reported on it.
    pub running: Option<RunningOn>,
    /// Unix time, milliseconds.
    pub now_ms: i64,
}
