//! Checked messages between coordinator and worker.

use std::collections::BTreeMap;

use super::log::printable;
use crate::{
    ids::{Incarnation, JobId, LeaseRef, WorkerId},
    key::{StageKey, TaskKey},
    spec::{StageSpec, bounds},
};

/// A worker's description of itself at the start of a session.
#[derive(Debug, Clone, PartialEq)]
pub struct WorkerHello {
    /// Id of the worker, the same across restarts.
    pub id: WorkerId,
    /// Id of this process.
    pub incarnation: Incarnation,
    /// Name for display (host and process).
    pub name: String,
    /// Program version.
    pub version: String,
    /// Protocol version; see [`crate::PROTOCOL`].
    pub protocol: u32,
    /// Leases kept from before a reconnect.
    pub held: Vec<LeaseRef>,
    /// Description of how the previous process ended, if its parent knows; otherwise empty.
    pub ended: String,
    /// Milliseconds until the worker must end, if known.
    pub ends_in_ms: Option<u64>,
    /// Abilities of the worker.
    pub abilities: Abilities,
}

/// The abilities and resources of a worker.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Abilities {
    /// The kinds of tasks that the worker runs, and optional parts of kinds
    /// ([`TaskSpec::ability`](crate::spec::TaskSpec::ability)), each with the version of its code.
    pub kinds: BTreeMap<String, String>,
    /// Fingerprints of the installed furniture.
    pub assets: Vec<String>,
    /// CPU cores that the worker uses.
    pub cores: u32,
    /// Memory in MiB; 0 if unknown.
    pub memory_mib: u64,
    /// Names of the GPUs that the worker has opened.
    pub gpus: Vec<String>,
    /// Labels of the worker.
    pub labels: Vec<String>,
}

/// A granted lease: tasks `lo ≤ i < hi` without `skip`.
#[derive(Debug, Clone, PartialEq)]
pub struct Lease {
    /// Reference of the lease.
    pub lease: LeaseRef,
    /// The job.
    pub job: JobId,
    /// First task.
    pub lo: u64,
    /// One past the last task.
    pub hi: u64,
    /// Tasks of the interval that must not run.
    pub skip: Vec<u64>,
    /// Time to live from receipt, milliseconds.
    pub ttl_ms: u32,
    /// The stage, with its lists reduced to these tasks.
    pub stage: StageSpec,
    /// Position of the stage in the job.
    pub ordinal: u32,
    /// Key of the stage.
    pub key: StageKey,
    /// Trace context; see [`crate::trace`].
    pub traceparent: String,
}

/// A worker's report of a finished task.
#[derive(Debug, Clone, PartialEq)]
pub struct Finished {
    /// The lease of the task.
    pub lease: LeaseRef,
    /// Task index.
    pub index: u64,
    /// Key of the result.
    pub key: TaskKey,
    /// SHA-256 of the manifest, hexadecimal.
    pub manifest_sha256: String,
    /// Bytes published.
    pub bytes: u64,
    /// Seconds that the task took.
    pub seconds: f64,
    /// Whether the result was found in the store instead of computed.
    pub adopted: bool,
    /// Trace context of the task; see [`crate::trace`].
    pub traceparent: String,
    /// Number of tasks that shared the worker's cores at its end, itself included; 0 if unknown.
    pub shared: u32,
}

/// The cause of a failure. Each has its own budget.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FailureKind {
    /// The task's own input or settings.
    User,
    /// The executor panicked, or the worker was lost.
    Crash,
    /// Shutdown, preemption, or a fault of the machine. Counted separately.
    Interrupted,
    /// The store cannot be reached or written. Not charged, and all tasks that use the store wait.
    Store,
    /// The store answers, but an object in it is damaged or missing. Not charged, and the task
    /// waits until the object is repaired.
    Damaged,
}

/// A worker's report of a failed task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// The lease of the task.
    pub lease: LeaseRef,
    /// Task index.
    pub index: u64,
    /// Cause of the failure.
    pub kind: FailureKind,
    /// Description of the failure.
    pub message: String,
    /// Duration of the attempt in milliseconds; 0 if unknown.
    pub milliseconds: u64,
    /// Number of tasks that shared the worker's cores, itself included; 0 if unknown.
    pub shared: u32,
}

/// Progress of a running task.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskProgress {
    /// Lease of the task.
    pub lease: LeaseRef,
    /// Task index.
    pub index: u64,
    /// Completed fraction in [0, 1].
    pub fraction: f32,
    /// Current step of the task.
    pub at: TaskAt,
}

/// The current step of a running task, in its own words and figures.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TaskAt {
    /// Text for display; may be empty.
    pub text: String,
    /// Figures for programs: loss, samples_per_s, …
    pub figures: BTreeMap<String, f64>,
}

impl TaskAt {
    /// Longest text, bytes.
    const TEXT: usize = 256;
    /// Most figures.
    const FIGURES: usize = 16;
    /// Longest name of a figure, bytes.
    const NAME: usize = 32;

    /// Returns the part that fits into each heartbeat, with a printable text.
    #[must_use]
    pub fn limited(self) -> Self {
        let figures = self.figures.into_iter();
        let usable = |(name, value): &(String, f64)| {
            bounds::name(name, Self::NAME).is_ok() && value.is_finite()
        };
        Self {
            text: printable(&self.text[..self.text.floor_char_boundary(Self::TEXT)]),
            figures: figures.filter(usable).take(Self::FIGURES).collect(),
        }
    }
}
