//! The records a catalog keeps, as plain data.

use std::sync::Arc;

use picofarm_proto::{
    ids::{Epoch, Incarnation, JobId, LeaseRef, RangeId, WorkerId},
    key::{StageKey, stage_key},
    model::{EventKind, JobSpec, JobState},
};

/// One submission.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Its id.
    pub id: JobId,
    /// SHA-256 of the canonical spec, hexadecimal.
    pub spec_hash: String,
    /// What was submitted.
    pub spec: Arc<JobSpec>,
    /// Where it stands.
    pub state: JobState,
    /// Unix time of submission, milliseconds.
    pub submitted_ms: i64,
    /// Unix time of the end, milliseconds.
    pub ended_ms: Option<i64>,
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
    /// The set a job's tasks write to.
    pub fn of(spec: &JobSpec) -> Self {
        Self {
            store: spec.output.store.clone(),
            dataset: spec.output.dataset.clone(),
            stage_key: stage_key(spec),
        }
    }
}

/// Tasks `lo ≤ i < hi`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// First task.
    pub lo: u64,
    /// One past the last task.
    pub hi: u64,
}

/// Consecutive tasks of a job in one state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Range {
    /// Its id; with the epoch, the name of a lease.
    pub id: RangeId,
    /// The job.
    pub job: JobId,
    /// First task.
    pub lo: u64,
    /// One past the last task.
    pub hi: u64,
    /// Grows at each grant.
    pub epoch: Epoch,
    /// Workers lost with this range or one it was cut from; such a range is not merged with others, so that
    /// a poison task is cornered by halving.
    pub crashes: u32,
    /// What may happen to it.
    pub state: RangeState,
}

/// The state of a range.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RangeState {
    /// Waits for a worker.
    Pending {
        /// Not granted before this Unix time, milliseconds; 0 = at once.
        not_before_ms: i64,
    },
    /// A worker has it.
    Leased(LeaseState),
    /// Every output is committed.
    Done {
        /// The outputs were there before this job ran the tasks.
        reused: bool,
    },
    /// Given up.
    Dead,
}

/// Who holds a range, until when, and how far it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeaseState {
    /// The worker.
    pub worker: WorkerId,
    /// The process of the worker.
    pub incarnation: Incarnation,
    /// Unix time at which the lease runs out, milliseconds.
    pub until_ms: i64,
    /// One for each task of the range.
    pub marks: Vec<Mark>,
}

/// What became of one task of a leased range.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Mark {
    /// To be run.
    Todo = 0,
    /// Committed, computed under this lease.
    Done = 1,
    /// Committed, found in the store.
    Reused = 2,
    /// Failed under this lease; a range of its own has the task now.
    Left = 3,
}

impl Range {
    /// Number of tasks between `lo` and `hi`.
    pub fn len(&self) -> u64 {
        self.hi - self.lo
    }

    /// Never: a range holds at least one task.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// The lease's name.
    pub fn lease(&self) -> LeaseRef {
        LeaseRef {
            range: self.id,
            epoch: self.epoch,
        }
    }
}

/// A committed result.
#[derive(Debug, Clone, PartialEq)]
pub struct Output {
    /// The job under which it was committed; its result set owns the output.
    pub job: JobId,
    /// Task index.
    pub task: u64,
    /// SHA-256 of the manifest.
    pub manifest: [u8; 32],
    /// Bytes published.
    pub bytes: u64,
    /// Seconds it took.
    pub seconds: f64,
    /// The lease's epoch.
    pub epoch: Epoch,
    /// Found in the store and not computed.
    pub adopted: bool,
}

/// A task that failed at least once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exception {
    /// The job.
    pub job: JobId,
    /// Task index.
    pub task: u64,
    /// Failures of the task's own.
    pub failures: u32,
    /// Workers lost while they ran it.
    pub crashes: u32,
    /// Given up.
    pub dead: bool,
    /// The last failure, in words.
    pub last_error: String,
}

/// A line of history to be written; its sequence number is given by the catalog.
#[derive(Debug, Clone, PartialEq)]
pub struct NewEvent {
    /// Unix time, milliseconds.
    pub at_ms: i64,
    /// The job.
    pub job: JobId,
    /// What.
    pub kind: EventKind,
    /// The tasks concerned, where any are.
    pub tasks: Option<Run>,
    /// Worker's name, where one is concerned.
    pub worker: String,
    /// Seconds the task took, where it ended.
    pub seconds: f64,
    /// In words.
    pub message: String,
}

/// A worker as last seen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Worker {
    /// The worker, across restarts.
    pub id: WorkerId,
    /// Its last known process.
    pub incarnation: Incarnation,
    /// Name, for people.
    pub name: String,
    /// Unix time, milliseconds.
    pub last_seen_ms: i64,
}

/// Computed outputs and the seconds they took together.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Timing {
    /// How many.
    pub tasks: u64,
    /// Sum of their seconds.
    pub seconds: f64,
}

impl Timing {
    /// Mean seconds a task; `None` before the first.
    pub fn mean(&self) -> Option<f64> {
        (self.tasks > 0).then(|| self.seconds / self.tasks as f64)
    }
}

/// Which part of a job's history.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventQuery {
    /// The job.
    pub job: JobId,
    /// Only events after this sequence number.
    pub after: u64,
    /// At most this many.
    pub limit: u32,
    /// Only events that concern this task.
    pub task: Option<u64>,
}

/// All that is live.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    /// Every job, in order of submission.
    pub jobs: Vec<Job>,
    /// Every range.
    pub ranges: Vec<Range>,
    /// Every task that failed.
    pub exceptions: Vec<Exception>,
    /// Every worker ever seen.
    pub workers: Vec<Worker>,
}
