//! Data that an instance loads, claims and polls.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_proto::{
    ids::{Incarnation, InstanceId, JobId, RangeId, StageRef, WorkerId},
    messages::JobState,
};

use crate::{
    job::Job,
    range::{Range, Run},
    task::Exception,
};

/// The last known state of a worker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Worker {
    /// The worker's id, which is stable across restarts.
    pub id: WorkerId,
    /// Its last known process.
    pub incarnation: Incarnation,
    /// Name for display.
    pub name: String,
    /// Unix time, milliseconds.
    pub last_seen_ms: i64,
}

/// The state that a new instance loads from the catalog.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// The instance.
    pub instance: InstanceId,
    /// All active jobs, in order of submission.
    pub jobs: Vec<Job>,
    /// The ranges that the instance owns: those of an earlier life of this process, and those of
    /// lost instances.
    pub owned: Owned,
    /// All workers ever seen.
    pub workers: Vec<Worker>,
}

/// Ranges that an instance acquired, with the state needed to continue them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Owned {
    /// The ranges, leased and pending.
    pub ranges: Vec<Range>,
    /// Failures of the tasks in these ranges.
    pub exceptions: Vec<Exception>,
}

/// A request for pending tasks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Want {
    /// The stage.
    pub stage: StageRef,
    /// The number of tasks.
    pub tasks: u64,
    /// Only tasks that may run at this time, in Unix milliseconds.
    pub now_ms: i64,
    /// If set, tasks with existing outputs are run again.
    pub force: bool,
    /// Includes suspected ranges, which are only leased to a worker that runs nothing else.
    pub suspects: bool,
}

/// Unowned pending tasks of an open stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Free {
    /// Tasks that may run at once, on any worker.
    pub ready: u64,
    /// Tasks that may run at once, but alone on a worker, because workers were lost while they ran
    /// them.
    pub suspects: u64,
    /// Tasks that may not run before a given time.
    pub later: u64,
    /// The earliest of these times, in Unix milliseconds.
    pub next_ms: Option<i64>,
}

/// The answer to a [`Want`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Claim {
    /// Pending ranges that the instance now owns.
    pub owned: Owned,
    /// Tasks of these ranges whose outputs already exist, as maximal runs in ascending order.
    pub existing: Vec<Run>,
    /// The tasks that remain unowned.
    pub left: Free,
}

/// State that an instance polls from the catalog.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct News {
    /// The active jobs, and whether each is paused or waits for another job's end.
    pub active: BTreeMap<JobId, bool>,
    /// Number of workers with leases from other instances, by job.
    pub busy: BTreeMap<JobId, u32>,
    /// Ranges that other instances have leased, in stages that share outputs with another stage of
    /// an active job.
    pub shared: BTreeMap<StageRef, Vec<Run>>,
    /// Unowned pending tasks of open stages.
    pub free: BTreeMap<StageRef, Free>,
    /// Ranges taken over from lost instances.
    pub taken: Owned,
    /// The leased ranges that this instance owns; `None` if no other instance could have taken any.
    pub leased: Option<BTreeSet<RangeId>>,
    /// Number of live instances, including this one.
    pub instances: u32,
    /// Number of workers connected to any instance.
    pub workers: u32,
}

/// The effects of a commit on whole stages and jobs.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Settled {
    /// Stages that may now begin.
    pub opened: Vec<StageRef>,
    /// Jobs that have ended.
    pub ends: Vec<JobEnd>,
}

impl Settled {
    /// Adds the effects of another part.
    pub fn join(&mut self, other: Self) {
        self.opened.extend(other.opened);
        self.ends.extend(other.ends);
    }
}

/// A job that has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JobEnd {
    /// The job.
    pub job: JobId,
    /// The final state: done or failed.
    pub state: JobState,
    /// Unix time, milliseconds.
    pub at_ms: i64,
}
