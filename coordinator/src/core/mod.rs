//! The coordinator's mind: all live state in memory, synchronous methods over it, no I/O. Time and ids are
//! passed in. Each method notes what must become durable ([`Changes`]) and what to say afterwards ([`Say`]).

mod commit;
mod dispatch;
mod jobs;
mod leases;
mod sessions;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet, HashMap};

use picofarm_catalog::{Changes, Exception, Job, NewEvent, ResultSet, Run, Snapshot, Timing};
use picofarm_proto::{
    ids::{Incarnation, JobId, LeaseRef, RangeId, WorkerId},
    key::StageKey,
    model::{EventKind, JobState, Lease},
};
use uuid::Uuid;

use crate::{budget::Backoff, place::Abilities, stage::Stage};

pub(crate) use commit::OutputHint;
pub(crate) use jobs::Submitted;

/// Makes UUIDs; passed in, so that the core is deterministic.
pub(crate) type MakeId = Box<dyn FnMut() -> Uuid + Send>;

/// Number of a session, unique in this process.
pub(crate) type SessionId = u64;

/// Times of the core.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Settings {
    /// Life of a lease, milliseconds.
    pub lease_ms: u32,
    /// Waiting times after failures.
    pub backoff: Backoff,
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
    /// The session ends; a newer one has taken its place.
    Replaced,
}

struct JobEntry {
    job: Job,
    set: usize,
    stage: Stage,
    exceptions: BTreeMap<u64, Exception>,
    /// Why no connected worker may run it, as last told.
    waiting: Option<String>,
}

/// Jobs that share outputs.
struct SetEntry {
    key: StageKey,
    timing: Timing,
    jobs: Vec<JobId>,
}

struct WorkerEntry {
    session: SessionId,
    incarnation: Incarnation,
    name: String,
    abilities: Abilities,
    credits: u32,
    leases: BTreeSet<RangeId>,
    /// It holds a range under suspicion and gets nothing else.
    quarantined: bool,
}

#[derive(Debug, Clone, Copy)]
struct Progress {
    fraction: f32,
    since_ms: i64,
}

pub(crate) struct Core {
    settings: Settings,
    make_id: MakeId,
    jobs: BTreeMap<JobId, JobEntry>,
    /// Jobs in order of submission.
    order: Vec<JobId>,
    sets: Vec<SetEntry>,
    set_ids: HashMap<ResultSet, usize>,
    /// Connected workers.
    workers: BTreeMap<WorkerId, WorkerEntry>,
    sessions: HashMap<SessionId, WorkerId>,
    /// Names of all workers ever seen.
    names: HashMap<WorkerId, String>,
    /// The job of each leased range.
    leases: BTreeMap<RangeId, JobId>,
    /// Tasks in hand, by lease, as last reported.
    progress: BTreeMap<RangeId, BTreeMap<u64, Progress>>,
    /// Leases prolonged since they were last written.
    renewed: BTreeSet<RangeId>,
    /// Outputs of `changes`, by set and task.
    fresh: HashMap<(usize, u64), [u8; 32]>,
    changes: Changes,
    say: Vec<(SessionId, Say)>,
}

impl Core {
    /// Takes up where the catalog stands. Live leases get a fresh lease period, so that workers that reconnect
    /// keep them. `timing` of a set is asked once for each set of an active job.
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
            jobs: BTreeMap::new(),
            order: Vec::new(),
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
            progress: BTreeMap::new(),
            renewed: BTreeSet::new(),
            fresh: HashMap::new(),
            changes: Changes::default(),
            say: Vec::new(),
        };
        let mut ranges: BTreeMap<JobId, Vec<_>> = BTreeMap::new();
        for range in snapshot.ranges {
            ranges.entry(range.job).or_default().push(range);
        }
        for job in snapshot.jobs {
            let set = ResultSet::of(&job.spec);
            let timing = timing.get(&set).copied().unwrap_or_default();
            let mut changes = Changes::default();
            let stage = Stage::new(ranges.remove(&job.id).unwrap_or_default(), &mut changes);
            if !changes.gone.is_empty() {
                core.changes.append(changes);
            }
            core.leases
                .extend(stage.leased().map(|(range, _)| (range.id, job.id)));
            core.adopt(job, set, timing, stage);
        }
        for exception in snapshot.exceptions {
            if let Some(entry) = core.jobs.get_mut(&exception.job) {
                entry.exceptions.insert(exception.task, exception);
            }
        }
        core.grace(now_ms);
        core
    }

    fn adopt(&mut self, job: Job, set: ResultSet, timing: Timing, stage: Stage) {
        let next = self.sets.len();
        let key = set.stage_key;
        let set = *self.set_ids.entry(set).or_insert(next);
        if set == next {
            self.sets.push(SetEntry {
                key,
                timing,
                jobs: Vec::new(),
            });
        }
        self.sets[set].jobs.push(job.id);
        self.order.push(job.id);
        self.jobs.insert(
            job.id,
            JobEntry {
                job,
                set,
                stage,
                exceptions: BTreeMap::new(),
                waiting: None,
            },
        );
    }

    /// What must become durable, and what to say when it is.
    pub(crate) fn take(&mut self) -> (Changes, Vec<(SessionId, Say)>) {
        self.fresh.clear();
        (
            std::mem::take(&mut self.changes),
            std::mem::take(&mut self.say),
        )
    }

    /// Prolongs every lease by one lease period from now: after a restart or a stall of the coordinator itself,
    /// for which no worker is to blame.
    pub(crate) fn grace(&mut self, now_ms: i64) {
        for range in self.leases.keys().copied().collect::<Vec<_>>() {
            self.renew(range, now_ms);
        }
    }

    fn name_of(&self, worker: WorkerId) -> String {
        self.names
            .get(&worker)
            .cloned()
            .unwrap_or_else(|| worker.to_string())
    }

    fn event(&mut self, at_ms: i64, job: JobId, kind: EventKind, about: About) {
        self.changes.events.push(NewEvent {
            at_ms,
            job,
            kind,
            tasks: about.tasks,
            worker: about.worker,
            seconds: about.seconds,
            message: about.message,
        });
    }

    /// Ends a job whose tasks are all done or dead.
    fn end_if_over(&mut self, id: JobId, now_ms: i64) {
        let Some(entry) = self.jobs.get_mut(&id) else {
            return;
        };
        if entry.job.state != JobState::Active || !entry.stage.ended() {
            return;
        }
        let counts = entry.stage.counts();
        entry.job.state = if counts.dead > 0 {
            JobState::Failed
        } else {
            JobState::Done
        };
        entry.job.ended_ms = Some(now_ms);
        self.changes
            .job_states
            .insert(id, (entry.job.state, entry.job.ended_ms));
        let message = format!(
            "{} of {} tasks done, {} dead",
            counts.done, counts.total, counts.dead
        );
        self.event(now_ms, id, EventKind::Ended, About::message(message));
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
