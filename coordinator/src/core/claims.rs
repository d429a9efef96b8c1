//! Between the catalog and the workers: claiming pending tasks, giving back what nobody here wants, and what is heard
//! of other instances.

use picofarm_catalog::{Changes, Claim, News, Owned, Range, RangeState, Want};
use picofarm_proto::{
    ids::{JobId, StageRef},
    model::EventKind,
};

use super::{About, Core};
use crate::{place, transition::RangeEvent};

/// Leases claimed for each one that is wanted now, so that short tasks do not cost a transaction each.
const AHEAD: u64 = 8;
/// How long not to ask again after an empty answer.
const ASK_AGAIN_MS: i64 = 100;

impl Core {
    /// The pending tasks that connected workers could run now and that are not in hand. Jobs of one priority share: the
    /// first in rank are asked for as many as there are leases wanted. Those of lower priority get their turn when the
    /// others have nothing left.
    pub(crate) fn wants(&self, now_ms: i64) -> Vec<Want> {
        // Mostly everyone is at work: then nothing need be looked at.
        if !self.workers.values().any(super::WorkerEntry::hungry) {
            return Vec::new();
        }
        let mut ranked: Vec<StageRef> = self
            .stages
            .iter()
            .filter(|(_, entry)| entry.waits())
            .map(|(id, _)| *id)
            .collect();
        ranked.sort_by_cached_key(|id| self.rank(*id));
        let mut wants = Vec::new();
        let mut covered = 0;
        for level in ranked.chunk_by(|a, b| self.priority(*a) == self.priority(*b)) {
            let hungry: Vec<_> = level
                .iter()
                .map(|id| (*id, self.appetite(*id, now_ms)))
                .filter(|(_, appetite)| appetite.leases > covered)
                .collect();
            let most = hungry.iter().map(|(_, a)| a.leases - covered).max();
            let sharing = most.unwrap_or(0).min(hungry.len() as u64).max(1);
            let mut found = 0;
            for (id, appetite) in hungry.into_iter().take(sharing as usize) {
                let entry = &self.stages[&id];
                let leases = (appetite.leases - covered).div_ceil(sharing);
                let others = self.done_for_others(id);
                let have = entry.stage.pending_tasks() - entry.stage.pending_among(&others);
                let size = self.lease_size(entry, appetite.able, u64::MAX);
                let none = entry.stage.front(now_ms, true, &others).is_none();
                let short = have < leases * size || none;
                if short && entry.free != Some(0) && entry.ask_at_ms <= now_ms {
                    wants.push(Want {
                        stage: id,
                        tasks: AHEAD * leases * size,
                        now_ms,
                        force: entry.spec(id).force,
                    });
                }
                let there = entry
                    .free
                    .map_or(u64::MAX, |free| (free + have).div_ceil(size));
                found += there.min(leases);
            }
            covered += found;
            if most.is_some_and(|most| found >= most) {
                break;
            }
        }
        wants
    }

    /// Workers that may run a stage now, and the leases they ask for.
    fn appetite(&self, id: StageRef, now_ms: i64) -> Appetite {
        let mut appetite = Appetite { able: 0, leases: 0 };
        for (worker, entry) in &self.workers {
            if self.may_run(id, *worker, now_ms).is_err() {
                continue;
            }
            appetite.able += 1;
            if entry.hungry() {
                appetite.leases += u64::from(entry.credits);
            }
        }
        appetite
    }

    /// Tasks of the next lease of a stage, at most `in_range`.
    pub(super) fn lease_size(&self, entry: &super::StageEntry, able: u64, in_range: u64) -> u64 {
        // As long as it is not known how much there is, there is enough.
        let free = entry.free.unwrap_or(u64::MAX / 2);
        place::lease_size(
            self.sets[entry.set].timing.mean(),
            entry.stage.pending_tasks().saturating_add(free),
            in_range,
            able * u64::from(self.instances),
        )
    }

    /// The answer to a wish.
    pub(crate) fn claimed(&mut self, stage: StageRef, claim: Claim, now_ms: i64) {
        let Some(entry) = self.stages.get_mut(&stage) else {
            return;
        };
        entry.free = Some(claim.left);
        if claim.owned.ranges.is_empty() {
            entry.ask_at_ms = now_ms + ASK_AGAIN_MS;
        }
        self.receive(claim.owned, now_ms);
        for run in claim.existing {
            let entry = self.stages.get_mut(&stage).expect("looked up above");
            // Runs end at the ends of claimed ranges: each lies in one of them.
            let Some(range) = entry.stage.pending_at(run.lo).cloned() else {
                continue;
            };
            entry
                .stage
                .apply(
                    &range,
                    &RangeEvent::Settle { run },
                    &mut Self::range_id(&mut self.make_id),
                    &mut self.changes,
                )
                .expect("pending tasks can be settled");
            let about = About::message("the outputs exist already").tasks(run.lo, run.hi);
            self.event(now_ms, stage, EventKind::Reused, about);
            self.perhaps_over(stage, now_ms);
        }
    }

