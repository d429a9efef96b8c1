//! The leases of this instance: the stage of each, and the progress of its tasks.

use std::collections::BTreeMap;

use picofarm_proto::ids::{RangeId, StageRef};

use super::progress::Progress;

/// The leased ranges. Their state is part of their stage's [`super::held_ranges::HeldRanges`].
#[derive(Default)]
pub(super) struct Leases {
    stages: BTreeMap<RangeId, StageRef>,
    /// Last reported progress of running tasks, by lease and task.
    progress: BTreeMap<RangeId, BTreeMap<u64, Progress>>,
    /// Connections that break before this time are blamed on a stall of the coordinator, Unix
    /// milliseconds.
    graced_until_ms: i64,
}

impl Leases {
    /// Adds a lease of a stage.
    pub(super) fn begin(&mut self, id: RangeId, stage: StageRef) {
        self.stages.insert(id, stage);
    }

    /// Forgets a lease, with its progress.
    pub(super) fn end(&mut self, id: RangeId) {
        self.stages.remove(&id);
        self.progress.remove(&id);
    }

    /// Returns the stage of a lease.
    pub(super) fn stage_of(&self, id: RangeId) -> Option<StageRef> {
        self.stages.get(&id).copied()
    }

    /// Returns the leases, with their stages.
    pub(super) fn iter(&self) -> impl Iterator<Item = (RangeId, StageRef)> {
        self.stages.iter().map(|(id, stage)| (*id, *stage))
    }

    /// Returns whether the worker has reported that it runs a task of a lease.
    pub(super) fn is_running(&self, id: RangeId) -> bool {
        self.progress
            .get(&id)
            .is_some_and(|tasks| !tasks.is_empty())
    }

    /// Returns the reported progress of a lease's tasks, by task.
    pub(super) fn running(&self, id: RangeId) -> impl Iterator<Item = (u64, &Progress)> {
        let tasks = self.progress.get(&id).into_iter().flatten();
        tasks.map(|(task, progress)| (*task, progress))
    }

    /// Returns the reported progress of a task.
    pub(super) fn progress(&self, id: RangeId, task: u64) -> Option<&Progress> {
        self.progress.get(&id)?.get(&task)
    }

    /// Returns the progress of a task, which begins now if nothing was reported before.
    pub(super) fn progress_mut(&mut self, id: RangeId, task: u64, now_ms: i64) -> &mut Progress {
        let tasks = self.progress.entry(id).or_default();
        tasks.entry(task).or_insert_with(|| Progress::since(now_ms))
    }

    /// Forgets the progress of a task that has ended.
    pub(super) fn task_over(&mut self, id: RangeId, task: u64) {
        if let Some(tasks) = self.progress.get_mut(&id) {
            tasks.remove(&task);
        }
    }

    /// Blames connections that break before this time on a stall of the coordinator.
    pub(super) fn grace_until(&mut self, until_ms: i64) {
        self.graced_until_ms = until_ms;
    }

    /// Returns the time until which broken connections are blamed on a stall, Unix milliseconds.
    pub(super) fn graced_until_ms(&self) -> i64 {
        self.graced_until_ms
    }
}
