//! Outputs that several jobs want. A task that a worker runs for one job is not begun for another,
//! because its result counts for both. Jobs over the same data set that are submitted together
//! therefore share the work.
//!
//! This instance knows the tasks of its own workers, and those of other instances' workers as of
//! the last news (once a second). A task not yet reported runs twice and gives the same bytes.
//! A result also settles the claimed tasks of the other jobs that want it. Results that other
//! instances' workers have finished are found when tasks are claimed, and again by the worker that
//! begins a task.

use picofarm_catalog::{Mark, Run};
use picofarm_proto::{ids::StageRef, messages::EventKind};

use super::{history::EventDetails, state::Core, transition::RangeEvent};

impl Core {
    /// Returns the tasks of a stage that workers run for other stages with the same outputs, as
    /// ascending, disjoint runs. Returns none for a stage that does not reuse existing outputs.
    pub(super) fn tasks_of_other_jobs(&self, id: StageRef) -> Vec<Run> {
        let entry = &self.stages[&id];
        let sharing = self.stages.sharing(entry);
        if sharing.len() < 2 || entry.spec().force {
            return Vec::new();
        }
        let others = || sharing.iter().filter(|other| **other != id);
        let here = others().flat_map(|other| self.stages[other].held.leased());
        let here = here.filter_map(|(range, lease)| {
            // The tasks of a lease are begun in order.
            let first = lease.marks.iter().position(|m| *m == Mark::Todo)?;
            Some(Run {
                lo: range.lo + first as u64,
                hi: range.hi,
            })
        });
        let elsewhere = others().flat_map(|other| self.peers.tasks(other));
        let mut runs: Vec<Run> = here.chain(elsewhere.copied()).collect();
        in_order(&mut runs);
        runs
    }

    /// Settles a task, which a worker finished for the stage `by`, in the other stages that want
    /// the same output and have claimed the task. Without this, jobs that take turns over one data
    /// set would each run all of it.
    pub(super) fn settle_for_others(&mut self, by: StageRef, task: u64, now_ms: i64) {
        let sharing = self.stages.sharing(&self.stages[&by]);
        if sharing.len() < 2 {
            return;
        }
        let others: Vec<StageRef> = sharing.iter().copied().filter(|id| *id != by).collect();
        for id in others {
            let entry = self.stages.get_mut(&id).expect("a set names active stages");
            if entry.spec().force {
                continue;
            }
            let Some(range) = entry.held.pending_at(task).cloned() else {
                continue;
            };
            let run = Run {
                lo: task,
                hi: task + 1,
            };
            self.outcome
                .apply(&mut entry.held, &range, &RangeEvent::Settle { run })
                .expect("a pending task can be settled");
            let about = EventDetails::message("another job made the output").tasks(run.lo, run.hi);
            self.outcome.event(now_ms, id, EventKind::Reused, about);
            self.perhaps_over(id, now_ms);
        }
    }

    /// Returns how many tasks of a stage wait only because they run for other stages.
    pub(super) fn waits_for_others(&self, id: StageRef) -> u64 {
        let runs = self.tasks_of_other_jobs(id);
        let among = |task: u64| {
            let before = runs.partition_point(|run| run.lo <= task);
            before > 0 && task < runs[before - 1].hi
        };
        // Some of another instance's tasks may be in this instance's own leases.
        let own = self.stages[&id].held.leased().map(|(range, _)| {
            let both = (range.lo..range.hi).filter(|t| range.has_to_do(*t) && among(*t));
            both.count() as u64
        });
        let own: u64 = own.sum();
        runs.iter().map(|run| run.hi - run.lo).sum::<u64>() - own
    }
}

/// Sorts and merges runs so that they are ascending and disjoint.
pub(super) fn in_order(runs: &mut Vec<Run>) {
    runs.sort_unstable_by_key(|run| run.lo);
    runs.dedup_by(|next, run| {
        let joins = next.lo <= run.hi;
        if joins {
            run.hi = run.hi.max(next.hi);
        }
        joins
    });
}