    /// Takes ranges in hand that are this instance's in the catalog. Leases begin a new period.
    pub(crate) fn receive(&mut self, owned: Owned, now_ms: i64) {
        for exception in owned.exceptions {
            if let Some(entry) = self.stages.get_mut(&exception.stage) {
                entry.exceptions.insert(exception.task, exception);
            }
        }
        for range in owned.ranges {
            let id = range.id;
            self.forget_outdated(&range);
            match self.stages.get_mut(&range.stage) {
                Some(entry) => {
                    if let RangeState::Leased(lease) = &range.state {
                        self.leases.insert(id, range.stage);
                        self.load.begun(id, &entry.job, lease.worker);
                    }
                    entry.stage.receive(range, &mut self.changes);
                    self.renew(id, now_ms);
                }
                // Of a job that is no longer active: it goes back as it would have when the job ended.
                None => give_back(&range, &mut self.changes),
            }
        }
    }

    /// Forgets leases that ended elsewhere, which is found when their tasks come back before the catalog's news do. Left
    /// in hand, they would run out here, and their tasks would stand in two ranges.
    fn forget_outdated(&mut self, range: &Range) {
        let Some(entry) = self.stages.get_mut(&range.stage) else {
            return;
        };
        let mut ended = entry.stage.outdated_by(range);
        // The same one, without its worker, or another worker's by now.
        let pending = matches!(range.state, RangeState::Pending { .. });
        let same = entry.stage.leased_range(range.id);
        let same = same.filter(|old| pending || old.epoch != range.epoch);
        ended.extend(same.map(|old| old.id));
        for id in ended {
            tracing::info!(range = %id, "this lease ended at another coordinator");
            if let Some(entry) = self.stages.get_mut(&range.stage) {
                entry.stage.forget(id);
            }
            self.lease_over(id);
        }
    }

    /// Gives back the pending tasks that no worker took, so that other instances may.
    pub(crate) fn give_back(&mut self) {
        for entry in self.stages.values_mut() {
            let before = self.changes.free.len();
            entry.stage.give_pending(&mut self.changes);
            if self.changes.free.len() > before {
                entry.free = None;
            }
        }
    }

    /// What the catalog tells from time to time. Returns the active jobs that are not known yet.
    pub(crate) fn hear(&mut self, news: News, now_ms: i64) -> Vec<JobId> {
        self.instances = news.instances.max(1);
        self.elsewhere = news.workers.saturating_sub(self.connected());
        let over: Vec<JobId> = self
            .stages
            .keys()
            .map(|stage| stage.job)
            .filter(|job| !news.active.contains_key(job))
            .collect();
        for job in over {
            self.drop_job(job, "the job was stopped");
        }
        let mut held = std::collections::BTreeSet::new();
        for (id, entry) in &mut self.stages {
            entry.free = Some(news.free.get(id).copied().unwrap_or(0));
            let paused = news.active.get(&id.job).copied().unwrap_or(false);
            if paused && !entry.job.paused {
                held.insert(id.job);
            }
            entry.job.paused = paused;
        }
        self.load.hear_elsewhere(news.busy);
        self.shared_elsewhere = news.shared;
        if let Some(leased) = &news.leased {
            let lost: Vec<_> = self
                .leases
                .iter()
                .filter(|(range, _)| !leased.contains(range))
                .map(|(range, stage)| (*range, *stage))
                .collect();
            for (range, stage) in lost {
                tracing::info!(%range, "a worker has taken this lease along to another coordinator");
                if let Some(entry) = self.stages.get_mut(&stage) {
                    entry.stage.forget(range);
                }
                self.lease_over(range);
                // Our own last task was reported while this one seemed to be in hand still, and the instance that has it may
                // have finished it before ours: then it falls to us to find that the stage is over.
                self.perhaps_over(stage, now_ms);
            }
        }
        self.receive(news.taken, now_ms);
        // Held by way of another instance.
        for job in held {
            self.paused(job, true);
        }
        let active = news.active.into_keys();
        let unknown = active.filter(|job| !self.knows(*job));
        unknown.collect()
    }
}

/// What connected workers ask of a stage.
struct Appetite {
    able: u64,
    leases: u64,
}

/// The pieces of a range whose job is not active, as the catalog keeps them.
fn give_back(range: &Range, changes: &mut Changes) {
    let mut minted = Vec::new();
    let pieces = match range.state {
        RangeState::Leased(_) => {
            crate::transition::next(range, &RangeEvent::Close { halve: false }, &mut || {
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
