//! The coordinator's state in memory, with synchronous methods and no I/O. Times and ids are
//! arguments. Each method records the changes that must become durable ([`Changes`]) and the
//! messages to send afterwards ([`Say`]).
//!
//! The state contains the active jobs, the ranges leased to workers that are connected or may
//! reconnect, and the pending ranges claimed for them. The catalog has everything else.

mod blocklist;
mod claims;
mod commit;
mod dispatch;
mod doubt;
mod ends;
mod facts;
mod failures;
mod fits;
mod jobs;
mod leases;
mod load;
mod log;
mod ready;
mod refused;
mod sessions;
mod shared;
mod sick;
mod stores;
mod tail;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet, HashMap};

use picofarm_catalog::{
    Changes, Exception, Free, Job, NewEvent, ResultSet, Run, Settled, Snapshot, StageRecord, Timing,
};
use picofarm_proto::{
    ids::{Incarnation, JobId, LeaseRef, RangeId, StageRef, WorkerId},
    key::StageKey,
    model::{Abilities, EventKind, Lease, LogAllowance, StageSpec, TaskAt, memory::Known},
};
use uuid::Uuid;

use crate::{budget::Backoff, place, stage::Stage};
use blocklist::Blocklist;
use load::Load;
use tail::Double;

pub(crate) use commit::OutputHint;
pub(crate) use doubt::Reported;
pub(crate) use facts::{JobLook, Look};
pub(crate) use fits::{Fit, Fits};
pub(crate) use jobs::{
    Learnt, Listed, Overlay, Prepared, Timings, made_of_another, may_force, place_is_free, prepare,
    recorded_status, stands_for,
};

/// Generates UUIDs. It is an argument so that the core is deterministic.
pub(crate) type MakeId = Box<dyn FnMut() -> Uuid + Send + Sync>;

/// Number of a session, unique in this process.
pub(crate) type SessionId = u64;

/// The core's time limits.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Settings {
    /// Duration of a lease, milliseconds.
    pub lease_ms: u32,
    /// Time in which a disconnected worker may reconnect before its leases go to others,
    /// milliseconds.
    pub reconnect_ms: u32,
    /// Delays after failures.
    pub backoff: Backoff,
    /// The rest of a lease is shared with an idle worker if it takes at least this long,
    /// milliseconds.
    pub worth_ms: u32,
    /// Shortest run time after which an idle worker runs a task a second time, milliseconds. The
    /// task must also have taken three times the mean of its stage.
    pub slow_ms: u32,
}

/// A message to a worker, sent once the changes are durable.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Say {
    Lease(Box<Lease>),
    Acknowledge {
        lease: LeaseRef,
        index: u64,
        accepted: bool,
        reason: String,
    },
    Renewed {
        leases: Vec<LeaseRef>,
        ttl_ms: u32,
    },
    Revoke {
        lease: LeaseRef,
        reason: String,
    },
    /// Tasks of this lease from `hi` on now belong to another worker.
    Trim {
        lease: LeaseRef,
        hi: u64,
    },
    /// Finish the current tasks, then end.
    Drain,
    /// The session ends because a newer one has replaced it.
    Replaced,
}

struct StageEntry {
    /// The job of the stage.
    job: Job,
    /// Properties of the job's inputs.
    known: Known,
    set: usize,
    stage: Stage,
    /// Exceptional state of tasks that this coordinator has leased at least once.
    exceptions: BTreeMap<u64, Exception>,
    /// The longest interrupted attempt among these tasks, milliseconds.
    longest_ms: u64,
    /// Unclaimed pending tasks, as last reported by the catalog; `None` if the catalog must be
    /// asked.
    free: Option<Free>,
    /// The catalog is not asked for tasks before this time, because it had none a moment ago.
    ask_at_ms: i64,
    /// The last reported reason why no connected worker may run the stage.
    waiting: Option<String>,
    /// Workers on which tasks of the stage failed.
    blocklist: Blocklist,
    /// Deadline of the job, Unix milliseconds.
    deadline_ms: Option<i64>,
}

impl StageEntry {
    fn spec(&self, id: StageRef) -> &StageSpec {
        &self.job.spec.stages[id.stage as usize]
    }

    /// Records the failures of a task.
    fn note(&mut self, exception: Exception) {
        self.longest_ms = self.longest_ms.max(exception.longest_ms);
        self.exceptions.insert(exception.task, exception);
    }

    /// Checks whether a worker has everything that the stage's tasks need.
    ///
    /// # Errors
    /// Returns the reason why the worker does not qualify.
    fn suits(&self, id: StageRef, worker: &Abilities) -> Result<(), String> {
        place::may_run(self.spec(id), &self.known, worker)
    }
}

/// A set of outputs shared by stages of one or several jobs.
struct SetEntry {
    key: StageKey,
    timing: Timing,
    /// Stages of active jobs that write to this set.
    stages: BTreeSet<StageRef>,
}

