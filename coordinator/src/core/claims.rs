//! Connects the catalog to the workers: claims pending tasks, gives back unwanted ones, and applies
//! news of other instances.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use picofarm_catalog::{Changes, Claim, News, Owned, Range, RangeState, Want};
use picofarm_proto::{
    ids::{JobId, StageRef, WorkerId},
    messages::EventKind,
};

use super::{
    history::EventDetails, placement, ready::Ready, stage_entry::StageEntry, state::Core,
    transition::RangeEvent,
};

/// Leases claimed for each lease wanted now, so that short tasks do not cost a transaction
/// each.
const AHEAD: u64 = 8;
/// Delay before the catalog is asked again after an empty answer.
const ASK_AGAIN_MS: i64 = 100;

impl Core {
    /// Returns the pending tasks that connected workers could run now and that this instance has
    /// not claimed. Jobs of equal priority share: each gets one lease in turn, until no worker asks
    /// for more. Jobs of lower priority get the remaining capacity. Tasks that cannot run now, or
    /// on none of the asking workers, keep no worker from other jobs.
    pub(crate) fn wants(&self, now_ms: i64) -> Vec<Want> {
        let mut asking =
            AskingWorkers::new(self.workers.asking().map(|(id, worker)| AskingWorker {
                id: *id,
                credits: worker.credits,
                empty_handed: worker.leases.is_empty(),
                ends: worker.ends_ms.is_some(),
            }));
        // Usually all workers are busy, so that nothing needs to be searched.
        if asking.credits == 0 {
            return Vec::new();
        }
        let mut ranked: Vec<StageRef> = self
            .stages
            .iter()
            .filter(|(_, entry)| entry.waits(now_ms))
            .map(|(id, _)| *id)
            .collect();
        ranked.sort_by_cached_key(|id| self.rank(*id));
        let mut wants = Vec::new();
        for level in ranked.chunk_by(|a, b| self.priority(*a) == self.priority(*b)) {
            let mut demands: Vec<Demand> = level.iter().map(|id| Demand::new(*id)).collect();
            let mut taken = true;
            while taken && asking.credits > 0 {
                taken = false;
                for demand in &mut demands {
                    taken |= self.give_one(demand, &mut asking, now_ms);
                }
            }
            wants.extend(demands.iter().filter_map(|d| self.want(d, now_ms)));
            if asking.credits == 0 {
                break;
            }
        }
        wants
    }

    /// Gives a stage one more lease, for the next asking worker that may run it. Returns `false` if
    /// no worker may run it or no task is left.
    fn give_one(&self, demand: &mut Demand, asking: &mut AskingWorkers, now_ms: i64) -> bool {
        let id = demand.stage;
        let job = self.stages[&id].job();
        let most = job.spec.limits.max_workers;
        while asking.credits > 0
            && let Some(worker) = asking.workers.get_mut(demand.next)
        {
            let joins = most > 0 && !self.load.works(job.id, worker.id);
            let joined = asking.joined.get(&job.id);
            let room = !joins
                || joined.is_none_or(|all| {
                    all.contains(&worker.id) || (all.len() as u64) < self.load.room(job.id, most)
                });
            let bounded = self.has_quota(&job.user);
            let room = room && (!bounded || self.quota_left(&job.user, worker.id, &asking.cores));
            if worker.credits == 0 || !room || self.may_run(id, worker.id, now_ms).is_err() {
                demand.next += 1;
                continue;
            }
            // The available tasks of the stage may be too long for this worker.
            if worker.ends && self.ready_for(id, worker.id, now_ms).is_none() {
                demand.next += 1;
                continue;
            }
            let supply = demand.supply.get_or_insert_with(|| self.supply(id, now_ms));
            let ready = &mut supply.ready;
            if ready.plain >= 1 {
                ready.plain = ready.plain.saturating_sub(supply.size);
            } else if ready.suspects >= 1 && worker.empty_handed {
                ready.suspects = ready.suspects.saturating_sub(supply.size);
            } else if !ready.unknown {
                if ready.is_none() {
                    demand.next = asking.workers.len();
                } else {
                    demand.next += 1;
                }
                continue;
            }
            demand.leases += 1;
            demand.suspects |= worker.empty_handed;
            worker.credits -= 1;
            asking.credits -= 1;
            if bounded && !self.load.works_for(&job.user, worker.id) {
                let cores = self.load.cores_of(worker.id);
                let taken = asking.cores.entry(job.user.clone()).or_default();
                taken.insert(worker.id, cores);
            }
            if joins {
                asking.joined.entry(job.id).or_default().insert(worker.id);
            }
            return true;
        }
        false
    }

