//! Reports the waiting tasks that workers of one shape could take, for programs that start such
//! workers. Changes nothing.

use std::collections::{BTreeSet, HashMap};

use picofarm_proto::ids::{JobId, StageRef, WorkerId};
use uuid::Uuid;

use super::{
    pools::{PoolFit, Shape},
    stage_entry::StageEntry,
    state::Core,
    store_faults::store_of,
    words::span,
};

/// The work that waits for workers of a shape.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Demand {
    /// Stages with waiting tasks, in the order in which they get workers.
    pub stages: Vec<StageDemand>,
    /// Connected workers of the pool: name and unfinished tasks of each.
    pub workers: Vec<(String, u64)>,
    /// Whether some stages may have more tasks than is known.
    pub unknown: bool,
}

/// Waiting tasks of a stage.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StageDemand {
    /// The job.
    pub job: JobId,
    /// Name of the stage.
    pub stage: String,
    /// Tasks that could be leased now and that no stage before counts.
    pub tasks: u64,
    /// Expected seconds of a task on one worker, if known.
    pub task_seconds: Option<f64>,
    /// Idle workers that may run the tasks. Each counts for one stage, and at most one for each
    /// task.
    pub idle: u32,
    /// How many more workers may join the job; `None` for any number.
    pub room: Option<u64>,
    /// Why a worker of the shape cannot run the tasks.
    pub refused: Option<String>,
}

impl Core {
    /// Returns the tasks that wait and that workers of a shape could take, by the rules of leases.
    pub(crate) fn demand(&self, shape: &Shape, now_ms: i64) -> Demand {
        let mut ids: Vec<StageRef> = self.stages.keys().copied().collect();
        ids.sort_by_cached_key(|id| self.rank(*id));
        let mut demand = Demand::default();
        let mut taken = BTreeSet::new();
        // Jobs with the same outputs share their tasks.
        let mut counted = HashMap::new();
        for id in ids {
            let entry = &self.stages[&id];
            if entry.is_paused() || entry.is_overdue(now_ms) {
                continue;
            }
            let free = entry.claimable(now_ms);
            demand.unknown |= free.unknown;
            // Unclaimed tasks may include those that run for other jobs.
            let free = free.known().saturating_sub(self.waits_for_others(id));
            let known = self.ready_here(id, now_ms).known() + free;
            let same = counted.entry(entry.set()).or_insert(0_u64);
            let tasks = known.saturating_sub(*same);
            *same += tasks;
            if tasks == 0 {
                continue;
            }
            let (tasks, refused) = match self.refuses(id, shape, now_ms) {
                Some(why) => (tasks, Some(why)),
                None => match tasks.saturating_sub(self.longer(entry, shape)) {
                    0 => (tasks, Some(self.too_long_words(entry, shape))),
                    fitting => (fitting, None),
                },
            };
            let idle = match refused {
                Some(_) => 0,
                None => self.take_idle(id, tasks, &mut taken, now_ms),
            };
            let most = entry.job_spec().limits.max_workers;
            demand.stages.push(StageDemand {
                job: id.job,
                stage: entry.spec().name.clone(),
                tasks,
                task_seconds: self.stages.mean_seconds(entry),
                idle,
                room: (most > 0).then(|| self.load.room(id.job, most)),
                refused,
            });
        }
        let begins = |name: &str| {
            let rest = name.strip_prefix(&*shape.pool);
            rest.is_some_and(|rest| rest.starts_with('-'))
        };
        let of_pool = self.workers.values().filter(|w| begins(&w.name));
        demand.workers = of_pool
            .map(|w| (w.name.clone(), self.unfinished_tasks(w)))
            .collect();
        demand
    }

    /// Records that a program asks for a pool.
    pub(crate) fn pool_asks(&mut self, shape: &Shape, now_ms: i64) {
        self.pools.asked(shape, now_ms);
    }

    /// Returns the pools whose programs run, with regard to a stage.
    pub(super) fn pools_for(&self, id: StageRef, now_ms: i64) -> Vec<PoolFit> {
        let pools = self.pools.live(now_ms);
        pools
            .map(|shape| shape.fit(self.refuses(id, shape, now_ms)))
            .collect()
    }

    /// Returns why no worker of a shape may run a stage now.
    fn refuses(&self, id: StageRef, shape: &Shape, now_ms: i64) -> Option<String> {
        let entry = &self.stages[&id];
        if let Err(why) = entry.suits(&shape.abilities) {
            return Some(why);
        }
        if let Err(why) = self.room_for(&entry.job().user, shape.abilities.cores) {
            return Some(why);
        }
        // A store that is unavailable to all is unavailable to a worker that nobody knows.
        let unknown = WorkerId::from_uuid(Uuid::nil());
        let store = store_of(&entry.spec().task);
        if let Err(why) = self.store_faults.may_use(store, unknown, now_ms) {
            return Some(why.words().to_owned());
        }
        let (needs, lasts) = (self.needs_ms(id)?, lasts_ms(shape)?);
        (needs > lasts).then(|| too_long(needs, lasts))
    }

    /// Returns how many pending tasks were interrupted after so long that they do not fit into the
    /// life of a worker.
    fn longer(&self, entry: &StageEntry, shape: &Shape) -> u64 {
        let Some(lasts) = lasts_ms(shape) else {
            return 0;
        };
        if entry.spec().task.resumes() {
            return 0;
        }
        let pending = |task: u64| match entry.held.pending_tasks() {
            // The catalog has all pending tasks.
            0 => !entry.held.leased().any(|(range, _)| range.has_to_do(task)),
            _ => entry.held.pending_at(task).is_some(),
        };
        let long = entry
            .exceptions()
            .filter(|e| !e.dead && super::time_left::with_margin(e.longest_ms as f64) > lasts);
        long.filter(|e| pending(e.task)).count() as u64
    }

    fn too_long_words(&self, entry: &StageEntry, shape: &Shape) -> String {
        let needs = super::time_left::with_margin(entry.longest_ms() as f64);
        too_long(needs, lasts_ms(shape).unwrap_or(i64::MAX))
    }

    /// Counts the idle workers that may run a stage, at most one for each task, and adds them to
    /// those taken.
    fn take_idle(
        &self,
        id: StageRef,
        tasks: u64,
        taken: &mut BTreeSet<WorkerId>,
        now_ms: i64,
    ) -> u32 {
        let mut idle = 0;
        for (worker, entry) in self.workers.iter() {
            if u64::from(idle) >= tasks {
                break;
            }
            let free = entry.wants_leases() && entry.leases.is_empty() && !taken.contains(worker);
            if free && self.may_run(id, *worker, now_ms).is_ok() {
                taken.insert(*worker);
                idle += 1;
            }
        }
        idle
    }
}

fn lasts_ms(shape: &Shape) -> Option<i64> {
    Some(i64::try_from(shape.lasts_ms?).unwrap_or(i64::MAX))
}

fn too_long(needs: i64, lasts: i64) -> String {
    format!(
        "a task is taken to need {}, and such a worker runs for {}; allow longer ones, or divide the scenes (`parts` of a render \
         stage)",
        span(needs),
        span(lasts)
    )
}