struct WorkerEntry {
    session: SessionId,
    incarnation: Incarnation,
    name: String,
    version: String,
    /// Time at which the session began, Unix milliseconds.
    since_ms: i64,
    /// Time of its last message, Unix milliseconds.
    heard_ms: i64,
    /// Time at which it must end, if known, Unix milliseconds.
    ends_ms: Option<i64>,
    abilities: Abilities,
    credits: u32,
    leases: BTreeSet<RangeId>,
    /// Whether it runs a range under suspicion, and therefore gets nothing else.
    quarantined: bool,
    /// Whether it was asked to end, and therefore gets nothing more.
    drains: bool,
}

impl WorkerEntry {
    /// Returns whether the worker may be given leases now.
    fn hungry(&self) -> bool {
        self.credits > 0 && !self.quarantined && !self.drains
    }
}

#[derive(Debug, Clone)]
struct Progress {
    fraction: f32,
    /// The first reported progress, which is the progress saved by an earlier attempt.
    first: Option<f32>,
    /// The current step of the task, in the worker's words.
    at: TaskAt,
    since_ms: i64,
    /// Remaining allowance of log lines that the worker may send for this task.
    log: LogAllowance,
}

impl Progress {
    /// Creates the progress of a task that has just begun.
    fn since(since_ms: i64) -> Self {
        Self {
            fraction: 0.0,
            first: None,
            at: TaskAt::default(),
            since_ms,
            log: LogAllowance::default(),
        }
    }
}

pub(crate) struct Core {
    settings: Settings,
    make_id: MakeId,
    /// Stages of active jobs. Job ids grow with time, so this is the order of submission.
    stages: BTreeMap<StageRef, StageEntry>,
    sets: Vec<SetEntry>,
    set_ids: HashMap<ResultSet, usize>,
    /// Connected workers.
    workers: BTreeMap<WorkerId, WorkerEntry>,
    sessions: HashMap<SessionId, WorkerId>,
    /// Names of all workers that have ever connected.
    names: HashMap<WorkerId, String>,
    /// The stage of each leased range.
    leases: BTreeMap<RangeId, StageRef>,
    /// Which workers run which job.
    load: Load,
    /// Tasks that run a second time, by the lease of the second run.
    doubles: BTreeMap<RangeId, Double>,
    /// Next time at which idle workers are given parts of other leases.
    help_at_ms: i64,
    /// Unavailable stores for which tasks wait.
    away: stores::Stores,
    /// Workers that are not trusted, and doubtful results.
    doubts: doubt::Doubts,
    /// Workers on which every task fails.
    sick: sick::Sick,
    /// Connections that break before this time are blamed on a stall of the coordinator, Unix
    /// milliseconds.
    graced_until_ms: i64,
    /// The charges against each disconnected worker, which are refunded if it reconnects.
    charged: HashMap<WorkerId, (Incarnation, Vec<(StageRef, u64)>)>,
    /// Last reported progress of running tasks, by lease.
    progress: BTreeMap<RangeId, BTreeMap<u64, Progress>>,
    /// Live instances, including this one.
    instances: u32,
    /// Workers connected to other instances.
    elsewhere: u32,
    /// Tasks that other instances' workers were last reported to run, for stages that share
    /// outputs.
    shared_elsewhere: BTreeMap<StageRef, Vec<Run>>,
    /// Outputs in `changes`, by set and task.
    fresh: HashMap<(usize, u64), [u8; 32]>,
    changes: Changes,
    say: Vec<(SessionId, Say)>,
}

impl Core {
    /// Restores the state from the catalog. Live leases get a new period, so that workers that
    /// reconnect keep them. `timing` contains the known timing of each result set of an active job.
    pub(crate) fn load(
        snapshot: Snapshot,
        timing: &HashMap<ResultSet, Timing>,
        settings: Settings,
        make_id: MakeId,
        now_ms: i64,
    ) -> Self {
        let mut core = Self {
            settings,
            make_id,
            stages: BTreeMap::new(),
            sets: Vec::new(),
            set_ids: HashMap::new(),
            workers: BTreeMap::new(),
            sessions: HashMap::new(),
            names: snapshot
                .workers
                .into_iter()
                .map(|w| (w.id, w.name))
                .collect(),
            leases: BTreeMap::new(),
            load: Load::default(),
            doubles: BTreeMap::new(),
            help_at_ms: 0,
            away: stores::Stores::default(),
            doubts: doubt::Doubts::default(),
            sick: sick::Sick::default(),
            graced_until_ms: 0,
            charged: HashMap::new(),
            progress: BTreeMap::new(),
            instances: 1,
            elsewhere: 0,
            shared_elsewhere: BTreeMap::new(),
            fresh: HashMap::new(),
            changes: Changes::default(),
            say: Vec::new(),
        };
        for job in snapshot.jobs {
            core.add_job(&job, job.stages(), timing);
        }
        core.receive(snapshot.owned, now_ms);
        core
    }

