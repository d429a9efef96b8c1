//! What an instance finds, takes and learns.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_proto::{
    ids::{Incarnation, InstanceId, JobId, RangeId, StageRef, WorkerId},
    model::JobState,
};

use crate::{
    job::Job,
    range::{Range, Run},
    task::Exception,
};

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

/// What an instance finds when its life begins.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// The instance.
    pub instance: InstanceId,
    /// Every active job, in order of submission.
    pub jobs: Vec<Job>,
    /// What the instance owns: ranges left by an earlier life of this process, and by instances that are lost.
    pub owned: Owned,
    /// Every worker ever seen.
    pub workers: Vec<Worker>,
}

/// Ranges that came into an instance's hands, with what it must know to go on with them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Owned {
    /// The ranges, leased and pending.
    pub ranges: Vec<Range>,
    /// Failures of their tasks.
    pub exceptions: Vec<Exception>,
}

/// A wish for pending tasks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Want {
    /// Of which stage.
    pub stage: StageRef,
    /// How many tasks.
    pub tasks: u64,
    /// Only tasks that may run at this time, Unix milliseconds.
    pub now_ms: i64,
    /// Outputs that exist are not asked for.
    pub force: bool,
    /// Ranges under suspicion too, which go only to a worker with nothing else in hand.
    pub suspects: bool,
}

/// Pending tasks of an open stage that are nobody's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Free {
    /// That may run at once, on any worker.
    pub ready: u64,
    /// That may run at once, alone on a worker: workers were lost while they ran them.
    pub suspects: u64,
    /// That may not run before a time.
    pub later: u64,
    /// The first of these times, Unix milliseconds.
    pub next_ms: Option<i64>,
}

/// The answer to a [`Want`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Claim {
    /// Pending ranges that are the instance's now.
    pub owned: Owned,
    /// Tasks of them whose outputs exist already, as maximal runs in ascending order.
    pub existing: Vec<Run>,
    /// The tasks that are still nobody's.
    pub left: Free,
}

/// What an instance learns from time to time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct News {
    /// Jobs that are active, and whether they are held.
    pub active: BTreeMap<JobId, bool>,
    /// Workers of other instances that have leases, by job.
    pub busy: BTreeMap<JobId, u32>,
    /// Leased ranges of other instances, of stages whose outputs another stage of an active job has, too.
    pub shared: BTreeMap<StageRef, Vec<Run>>,
    /// Pending tasks that are nobody's and whose stage is open.
    pub free: BTreeMap<StageRef, Free>,
    /// Ranges of instances that were lost.
    pub taken: Owned,
    /// The leased ranges that are this instance's; `None` where nobody could have taken any.
    pub leased: Option<BTreeSet<RangeId>>,
    /// Instances alive, this one too.
    pub instances: u32,
    /// Workers connected to any of them.
    pub workers: u32,
}

/// What came of a commit for whole stages and jobs.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Settled {
    /// Stages that may begin.
    pub opened: Vec<StageRef>,
    /// Jobs that have ended.
    pub ends: Vec<JobEnd>,
}

impl Settled {
    /// Adds what came of another part.
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
    /// Done or failed.
    pub state: JobState,
    /// Unix time, milliseconds.
    pub at_ms: i64,
}
