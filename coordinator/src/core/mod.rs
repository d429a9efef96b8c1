//! The coordinator's state: what this instance has in hand, synchronous methods over it, no I/O. Time and ids are
//! passed in. Each method notes what must become durable ([`Changes`]) and what to say afterwards ([`Say`]).
//!
//! In hand are the active jobs, the ranges leased to connected workers (or to those that may come back), and the pending
//! ranges claimed for them. Everything else is the catalog's.

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

/// Makes UUIDs; passed in, so that the core is deterministic.
pub(crate) type MakeId = Box<dyn FnMut() -> Uuid + Send + Sync>;

/// Number of a session, unique in this process.
pub(crate) type SessionId = u64;

/// Times of the core.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Settings {
    /// Life of a lease, milliseconds.
    pub lease_ms: u32,
    /// How long a worker whose connection broke may take to come back before its leases are others', milliseconds.
    pub reconnect_ms: u32,
    /// Waiting times after failures.
    pub backoff: Backoff,
    /// What is left of a lease is shared with an idle worker if it takes at least so long, milliseconds.
    pub worth_ms: u32,
    /// A task is run a second time by an idle worker when it has taken three times as long as its like, and at least so
    /// long, milliseconds.
    pub slow_ms: u32,
}

/// Something to tell a worker once the changes are durable.
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
    /// Of this lease, tasks from `hi` on are another's.
    Trim {
        lease: LeaseRef,
        hi: u64,
    },
    /// Finish what is in hand, and end.
    Drain,
    /// The session ends; a newer one has taken its place.
    Replaced,
}

struct StageEntry {
    /// The stage's job.
    job: Job,
    /// What the job tells of what its tasks read.
    known: Known,
    set: usize,
    stage: Stage,
    /// Of tasks that were ever in hand.
    exceptions: BTreeMap<u64, Exception>,
    /// Of these the longest attempt that did not end, milliseconds.
    longest_ms: u64,
    /// Pending tasks that are nobody's, as last heard; `None` = ask.
    free: Option<Free>,
    /// The catalog is not asked for tasks before this time: it had none to give just now.
    ask_at_ms: i64,
    /// Why no connected worker may run it, as last reported.
    waiting: Option<String>,
    /// The workers on which its tasks failed.
    blocklist: Blocklist,
    /// When its job is given up, Unix milliseconds.
    deadline_ms: Option<i64>,
}

impl StageEntry {
    fn spec(&self, id: StageRef) -> &StageSpec {
        &self.job.spec.stages[id.stage as usize]
    }

    /// Takes note of a task's failures.
    fn note(&mut self, exception: Exception) {
        self.longest_ms = self.longest_ms.max(exception.longest_ms);
        self.exceptions.insert(exception.task, exception);
    }

    /// Whether a worker has what its tasks need.
    ///
    /// # Errors
    /// Why not, in words.
    fn suits(&self, id: StageRef, worker: &Abilities) -> Result<(), String> {
        place::may_run(self.spec(id), &self.known, worker)
    }
}

/// Outputs that stages of one job or of several share.
struct SetEntry {
    key: StageKey,
    timing: Timing,
    /// The stages of active jobs that have them.
    stages: BTreeSet<StageRef>,
}

struct WorkerEntry {
    session: SessionId,
    incarnation: Incarnation,
    name: String,
    version: String,
    /// When its session began.
    since_ms: i64,
    /// When it was last heard of.
    heard_ms: i64,
    /// When it must end, where that is known.
    ends_ms: Option<i64>,
    abilities: Abilities,
    credits: u32,
    leases: BTreeSet<RangeId>,
    /// It holds a range under suspicion and gets nothing else.
    quarantined: bool,
    /// It has been asked to end, and gets nothing more.
    drains: bool,
}

impl WorkerEntry {
    /// Whether it may be given leases now.
    fn hungry(&self) -> bool {
        self.credits > 0 && !self.quarantined && !self.drains
    }
}

#[derive(Debug, Clone)]
struct Progress {
    fraction: f32,
    /// As first reported: that of what was saved by an earlier attempt.
    first: Option<f32>,
    /// What it is at, in its worker's words.
    at: TaskAt,
    since_ms: i64,
    /// What its worker may still say in its name.
    log: LogAllowance,
}

impl Progress {
    /// Of a task that has just begun.
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
    /// Stages of active jobs; ids of jobs grow with time, so this is the order of submission.
    stages: BTreeMap<StageRef, StageEntry>,
    sets: Vec<SetEntry>,
    set_ids: HashMap<ResultSet, usize>,
    /// Connected workers.
    workers: BTreeMap<WorkerId, WorkerEntry>,
    sessions: HashMap<SessionId, WorkerId>,
    /// Names of all workers ever seen.
    names: HashMap<WorkerId, String>,
    /// The stage of each leased range.
    leases: BTreeMap<RangeId, StageRef>,
    /// Who works on which job.
    load: Load,
    /// Tasks that run a second time, by the lease of that.
    doubles: BTreeMap<RangeId, Double>,
    /// When idle workers are looked after next.
    help_at_ms: i64,
    /// Stores that tasks wait for.
    away: stores::Stores,
    /// Workers that are not believed, and doubtful results.
    doubts: doubt::Doubts,
    /// Workers on which nothing goes well.
    sick: sick::Sick,
    /// Connections that break before this time, Unix milliseconds, broke by a stall of the coordinator's own.
    graced_until_ms: i64,
    /// What workers were charged with when their connection broke, for the case that they live.
    charged: HashMap<WorkerId, (Incarnation, Vec<(StageRef, u64)>)>,
    /// Tasks in hand, by lease, as last reported.
    progress: BTreeMap<RangeId, BTreeMap<u64, Progress>>,
    /// Instances alive, this one too.
    instances: u32,
    /// Workers connected to other instances.
    elsewhere: u32,
    /// What these workers had in hand when last heard, of stages whose outputs another stage has, too.
    shared_elsewhere: BTreeMap<StageRef, Vec<Run>>,
    /// Outputs of `changes`, by set and task.
    fresh: HashMap<(usize, u64), [u8; 32]>,
    changes: Changes,
    say: Vec<(SessionId, Say)>,
}

impl Core {
    /// Takes up where the catalog stands. Live leases get a fresh lease period, so that workers that reconnect
    /// keep them. `timing` holds what is known of each result set of an active job.
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

    /// Whether a job is known to be active.
    pub(crate) fn knows(&self, job: JobId) -> bool {
        self.stages.contains_key(&StageRef { job, stage: 0 })
    }

    /// Takes note of an active job, given its stages.
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

    /// Takes note of stages that may begin and of jobs that have ended.
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

    /// What must become durable, and what to say when it is.
    pub(crate) fn take(&mut self) -> (Changes, Vec<(SessionId, Say)>) {
        self.fresh.clear();
        (
            std::mem::take(&mut self.changes),
            std::mem::take(&mut self.say),
        )
    }

    /// Prolongs every lease by one lease period from now: after a stall of the coordinator itself, for which no worker
    /// is to blame.
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

    /// Notes a line of history. Neighbouring tasks that a worker finished in one batch share a line.
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

    /// Where nothing of a stage is in hand any more, it may be over.
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
