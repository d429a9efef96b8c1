//! The state of the core, and how it is loaded from the catalog.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use picofarm_catalog::{Changes, Job, ResultSet, Run, Settled, Snapshot, StageRecord, Timing};
use picofarm_proto::ids::{Incarnation, JobId, RangeId, StageRef, WorkerId};

use super::{
    blocklist::Blocklist,
    doubt,
    load::Load,
    message::{Say, SessionId},
    progress::Progress,
    settings::{MakeId, Settings},
    sick,
    stage::Stage,
    stages::{SetEntry, StageEntry},
    stores,
    tail::Double,
    workers::WorkerEntry,
};

pub(crate) struct Core {
    pub(super) settings: Settings,
    pub(super) make_id: MakeId,
    /// Stages of active jobs. Job ids grow with time, so this is the order of submission.
    pub(super) stages: BTreeMap<StageRef, StageEntry>,
    pub(super) sets: Vec<SetEntry>,
    pub(super) set_ids: HashMap<ResultSet, usize>,
    /// Connected workers.
    pub(super) workers: BTreeMap<WorkerId, WorkerEntry>,
    pub(super) sessions: HashMap<SessionId, WorkerId>,
    /// Names of all workers that have ever connected.
    pub(super) names: HashMap<WorkerId, String>,
    /// The stage of each leased range.
    pub(super) leases: BTreeMap<RangeId, StageRef>,
    /// Which workers run which job.
    pub(super) load: Load,
    /// Tasks that run a second time, by the lease of the second run.
    pub(super) doubles: BTreeMap<RangeId, Double>,
    /// Next time at which idle workers are given parts of other leases.
    pub(super) help_at_ms: i64,
    /// Unavailable stores for which tasks wait.
    pub(super) away: stores::Stores,
    /// Workers that are not trusted, and doubtful results.
    pub(super) doubts: doubt::Doubts,
    /// Workers on which every task fails.
    pub(super) sick: sick::Sick,
    /// Connections that break before this time are blamed on a stall of the coordinator, Unix
    /// milliseconds.
    pub(super) graced_until_ms: i64,
    /// The charges against each disconnected worker, which are refunded if it reconnects.
    pub(super) charged: HashMap<WorkerId, (Incarnation, Vec<(StageRef, u64)>)>,
    /// Last reported progress of running tasks, by lease.
    pub(super) progress: BTreeMap<RangeId, BTreeMap<u64, Progress>>,
    /// Live instances, including this one.
    pub(super) instances: u32,
    /// Workers connected to other instances.
    pub(super) elsewhere: u32,
    /// Tasks that other instances' workers were last reported to run, for stages that share
    /// outputs.
    pub(super) shared_elsewhere: BTreeMap<StageRef, Vec<Run>>,
    /// Outputs in `changes`, by set and task.
    pub(super) fresh: HashMap<(usize, u64), [u8; 32]>,
    pub(super) changes: Changes,
    pub(super) say: Vec<(SessionId, Say)>,
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

    pub(super) fn name_of(&self, worker: WorkerId) -> String {
        self.names
            .get(&worker)
            .cloned()
            .unwrap_or_else(|| worker.to_string())
    }

    /// Marks a stage as possibly finished if none of its tasks is held by this instance.
    pub(super) fn perhaps_over(&mut self, stage: StageRef, now_ms: i64) {
        let empty = self.stages.get(&stage).is_none_or(|e| e.stage.is_empty());
        if empty {
            self.changes.perhaps_over.insert(stage, now_ms);
        }
    }

    pub(super) fn range_id(make_id: &mut MakeId) -> impl FnMut() -> RangeId + '_ {
        || RangeId::from_uuid(make_id())
    }
}
