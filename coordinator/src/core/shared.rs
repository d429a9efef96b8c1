//! Outputs that several jobs want. What a worker has in hand for one of them is not begun for another: its result counts for
//! both. So jobs over the same data set that are submitted at once share the work instead of doing it twice.
//!
//! This instance knows what its own workers have in hand, and what those of other instances had when it last heard of them
//! (once a second). What it does not know yet is done twice, and comes to the same bytes; what others have finished is found,
//! as ever, when tasks are claimed, and once more by the worker that begins them.

use picofarm_catalog::{Mark, Run};
use picofarm_proto::ids::StageRef;

use super::Core;

impl Core {
    /// Tasks of a stage that workers have in hand for other stages with the same outputs: ascending, disjoint. None for a
    /// stage whose outputs do not count where they exist.
    pub(super) fn done_for_others(&self, id: StageRef) -> Vec<Run> {
        let entry = &self.stages[&id];
        let sharing = &self.sets[entry.set].stages;
        if sharing.len() < 2 || entry.spec(id).force {
            return Vec::new();
        }
        let others = || sharing.iter().filter(|other| **other != id);
        let here = others().flat_map(|other| self.stages[other].stage.leased());
        let here = here.filter_map(|(range, lease)| {
            // Leases are worked off in order.
            let first = lease.marks.iter().position(|m| *m == Mark::Todo)?;
            Some(Run {
                lo: range.lo + first as u64,
                hi: range.hi,
            })
        });
        let elsewhere = others().filter_map(|other| self.shared_elsewhere.get(other));
        let mut runs: Vec<Run> = here.chain(elsewhere.flatten().copied()).collect();
        in_order(&mut runs);
        runs
    }

    /// How many tasks of a stage wait only because they are in hand for other stages.
    pub(super) fn waits_for_others(&self, id: StageRef) -> u64 {
        let runs = self.done_for_others(id);
        let among = |task: u64| {
            let before = runs.partition_point(|run| run.lo <= task);
            before > 0 && task < runs[before - 1].hi
        };
        // Of another instance's it may have some in hand itself.
        let own = self.stages[&id].stage.leased().map(|(range, _)| {
            let both = (range.lo..range.hi).filter(|t| range.has_to_do(*t) && among(*t));
            both.count() as u64
        });
        let own: u64 = own.sum();
        runs.iter().map(|run| run.hi - run.lo).sum::<u64>() - own
    }
}

/// Makes runs ascending and disjoint.
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
