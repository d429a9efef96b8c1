//! Workers that must end at a known time, either with their Slurm job or on request. They get the
//! tasks that they can finish by then, as far as task durations are known.

use picofarm_catalog::{Mark, RangeState, Run};
use picofarm_proto::ids::{StageRef, WorkerId};

use super::{message::SessionId, state::Core};

/// A task is expected to need this multiple of the mean of its stage and of its longest interrupted
/// attempt.
const MARGIN: f64 = 1.25;

/// Returns the expected duration of a task from a measured one.
pub(super) fn with_margin(ms: f64) -> i64 {
    // The cast saturates.
    (MARGIN * ms) as i64
}

impl Core {
    /// Records the milliseconds until a worker must end.
    pub(crate) fn ends(&mut self, session: SessionId, ends_in_ms: Option<u64>, now_ms: i64) {
        if let Some(entry) = self.workers.of_session_mut(session) {
            entry.ends_ms = end_time(ends_in_ms, now_ms);
        }
    }

    /// Returns the time that a worker has left for another lease, milliseconds; `None` if it need
    /// not end.
    fn time_left(&self, worker: WorkerId, now_ms: i64) -> Option<i64> {
        let entry = self.workers.get(&worker)?;
        let left = entry.ends_ms? - now_ms;
        let leases = entry.leases.iter().filter_map(|id| {
            let entry = self.stages.get(&self.leases.stage_of(*id)?)?;
            let RangeState::Leased(lease) = &entry.held.leased_range(*id)?.state else {
                return None;
            };
            let todo = lease.marks.iter().filter(|m| **m == Mark::Todo).count();
            Some(todo as f64 * 1000.0 * self.stages.mean_seconds(entry)?)
        });
        let busy: f64 = leases.sum();
        Some(left.saturating_sub(busy as i64))
    }

    /// Returns the expected duration of a task of a stage, milliseconds. Returns `None` if it is
    /// unknown, or if a task continues from its saved progress.
    pub(super) fn needs_ms(&self, id: StageRef) -> Option<i64> {
        let entry = &self.stages[&id];
        if entry.spec().task.resumes() {
            return None;
        }
        match self.stages.mean_seconds(entry) {
            Some(mean) => Some(with_margin(mean * 1000.0)),
            None => (entry.longest_ms() > 0).then(|| with_margin(entry.longest_ms() as f64)),
        }
    }

    /// Checks whether a worker has enough time left for a task of a stage.
    ///
    /// # Errors
    /// Returns the time needed and the time left, milliseconds.
    pub(super) fn has_time(
        &self,
        id: StageRef,
        worker: WorkerId,
        now_ms: i64,
    ) -> Result<(), (i64, i64)> {
        match (self.time_left(worker, now_ms), self.needs_ms(id)) {
            (Some(left), _) if left <= 0 => Err((self.needs_ms(id).unwrap_or(0), 0)),
            (Some(left), Some(needs)) if needs > left => Err((needs, left)),
            _ => Ok(()),
        }
    }

    /// Returns the tasks of a stage with an interrupted attempt longer than the time that a worker
    /// has left, as ascending, disjoint runs.
    fn too_long(&self, id: StageRef, worker: WorkerId, now_ms: i64) -> Vec<Run> {
        let entry = &self.stages[&id];
        let Some(left) = self.time_left(worker, now_ms) else {
            return Vec::new();
        };
        if with_margin(entry.longest_ms() as f64) <= left || entry.spec().task.resumes() {
            return Vec::new();
        }
        let long = entry.exceptions();
        long.filter(|e| with_margin(e.longest_ms as f64) > left)
            .map(|e| Run {
                lo: e.task,
                hi: e.task + 1,
            })
            .collect()
    }

    /// Returns the tasks of a stage not to be given to this worker now, as ascending, disjoint
    /// runs.
    pub(super) fn excluded_tasks(&self, id: StageRef, worker: WorkerId, now_ms: i64) -> Vec<Run> {
        let mut runs = self.tasks_of_other_jobs(id);
        let long = self.too_long(id, worker, now_ms);
        if !long.is_empty() {
            runs.extend(long);
            super::shared::in_order(&mut runs);
        }
        runs
    }

    /// Returns how many tasks of a stage a worker can finish before it ends.
    pub(super) fn most_that_fit(&self, id: StageRef, worker: WorkerId, now_ms: i64) -> u64 {
        match (self.time_left(worker, now_ms), self.needs_ms(id)) {
            (Some(left), Some(needs)) => (left / needs.max(1)).max(1).unsigned_abs(),
            _ => u64::MAX,
        }
    }

    /// Returns the expected duration of a task, milliseconds, if lack of time is the reason why a
    /// worker gets no task of the stage.
    pub(super) fn lacks_time(&self, id: StageRef, worker: WorkerId, now_ms: i64) -> Option<i64> {
        let entry = &self.stages[&id];
        let abilities = &self.workers.get(&worker)?.abilities;
        entry.suits(abilities).ok()?;
        if let Err((needs, _)) = self.has_time(id, worker, now_ms) {
            return Some(needs);
        }
        let long = self.too_long(id, worker, now_ms);
        let pending = |run: &&Run| entry.held.pending_at(run.lo).is_some();
        let needs = long.iter().filter(pending).filter_map(|run| {
            let exception = entry.exception(run.lo)?;
            Some(with_margin(exception.longest_ms as f64))
        });
        let needs = needs.min()?;
        self.ready_for(id, worker, now_ms)
            .is_none()
            .then_some(needs)
    }
}

/// Converts a worker's reported milliseconds until its end to a time.
pub(super) fn end_time(ends_in_ms: Option<u64>, now_ms: i64) -> Option<i64> {
    let ms = i64::try_from(ends_in_ms?).unwrap_or(i64::MAX);
    Some(now_ms.saturating_add(ms))
}
