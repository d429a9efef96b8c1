//! What passes between coordinator and worker, checked.

use std::collections::BTreeMap;

use super::{bounds, log::printable};
use crate::{
    ids::{Incarnation, JobId, LeaseRef, WorkerId},
    key::{StageKey, TaskKey},
    model::StageSpec,
};

/// Who a worker says it is at the start of a session.
#[derive(Debug, Clone, PartialEq)]
pub struct WorkerHello {
    /// The worker, across restarts.
    pub id: WorkerId,
    /// This process.
    pub incarnation: Incarnation,
    /// Name, for people (host and process).
    pub name: String,
    /// Program version.
    pub version: String,
    /// Protocol version; see [`crate::PROTOCOL`].
    pub protocol: u32,
    /// Leases it still holds from before a reconnect.
    pub held: Vec<LeaseRef>,
    /// How its process before this one ended, in words, where its parent knows; empty otherwise.
    pub ended: String,
    /// Milliseconds until it must end, where that is known.
    pub ends_in_ms: Option<u64>,
    /// What it is able to do and what it has.
    pub abilities: Abilities,
}

/// What a worker is able to do and what it has.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Abilities {
    /// The kinds of task that it runs, and parts of kinds that not every worker has
    /// ([`TaskSpec::ability`](crate::model::TaskSpec::ability)), each with the version of its code.
    pub kinds: BTreeMap<String, String>,
    /// Fingerprints of the furniture it has.
    pub assets: Vec<String>,
    /// CPU cores it uses.
    pub cores: u32,
    /// Memory in MiB; 0 = not known.
    pub memory_mib: u64,
    /// Graphics processors that it has opened, as they call themselves.
    pub gpus: Vec<String>,
    /// Labels it was given.
    pub labels: Vec<String>,
}

/// A granted lease: tasks `lo ≤ i < hi` less `skip`.
#[derive(Debug, Clone, PartialEq)]
pub struct Lease {
    /// Its name.
    pub lease: LeaseRef,
    /// The job.
    pub job: JobId,
    /// First task.
    pub lo: u64,
    /// One past the last task.
    pub hi: u64,
    /// Tasks of the interval that are not to be run.
    pub skip: Vec<u64>,
    /// Time to live from receipt, milliseconds.
    pub ttl_ms: u32,
    /// The stage; of its lists as much as these tasks need.
    pub stage: StageSpec,
    /// Position of the stage in the job.
    pub ordinal: u32,
    /// The stage's key.
    pub key: StageKey,
    /// Where it belongs in a trace; see [`crate::trace`].
    pub traceparent: String,
}

/// A finished task as the worker reports it.
#[derive(Debug, Clone, PartialEq)]
pub struct Finished {
    /// The lease it ran under.
    pub lease: LeaseRef,
    /// Task index.
    pub index: u64,
    /// Names the result.
    pub key: TaskKey,
    /// SHA-256 of the manifest, hexadecimal.
    pub manifest_sha256: String,
    /// Bytes published.
    pub bytes: u64,
    /// Seconds it took.
    pub seconds: f64,
    /// Found in the store, not computed.
    pub adopted: bool,
    /// Where the task was in a trace; see [`crate::trace`].
    pub traceparent: String,
}

/// Who is to blame for a failure; budgets are separate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FailureKind {
    /// The task's own input or settings.
    User,
    /// The executor panicked, or the worker was lost.
    Crash,
    /// Shutdown, preemption, the machine's trouble: counted by itself.
    Interrupted,
    /// The store cannot be reached or written: free, and all that use it wait.
    Store,
    /// The store answers, but an object in it is damaged or missing: free, and the task waits until it is repaired.
    Damaged,
}

/// A failed task as the worker reports it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// The lease it ran under.
    pub lease: LeaseRef,
    /// Task index.
    pub index: u64,
    /// Whose fault.
    pub kind: FailureKind,
    /// Why, for people.
    pub message: String,
}

/// How far a running task is.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskProgress {
    /// Its lease.
    pub lease: LeaseRef,
    /// Task index.
    pub index: u64,
    /// Share done in [0, 1].
    pub fraction: f32,
    /// What it is at.
    pub at: TaskAt,
}

/// What a running task is at: its own words and figures.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TaskAt {
    /// For people; empty = nothing to say.
    pub text: String,
    /// For programs: loss, samples_per_s, …
    pub figures: BTreeMap<String, f64>,
}

impl TaskAt {
    /// Bytes of the text.
    const TEXT: usize = 256;
    /// Figures.
    const FIGURES: usize = 16;
    /// Bytes of a figure's name.
    const NAME: usize = 32;

    /// As much of it as a message may carry, as it is sent with each heartbeat, in a text that a terminal only shows.
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