    /// Returns whether a worker may get a lease of a user's job, with those that are about to.
    fn quota_left(&self, user: &str, worker: WorkerId, joining: &JoiningCores) -> bool {
        let joining = joining.get(user);
        if joining.is_some_and(|workers| workers.contains_key(&worker)) {
            return true;
        }
        let more = joining.map_or(0, |workers| workers.values().sum());
        self.within_quota(user, worker, more).is_ok()
    }

    fn supply(&self, id: StageRef, now_ms: i64) -> Supply {
        let entry = &self.stages[&id];
        let size = match entry.spec().task.resumes() {
            true => 1,
            false => self.lease_size(entry, self.able(id, now_ms), u64::MAX, now_ms),
        };
        Supply {
            size,
            ready: self.ready(id, now_ms),
        }
    }

    /// Returns the tasks to claim for a demand beyond those already claimed.
    fn want(&self, demand: &Demand, now_ms: i64) -> Option<Want> {
        let supply = demand.supply.as_ref().filter(|_| demand.leases > 0)?;
        let entry = &self.stages[&demand.stage];
        let here = self.ready_here(demand.stage, now_ms);
        let have = match demand.suspects {
            true => here.known(),
            false => here.plain,
        };
        let needed = demand.leases * supply.size;
        let short = have < needed && !entry.claimable(now_ms).is_none();
        short.then(|| Want {
            stage: demand.stage,
            tasks: AHEAD * needed,
            now_ms,
            force: entry.spec().force,
            suspects: demand.suspects,
        })
    }

    /// Returns the number of tasks in the next lease of a stage, at most `in_range`.
    pub(super) fn lease_size(
        &self,
        entry: &StageEntry,
        able: u64,
        in_range: u64,
        now_ms: i64,
    ) -> u64 {
        let claimable = entry.claimable(now_ms);
        // The supply counts as sufficient while its size is unknown.
        let free = match claimable.unknown {
            true => u64::MAX / 2,
            false => claimable.known(),
        };
        let (plain, suspects) = entry.held.ready(now_ms, &[]);
        placement::lease_size(
            self.stages.mean_seconds(entry),
            (plain + suspects).saturating_add(free),
            in_range,
            able * u64::from(self.peers.instances()),
        )
    }

    /// Applies the catalog's answer to a `Want`.
    pub(crate) fn claimed(&mut self, stage: StageRef, claim: Claim, now_ms: i64) {
        let Some(entry) = self.stages.get_mut(&stage) else {
            return;
        };
        entry.set_free(claim.left);
        if claim.owned.ranges.is_empty() {
            entry.ask_not_before(now_ms + ASK_AGAIN_MS);
        }
        self.receive(claim.owned, now_ms);
        for run in claim.existing {
            let entry = self.stages.get_mut(&stage).expect("looked up above");
            // Every run is contained in one claimed range, because runs end where claimed ranges
            // end.
            let Some(range) = entry.held.pending_at(run.lo).cloned() else {
                continue;
            };
            self.outcome
                .apply(&mut entry.held, &range, &RangeEvent::Settle { run })
                .expect("pending tasks can be settled");
            let about = EventDetails::message("the outputs exist already").tasks(run.lo, run.hi);
            self.outcome.event(now_ms, stage, EventKind::Reused, about);
            self.perhaps_over(stage, now_ms);
        }
    }

    /// Takes over ranges that the catalog assigns to this instance. Their leases begin a new
    /// period.
    pub(crate) fn receive(&mut self, owned: Owned, now_ms: i64) {
        for exception in owned.exceptions {
            if let Some(entry) = self.stages.get_mut(&exception.stage) {
                entry.note_exception(exception);
            }
        }
        for range in owned.ranges {
            let id = range.id;
            self.forget_outdated(&range);
            match self.stages.get_mut(&range.stage) {
                Some(entry) => {
                    if let RangeState::Leased(lease) = &range.state {
                        self.leases.begin(id, range.stage);
                        self.load.lease_begun(id, entry.job(), lease.worker);
                    }
                    entry.held.receive(range, self.outcome.changes());
                    self.renew(id, now_ms);
                }
                // The job is no longer active, so the range goes back as it would have when the job
                // ended.
                None => give_back(&range, self.outcome.changes()),
            }
        }
    }

    /// Forgets leases that ended on another instance. This is noticed when their tasks come back
    /// before the catalog's news do. If kept, they would run out here and their tasks would be in
    /// two ranges.
    fn forget_outdated(&mut self, range: &Range) {
        let Some(entry) = self.stages.get_mut(&range.stage) else {
            return;
        };
        let mut ended = entry.held.outdated_by(range);
        // The same range, now without its worker or with another one.
        let pending = matches!(range.state, RangeState::Pending { .. });
        let same = entry.held.leased_range(range.id);
        let same = same.filter(|old| pending || old.epoch != range.epoch);
        ended.extend(same.map(|old| old.id));
        for id in ended {
            tracing::info!(range = %id, "this lease ended at another coordinator");
            if let Some(entry) = self.stages.get_mut(&range.stage) {
                entry.held.forget(id);
            }
            self.lease_over(id);
        }
    }

