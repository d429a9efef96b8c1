//! What the pages ask of a coordinator. The program implements it with its client, and tests with a
//! farm in memory.

use async_trait::async_trait;
use picofarm_proto::{
    ids::JobId,
    messages::{
        AuditEntry, ConnectedWorker, Event, JobState, JobStatus, JobSummary, Reason,
        TaskExplanation,
    },
    spec::JobSpec,
};

/// Why the coordinator gave no answer.
#[derive(Debug, Clone)]
pub struct Refusal {
    /// The kind of reason.
    pub kind: Refused,
    /// What happened.
    pub message: String,
    /// What the user can do.
    pub hint: Option<String>,
}

/// The kinds of reasons for which a coordinator gives no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refused {
    /// It cannot be reached, or its catalog cannot.
    Away,
    /// The caller's rights do not suffice.
    Denied,
    /// It has no such job, stage or task.
    Missing,
    /// The state of the job does not allow the action.
    NotNow,
    /// The request is wrong.
    Input,
    /// Something else failed.
    Failed,
}

/// Selects jobs of the list.
#[derive(Debug, Clone, Default)]
pub struct JobFilter {
    /// Only jobs in this state.
    pub state: Option<JobState>,
    /// Only jobs of this user; empty = all.
    pub user: String,
    /// Only jobs with this name, or with an id that begins with it; empty = all.
    pub find: String,
    /// Start of the page, as returned with the previous page; empty = the newest job.
    pub page: String,
    /// Maximum number of jobs.
    pub limit: u32,
}

/// Selects events.
#[derive(Debug, Clone, Copy, Default)]
pub struct Events {
    /// Only those of this job.
    pub job: Option<JobId>,
    /// Only those after this sequence number.
    pub after: u64,
    /// Maximum number, at most 1000.
    pub limit: u32,
    /// Selects the last ones instead of the first.
    pub newest: bool,
    /// Includes the logs of tasks.
    pub logs: bool,
}

/// The workers of a coordinator.
#[derive(Debug, Clone, Default)]
pub struct Workers {
    /// Name of the process that answered.
    pub coordinator: String,
    /// Its workers.
    pub workers: Vec<ConnectedWorker>,
    /// Number of workers of other coordinators of the same catalog.
    pub elsewhere: u32,
}

/// A job and why it stands so.
#[derive(Debug, Clone)]
pub struct Explained {
    /// The job.
    pub job: JobStatus,
    /// Why its tasks do not run, or what they do instead.
    pub reasons: Vec<Reason>,
    /// The task that was asked for.
    pub task: Option<TaskExplanation>,
    /// Whether the user's rights suffice to cancel, pause, resume and retry the job.
    pub may_change: bool,
}

/// A coordinator, asked with the rights of the user who started the server. All methods fail if it
/// cannot be reached, refuses, or knows no such job.
#[async_trait]
pub trait Farm: Send + Sync {
    /// Returns the coordinator's URL.
    fn url(&self) -> String;
    /// Returns a page of the list of jobs, newest first, and the start of the next page.
    async fn jobs(&self, filter: &JobFilter) -> Result<(Vec<JobSummary>, Option<String>), Refusal>;
    /// Returns a job as it was submitted.
    async fn spec(&self, job: JobId) -> Result<JobSpec, Refusal>;
    /// Returns events, oldest first.
    async fn events(&self, ask: Events) -> Result<Vec<Event>, Refusal>;
    /// Returns a job and explains its state, or that of a task, given by the position of its stage
    /// and its index.
    async fn explain(&self, job: JobId, task: Option<(u32, u64)>) -> Result<Explained, Refusal>;
    /// Returns the connected workers.
    async fn workers(&self) -> Result<Workers, Refusal>;
    /// Returns the newest entries of the audit log.
    async fn audit(&self, before: Option<u64>, limit: u32) -> Result<Vec<AuditEntry>, Refusal>;
    /// Cancels a job.
    async fn cancel(&self, job: JobId) -> Result<(), Refusal>;
    /// Pauses or resumes a job.
    async fn pause(&self, job: JobId, paused: bool) -> Result<(), Refusal>;
    /// Makes a job's dead tasks pending again.
    async fn retry(&self, job: JobId) -> Result<(), Refusal>;
}
