//! The ranges of one job in memory: at most one row for each run of equal state, merged where they meet.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_catalog::{Changes, LeaseState, Mark, Range, RangeState};
use picofarm_proto::{
    ids::{LeaseRef, RangeId},
    model::TaskCounts,
};

use crate::transition::{self, Illegal, RangeEvent};

/// All ranges of a job. Those not leased never overlap; a leased one overlaps those of tasks that left it.
#[derive(Debug, Default)]
pub struct Stage {
    /// Pending, done and dead, by first task.
    resting: BTreeMap<u64, Range>,
    leased: BTreeMap<RangeId, Range>,
    /// Pending ranges by (not before, first task).
    queue: BTreeSet<(i64, u64)>,
    /// Kept in step with the ranges; the truth is the ranges.
    counts: TaskCounts,
}

impl Stage {
    /// A stage of these ranges, merged where they meet; what changes by it goes to `changes`.
    pub fn new(ranges: Vec<Range>, changes: &mut Changes) -> Self {
        let mut stage = Self::default();
        for range in ranges {
            stage.insert(range, changes);
        }
        stage
    }

    /// Tasks by state.
    pub fn counts(&self) -> TaskCounts {
        self.counts
    }

    /// Whether every task is done or dead.
    pub fn ended(&self) -> bool {
        self.counts.pending == 0 && self.counts.leased == 0
    }

    /// The leased ranges.
    pub fn leased(&self) -> impl Iterator<Item = (&Range, &LeaseState)> {
        self.leased.values().map(|range| match &range.state {
            RangeState::Leased(lease) => (range, lease),
            _ => unreachable!("only leased ranges are kept there"),
        })
    }

    /// The range of a lease, if that epoch is the live one.
    pub fn lease(&self, lease: LeaseRef) -> Option<(&Range, &LeaseState)> {
        let range = self.leased.get(&lease.range)?;
        match &range.state {
            RangeState::Leased(state) if range.epoch == lease.epoch => Some((range, state)),
            _ => None,
        }
    }

    /// A leased range, whatever its epoch.
    pub fn leased_range(&self, id: RangeId) -> Option<&Range> {
        self.leased.get(&id)
    }

    /// Prolongs a lease in place; the caller writes it out.
    pub fn renew(&mut self, id: RangeId, to_ms: i64) {
        if let Some(range) = self.leased.get_mut(&id)
            && let RangeState::Leased(lease) = &mut range.state
        {
            lease.until_ms = lease.until_ms.max(to_ms);
        }
    }

    /// The pending range that should go next at this time: fresh ones by index, then the earliest retry.
    pub fn front(&self, now_ms: i64, suspects: bool) -> Option<&Range> {
        self.queue
            .iter()
            .take_while(|(not_before, _)| *not_before <= now_ms)
            .filter_map(|(_, lo)| self.resting.get(lo))
            .find(|range| suspects || range.crashes == 0)
    }

    /// The pending range that holds a task.
    pub fn pending_at(&self, task: u64) -> Option<&Range> {
        let (_, range) = self.resting.range(..=task).next_back()?;
        (task < range.hi && matches!(range.state, RangeState::Pending { .. })).then_some(range)
    }

    /// First tasks of the given-up ranges.
    pub fn dead(&self) -> Vec<Range> {
        self.resting
            .values()
            .filter(|r| r.state == RangeState::Dead)
            .cloned()
            .collect()
    }

    /// Number of ranges, which is the number of rows.
    pub fn rows(&self) -> usize {
        self.resting.len() + self.leased.len()
    }

    /// Lets `event` happen to `range`; returns the leased range that results first, if any.
    ///
    /// # Errors
    /// [`Illegal`] when it cannot happen; then nothing changed.
    pub fn apply(
        &mut self,
        range: &Range,
        event: &RangeEvent,
        ids: &mut dyn FnMut() -> RangeId,
        changes: &mut Changes,
    ) -> Result<Option<Range>, Illegal> {
        let pieces = transition::next(range, event, ids)?;
        self.remove(range);
        changes.remove(range.id);
        let leased = pieces
            .iter()
            .find(|p| matches!(p.state, RangeState::Leased(_)))
            .cloned();
        for piece in pieces {
            self.insert(piece, changes);
        }
        Ok(leased)
    }

    fn remove(&mut self, range: &Range) {
        let known = match range.state {
            RangeState::Leased(_) => self.leased.remove(&range.id),
            _ => self.resting.remove(&range.lo),
        };
        debug_assert_eq!(known.as_ref(), Some(range), "a range is removed as it is");
        if let RangeState::Pending { not_before_ms } = range.state {
            self.queue.remove(&(not_before_ms, range.lo));
        }
        count(range, |field, n| *field -= n, &mut self.counts);
    }

    fn insert(&mut self, mut range: Range, changes: &mut Changes) {
        if !matches!(range.state, RangeState::Leased(_)) {
            let before = self
                .resting
                .range(..range.lo)
                .next_back()
                .map(|(_, b)| b)
                .filter(|b| b.hi == range.lo && merges(b, &range))
                .cloned();
            let after = self
                .resting
                .get(&range.hi)
                .filter(|a| merges(&range, a))
                .cloned();
            for neighbour in [before, after].into_iter().flatten() {
                self.remove(&neighbour);
                changes.remove(neighbour.id);
                range.lo = range.lo.min(neighbour.lo);
                range.hi = range.hi.max(neighbour.hi);
                range.epoch = range.epoch.max(neighbour.epoch);
            }
        }
        count(&range, |field, n| *field += n, &mut self.counts);
        changes.put(range.clone());
        match range.state {
            RangeState::Leased(_) => {
                self.leased.insert(range.id, range);
            }
            _ => {
                if let RangeState::Pending { not_before_ms } = range.state {
                    self.queue.insert((not_before_ms, range.lo));
                }
                let other = self.resting.insert(range.lo, range);
                debug_assert_eq!(other, None, "resting ranges do not overlap");
            }
        }
    }
}

/// Whether two neighbours may become one: never those under suspicion or waiting for a time.
fn merges(a: &Range, b: &Range) -> bool {
    a.crashes == 0
        && b.crashes == 0
        && a.state == b.state
        && match a.state {
            RangeState::Pending { not_before_ms } => not_before_ms == 0,
            RangeState::Leased(_) => false,
            RangeState::Done { .. } | RangeState::Dead => true,
        }
}

fn count(range: &Range, mut change: impl FnMut(&mut u64, u64), counts: &mut TaskCounts) {
    let n = range.len();
    match &range.state {
        RangeState::Pending { .. } => change(&mut counts.pending, n),
        RangeState::Dead => change(&mut counts.dead, n),
        RangeState::Done { reused } => {
            change(&mut counts.done, n);
            if *reused {
                change(&mut counts.reused, n);
            }
        }
        RangeState::Leased(lease) => {
            for run in lease.marks.chunk_by(|a, b| a == b) {
                let n = run.len() as u64;
                match run[0] {
                    Mark::Todo => change(&mut counts.leased, n),
                    Mark::Done => change(&mut counts.done, n),
                    Mark::Reused => {
                        change(&mut counts.done, n);
                        change(&mut counts.reused, n);
                    }
                    Mark::Left => {}
                }
            }
        }
    }
    counts.total = counts.done + counts.leased + counts.pending + counts.dead;
}