    /// Gives back the pending tasks that no worker took, so that other instances may claim them.
    pub(crate) fn give_back(&mut self) {
        for entry in self.stages.values_mut() {
            let before = self.outcome.changes().free.len();
            entry.held.give_pending(self.outcome.changes());
            if self.outcome.changes().free.len() > before {
                entry.ask_again();
            }
        }
    }

    /// Applies the catalog's news. Returns the active jobs that this instance does not know yet.
    pub(crate) fn apply_news(&mut self, news: News, now_ms: i64) -> Vec<JobId> {
        self.failing_workers.tidy(now_ms);
        let workers = news.workers.saturating_sub(self.workers.count());
        self.peers.record(news.instances, workers, news.shared);
        let over: Vec<JobId> = self
            .stages
            .keys()
            .map(|stage| stage.job)
            .filter(|job| !news.active.contains_key(job))
            .collect();
        for job in over {
            self.drop_job(job, "the job was stopped");
        }
        let mut held = BTreeSet::new();
        for (id, entry) in self.stages.iter_mut() {
            entry.set_free(news.free.get(id).copied().unwrap_or_default());
            let paused = news.active.get(&id.job).copied().unwrap_or(false);
            if entry.set_paused(paused) {
                held.insert(id.job);
            }
        }
        self.load.record_elsewhere(news.busy);
        if let Some(leased) = &news.leased {
            let lost: Vec<_> = self
                .leases
                .iter()
                .filter(|(range, _)| !leased.contains(range))
                .collect();
            for (range, stage) in lost {
                tracing::info!(%range, "a worker has taken this lease along to another coordinator");
                if let Some(entry) = self.stages.get_mut(&stage) {
                    entry.held.forget(range);
                }
                self.lease_over(range);
                // Our last task may have been reported while this one still seemed to be leased,
                // and the other instance may have finished it before ours. Then this instance must
                // notice that the stage has finished.
                self.perhaps_over(stage, now_ms);
            }
        }
        self.receive(news.taken, now_ms);
        // Paused through another instance.
        for job in held {
            self.paused(job, true);
        }
        let active = news.active.into_keys();
        let unknown = active.filter(|job| !self.knows(*job));
        unknown.collect()
    }
}

/// The workers that ask for leases.
struct AskingWorkers {
    workers: Vec<AskingWorker>,
    /// Total number of leases that the workers ask for.
    credits: u64,
    /// Workers that would join the workers of a job with a limit.
    joined: HashMap<JobId, BTreeSet<WorkerId>>,
    /// Workers that would join those of users with a bound.
    cores: JoiningCores,
}

/// Cores of workers, by user.
type JoiningCores = HashMap<String, BTreeMap<WorkerId, u64>>;

struct AskingWorker {
    id: WorkerId,
    credits: u32,
    empty_handed: bool,
    /// The worker must end at a known time.
    ends: bool,
}

impl AskingWorkers {
    fn new(workers: impl Iterator<Item = AskingWorker>) -> Self {
        let workers: Vec<AskingWorker> = workers.collect();
        Self {
            credits: workers.iter().map(|w| u64::from(w.credits)).sum(),
            workers,
            joined: HashMap::new(),
            cores: HashMap::new(),
        }
    }
}

/// The part of a stage that the asking workers could take.
struct Demand {
    stage: StageRef,
    /// The next worker to consider.
    next: usize,
    leases: u64,
    /// Whether one of the workers has no other lease.
    suspects: bool,
    supply: Option<Supply>,
}

impl Demand {
    fn new(stage: StageRef) -> Self {
        Self {
            stage,
            next: 0,
            leases: 0,
            suspects: false,
            supply: None,
        }
    }
}

/// The tasks of a stage that are available to these workers.
struct Supply {
    /// Number of tasks in a lease.
    size: u64,
    ready: Ready,
}

/// Gives back the pieces of a range of an inactive job, in the form that the catalog stores.
fn give_back(range: &Range, changes: &mut Changes) {
    let mut minted = Vec::new();
    let pieces = match range.state {
        RangeState::Leased(_) => {
            super::transition::next(range, &RangeEvent::Close { halve: false }, &mut || {
                let id = picofarm_proto::ids::RangeId::from_uuid(uuid::Uuid::now_v7());
                minted.push(id);
                id
            })
            .expect("a lease can be closed")
        }
        _ => vec![range.clone()],
    };
    changes.remove(range.id);
    changes.minted.extend(minted);
    for piece in pieces {
        changes.give(piece);
    }
}