    /// Returns whether a job is known to be active.
    pub(crate) fn knows(&self, job: JobId) -> bool {
        self.stages.contains_key(&StageRef { job, stage: 0 })
    }

    /// Adds an active job with its stages.
    pub(crate) fn add_job(
        &mut self,
        job: &Job,
        stages: Vec<StageRecord>,
        timing: &HashMap<ResultSet, Timing>,
    ) {
        for record in stages {
            let next = self.sets.len();
            let key = record.set.stage_key;
            let timing = timing.get(&record.set).copied().unwrap_or_default();
            let set = *self.set_ids.entry(record.set).or_insert(next);
            if set == next {
                let stages = BTreeSet::new();
                self.sets.push(SetEntry {
                    key,
                    timing,
                    stages,
                });
            }
            self.sets[set].stages.insert(record.id);
            self.stages.insert(
                record.id,
                StageEntry {
                    job: job.clone(),
                    known: job.spec.known(record.id.stage as usize),
                    set,
                    stage: Stage::default(),
                    exceptions: BTreeMap::new(),
                    longest_ms: 0,
                    free: None,
                    ask_at_ms: 0,
                    waiting: None,
                    blocklist: Blocklist::default(),
                    deadline_ms: job.spec.limits.deadline_ms().ok().flatten(),
                },
            );
        }
    }

    /// Opens stages that may begin and removes jobs that have ended.
    pub(crate) fn settled(&mut self, settled: &Settled) {
        for id in &settled.opened {
            if let Some(entry) = self.stages.get_mut(id) {
                entry.free = None;
                entry.ask_at_ms = 0;
            }
        }
        for end in &settled.ends {
            tracing::info!(job = %end.job, state = ?end.state, "job ended");
            let ended = self.stages.extract_if(.., |id, _| id.job == end.job);
            for (id, entry) in ended {
                self.sets[entry.set].stages.remove(&id);
            }
        }
    }

    /// Returns the changes to commit, and the messages to send after the commit.
    pub(crate) fn take(&mut self) -> (Changes, Vec<(SessionId, Say)>) {
        self.fresh.clear();
        (
            std::mem::take(&mut self.changes),
            std::mem::take(&mut self.say),
        )
    }

    /// Extends every lease by one period from now. Used after a stall of the coordinator, because
    /// no worker is at fault then.
    pub(crate) fn grace(&mut self, now_ms: i64) {
        for range in self.leases.keys().copied().collect::<Vec<_>>() {
            self.renew(range, now_ms);
        }
        self.graced_until_ms = now_ms + i64::from(self.settings.lease_ms);
    }

    fn name_of(&self, worker: WorkerId) -> String {
        self.names
            .get(&worker)
            .cloned()
            .unwrap_or_else(|| worker.to_string())
    }

    /// Adds a line of history. Adjacent tasks that a worker finished in one batch share a line.
    fn event(&mut self, at_ms: i64, stage: StageRef, kind: EventKind, about: About) {
        if let (Some(last), Some(tasks)) = (self.changes.events.last_mut(), about.tasks)
            && matches!(kind, EventKind::Committed | EventKind::Reused)
            && (last.kind, last.job, last.stage) == (kind, stage.job, Some(stage.stage))
            && last.worker == about.worker
            && last.message == about.message
            && let Some(before) = last.tasks.as_mut().filter(|t| t.hi == tasks.lo)
        {
            before.hi = tasks.hi;
            last.seconds += about.seconds;
            return;
        }
        self.changes.events.push(NewEvent {
            at_ms,
            job: stage.job,
            stage: Some(stage.stage),
            kind,
            tasks: about.tasks,
            worker: about.worker,
            seconds: about.seconds,
            message: about.message,
        });
    }

    /// Marks a stage as possibly finished if none of its tasks is held by this instance.
    fn perhaps_over(&mut self, stage: StageRef, now_ms: i64) {
        let empty = self.stages.get(&stage).is_none_or(|e| e.stage.is_empty());
        if empty {
            self.changes.perhaps_over.insert(stage, now_ms);
        }
    }

    fn range_id(make_id: &mut MakeId) -> impl FnMut() -> RangeId + '_ {
        || RangeId::from_uuid(make_id())
    }
}

/// The optional part of an event.
#[derive(Default)]
struct About {
    tasks: Option<Run>,
    worker: String,
    seconds: f64,
    message: String,
}

impl About {
    fn message(message: impl Into<String>) -> Self {
        Self {
            message: message.into(),
            ..Self::default()
        }
    }

    fn tasks(mut self, lo: u64, hi: u64) -> Self {
        self.tasks = Some(Run { lo, hi });
        self
    }

    fn task(self, task: u64) -> Self {
        self.tasks(task, task + 1)
    }

    fn worker(mut self, name: impl Into<String>) -> Self {
        self.worker = name.into();
        self
    }

    fn seconds(mut self, seconds: f64) -> Self {
        self.seconds = seconds;
        self
    }
}
