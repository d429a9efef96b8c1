//! The records a catalog keeps, as plain data.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use picofarm_proto::{
    ids::{Epoch, Incarnation, InstanceId, JobId, LeaseRef, RangeId, StageRef, WorkerId},
    key::{StageKey, stage_key},
    model::{EventKind, JobSpec, JobState, StageSpec, StageState, TaskCounts},
};

use crate::rights::Sight;

/// One submission.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Its id.
    pub id: JobId,
    /// What tells whether two submissions are the same job: SHA-256 of the canonical spec, where need be with among whose
    /// jobs an equal one is looked for, hexadecimal.
    pub spec_hash: String,
    /// What was submitted.
    pub spec: Arc<JobSpec>,
    /// Where it stands.
    pub state: JobState,
    /// Unix time of submission, milliseconds.
    pub submitted_ms: i64,
    /// Unix time of the end, milliseconds.
    pub ended_ms: Option<i64>,
    /// It is held: nothing of it is begun.
    pub paused: bool,
    /// Who submitted it.
    pub user: String,
}

/// A stage of a job: its tasks are `0..tasks`.
#[derive(Debug, Clone, PartialEq)]
pub struct StageRecord {
    /// Its name.
    pub id: StageRef,
    /// Positions of the stages that it needs.
    pub needs: Vec<u32>,
    /// It begins although tasks of those were given up.
    pub tolerate_dead: bool,
    /// Outputs that exist do not count.
    pub force: bool,
    /// Where its results go.
    pub set: ResultSet,
    /// Number of tasks.
    pub tasks: u64,
}

impl Job {
    /// The job's stages, in order.
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
                set: ResultSet::of(stage),
                tasks: stage.tasks(),
            })
            .collect()
    }
}

/// A job and how far it is.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRecord {
    /// The job.
    pub job: Job,
    /// Its stages, in order.
    pub stages: Vec<StageCounts>,
    /// How long its tasks took.
    pub timing: Timing,
}

/// Where a stage stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StageCounts {
    /// Whether its tasks may run.
    pub state: StageState,
    /// Its tasks by state, as last committed.
    pub counts: TaskCounts,
}

impl JobRecord {
    /// Tasks of all stages by state.
    pub fn counts(&self) -> TaskCounts {
        let mut counts = TaskCounts::default();
        for stage in &self.stages {
            counts += stage.counts;
        }
        counts
    }
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
    /// The set a stage's tasks write to. What is no data set has a place that none can have.
    pub fn of(stage: &StageSpec) -> Self {
        let results = stage.task.results();
        Self {
            store: results.store.to_owned(),
            dataset: results.folder,
            stage_key: stage_key(stage),
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
    /// The stage.
    pub stage: StageRef,
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

    /// Whether a task waits here or is under way.
    pub fn has_to_do(&self, task: u64) -> bool {
        match &self.state {
            RangeState::Pending { .. } => (self.lo..self.hi).contains(&task),
            RangeState::Leased(lease) => {
                let at = task.checked_sub(self.lo);
                at.and_then(|at| lease.marks.get(usize::try_from(at).ok()?)) == Some(&Mark::Todo)
            }
            RangeState::Done { .. } | RangeState::Dead => false,
        }
    }

    /// Whether it may become one with a neighbour in the same state that may too: never those under suspicion, or
    /// waiting for a time.
    pub fn merges(&self) -> bool {
        self.crashes == 0
            && match self.state {
                RangeState::Pending { not_before_ms } => not_before_ms == 0,
                RangeState::Leased(_) => false,
                RangeState::Done { .. } | RangeState::Dead => true,
            }
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
    /// The stage under which it was committed; its result set owns the output.
    pub stage: StageRef,
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
    /// The stage.
    pub stage: StageRef,
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
    /// Position of the stage concerned, where one is.
    pub stage: Option<u32>,
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

impl NewEvent {
    /// Something about a job as a whole.
    pub fn of(job: JobId, at_ms: i64, kind: EventKind, message: String) -> Self {
        Self {
            at_ms,
            job,
            stage: None,
            kind,
            tasks: None,
            worker: String::new(),
            seconds: 0.0,
            message,
        }
    }

    /// The end of a job.
    pub fn ended(job: JobId, at_ms: i64, counts: &TaskCounts) -> Self {
        let mut message = format!(
            "{} of {} tasks done, {} dead",
            counts.done, counts.total, counts.dead
        );
        if counts.pending > 0 {
            message += &format!(", {} not begun because they need those", counts.pending);
        }
        Self::of(job, at_ms, EventKind::Ended, message)
    }
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

/// What a job's tasks wait for, as far as the catalog knows.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Holdups {
    /// Pending tasks of open stages that may run at once.
    pub ready: u64,
    /// Pending tasks that may not run before a time.
    pub waiting: u64,
    /// The first of these times, Unix milliseconds.
    pub next_ms: Option<i64>,
    /// The tasks that failed most often, a few of them.
    pub failed: Vec<Exception>,
}

/// All that is known of one task.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TaskRecord {
    /// The range that has it; `None` where its job was stopped.
    pub range: Option<Range>,
    /// Its failures.
    pub exception: Option<Exception>,
    /// Its result.
    pub output: Option<Output>,
}

/// Which part of the history.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EventQuery {
    /// The job; `None` = all of them.
    pub job: Option<JobId>,
    /// Only events after this sequence number.
    pub after: u64,
    /// At most this many.
    pub limit: u32,
    /// Only events that concern this task.
    pub task: Option<u64>,
    /// Only events that concern this stage.
    pub stage: Option<u32>,
    /// The last `limit` rather than the first.
    pub newest: bool,
    /// What tasks logged, too.
    pub logs: bool,
    /// Only events of jobs that this reader may see.
    pub sight: Sight,
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
}

/// The answer to a [`Want`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Claim {
    /// Pending ranges that are the instance's now.
    pub owned: Owned,
    /// Tasks of them whose outputs exist already, as maximal runs in ascending order.
    pub existing: Vec<Run>,
    /// Pending tasks that are nobody's still, whether they may run now or later.
    pub left: u64,
}

/// What an instance learns from time to time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct News {
    /// Jobs that are active, and whether they are held.
    pub active: BTreeMap<JobId, bool>,
    /// Workers of other instances that have leases, by job.
    pub busy: BTreeMap<JobId, u32>,
    /// Pending tasks that are nobody's and whose stage is open.
    pub free: BTreeMap<StageRef, u64>,
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
