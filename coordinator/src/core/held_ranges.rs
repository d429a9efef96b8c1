//! A stage's ranges held by a coordinator: those leased to its workers, and claimed pending ones.
//! Ranges that are done or given up go back to the catalog.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_catalog::{Changes, LeaseState, Mark, Range, RangeState, Run};
use picofarm_proto::ids::{LeaseRef, RangeId};

use super::transition::{self, Illegal, RangeEvent};

/// The held ranges. Pending ones never overlap. A leased range overlaps the ranges of tasks removed
/// from it.
#[derive(Debug, Default)]
pub struct HeldRanges {
    /// Pending ranges, by first task.
    pending: BTreeMap<u64, Range>,
    leased: BTreeMap<RangeId, Range>,
    /// Pending ranges by (not before, first task).
    queue: BTreeSet<(i64, u64)>,
    /// Updated with the ranges.
    pending_tasks: u64,
    leased_tasks: u64,
}

impl HeldRanges {
    /// Adds a range that the catalog assigns to this instance. A pending range merges with its
    /// neighbours.
    pub fn receive(&mut self, mut range: Range, changes: &mut Changes) {
        // If the range belonged to another instance meanwhile, this instance's copy is outdated.
        self.forget(range.id);
        debug_assert_eq!(
            self.outdated_by(&range),
            [],
            "each task stands in one range"
        );
        if self.join(&mut range, changes) {
            changes.put(range.clone());
        }
        self.hold(range);
    }

    /// Merges a pending range with its held neighbours, if any.
    fn join(&mut self, range: &mut Range, changes: &mut Changes) -> bool {
        if !(range.merges() && matches!(range.state, RangeState::Pending { .. })) {
            return false;
        }
        let before = self
            .pending
            .range(..range.lo)
            .next_back()
            .map(|(_, b)| b)
            .filter(|b| b.hi == range.lo && b.merges())
            .cloned();
        let after = self.pending.get(&range.hi).filter(|a| a.merges()).cloned();
        let neighbours = before.into_iter().chain(after);
        let mut joined = false;
        for neighbour in neighbours {
            self.remove(&neighbour);
            changes.remove(neighbour.id);
            range.lo = range.lo.min(neighbour.lo);
            range.hi = range.hi.max(neighbour.hi);
            range.epoch = range.epoch.max(neighbour.epoch);
            joined = true;
        }
        joined
    }

    fn hold(&mut self, range: Range) {
        self.count(&range, |n, by| *n += by);
        match range.state {
            RangeState::Leased(_) => {
                let other = self.leased.insert(range.id, range);
                debug_assert_eq!(other, None, "a range is received once");
            }
            RangeState::Pending { not_before_ms } => {
                self.queue.insert((not_before_ms, range.lo));
                let other = self.pending.insert(range.lo, range);
                debug_assert_eq!(other, None, "pending ranges do not overlap");
            }
            RangeState::Done { .. } | RangeState::Dead => {
                debug_assert!(false, "what is done or dead is nobody's");
            }
        }
    }

    /// Returns the number of pending tasks held.
    pub fn pending_tasks(&self) -> u64 {
        self.pending_tasks
    }

    /// Returns the number of unfinished leased tasks.
    pub fn leased_tasks(&self) -> u64 {
        self.leased_tasks
    }

    /// Returns whether no range is held.
    pub fn is_empty(&self) -> bool {
        self.pending.is_empty() && self.leased.is_empty()
    }

    /// Returns the leased ranges.
    pub fn leased(&self) -> impl Iterator<Item = (&Range, &LeaseState)> {
        self.leased.values().map(|range| match &range.state {
            RangeState::Leased(lease) => (range, lease),
            _ => unreachable!("only leased ranges are kept there"),
        })
    }

    /// Returns the range of a lease, if its epoch is the live one.
    pub fn lease(&self, lease: LeaseRef) -> Option<(&Range, &LeaseState)> {
        let range = self.leased.get(&lease.range)?;
        match &range.state {
            RangeState::Leased(state) if range.epoch == lease.epoch => Some((range, state)),
            _ => None,
        }
    }

    /// Returns a leased range, whatever its epoch.
    pub fn leased_range(&self, id: RangeId) -> Option<&Range> {
        self.leased.get(&id)
    }

    /// Sets the end of a lease to a function of its current end. The change is only in memory,
    /// because a range that another instance takes over begins a new period anyway.
    pub fn set_until(&mut self, id: RangeId, to_ms: impl FnOnce(i64) -> i64) {
        if let Some(range) = self.leased.get_mut(&id)
            && let RangeState::Leased(lease) = &mut range.state
        {
            lease.until_ms = to_ms(lease.until_ms);
        }
    }

    /// Removes a finished task from a leased range after all. Returns the changed range.
    pub fn leave(&mut self, id: RangeId, task: u64) -> Option<Range> {
        let range = self.leased.get_mut(&id)?;
        let at = usize::try_from(task.checked_sub(range.lo)?).ok()?;
        if let RangeState::Leased(lease) = &mut range.state {
            let mark = lease.marks.get_mut(at)?;
            // Unfinished tasks are counted; a finished task was not.
            debug_assert_ne!(*mark, Mark::Todo, "the task was done");
            *mark = Mark::Left;
        }
        Some(range.clone())
    }

    /// Returns the pending range that goes next at this time, and the first run of its tasks
    /// outside `except` (ascending, disjoint). Fresh ranges come first by index, then the earliest
    /// retry.
    pub fn front(&self, now_ms: i64, suspects: bool, except: &[Run]) -> Option<(&Range, Run)> {
        self.queue
            .iter()
            .take_while(|(not_before, _)| *not_before <= now_ms)
            .filter_map(|(_, lo)| self.pending.get(lo))
            .filter(|range| suspects || range.crashes == 0)
            .find_map(|range| Some((range, first_outside(range, except)?)))
    }

    /// Returns whether any pending range is due at this time.
    pub fn is_due(&self, now_ms: i64) -> bool {
        self.queue.first().is_some_and(|(at, _)| *at <= now_ms)
    }

    /// Returns the number of pending tasks that are due at this time, outside `except` (ascending,
    /// disjoint): first those not under suspicion, then those with which workers were lost.
    pub fn ready(&self, now_ms: i64, except: &[Run]) -> (u64, u64) {
        let due = self.queue.iter().take_while(|(at, _)| *at <= now_ms);
        let (mut plain, mut suspects) = (0, 0);
        for range in due.filter_map(|(_, lo)| self.pending.get(lo)) {
            let from = except.partition_point(|run| run.hi <= range.lo);
            let both = except[from..].iter().take_while(|run| run.lo < range.hi);
            let out: u64 = both
                .map(|run| range.hi.min(run.hi) - range.lo.max(run.lo))
                .sum();
            match range.crashes {
                0 => plain += range.len() - out,
                _ => suspects += range.len() - out,
            }
        }
        (plain, suspects)
    }

    /// Returns the pending range that contains a task.
    pub fn pending_at(&self, task: u64) -> Option<&Range> {
        let (_, range) = self.pending.range(..=task).next_back()?;
        (task < range.hi).then_some(range)
    }

    /// Gives back every pending range.
    pub fn give_pending(&mut self, changes: &mut Changes) {
        self.queue.clear();
        self.pending_tasks = 0;
        for range in std::mem::take(&mut self.pending).into_values() {
            changes.give(range);
        }
    }

    /// Returns the held leases with unfinished tasks that the catalog lists in `range`. Their
    /// workers took them to another instance, where they ended.
    pub fn outdated_by(&self, range: &Range) -> Vec<RangeId> {
        let old = self.leased.values().filter(|leased| {
            let both = range.lo.max(leased.lo)..range.hi.min(leased.hi);
            leased.id != range.id && { both }
                .any(|task| leased.has_to_do(task) && range.has_to_do(task))
        });
        old.map(|leased| leased.id).collect()
    }

    /// Forgets a leased range that another instance has taken over.
    pub fn forget(&mut self, id: RangeId) -> Option<Range> {
        let range = self.leased.remove(&id)?;
        self.count(&range, |n, by| *n -= by);
        Some(range)
    }

    /// Applies `event` to `range`. Returns the first resulting leased range, if any.
    ///
    /// # Errors
    /// Returns [`Illegal`] if the event is not possible. Then nothing changes.
    pub fn apply(
        &mut self,
        range: &Range,
        event: &RangeEvent,
        ids: &mut dyn FnMut() -> RangeId,
        changes: &mut Changes,
    ) -> Result<Option<Range>, Illegal> {
        let mut minted = Vec::new();
        let pieces = transition::next(range, event, &mut || {
            let id = ids();
            minted.push(id);
            id
        })?;
        changes.minted.extend(minted);
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
            _ => self.pending.remove(&range.lo),
        };
        debug_assert_eq!(known.as_ref(), Some(range), "a range is removed as it is");
        if let RangeState::Pending { not_before_ms } = range.state {
            self.queue.remove(&(not_before_ms, range.lo));
        }
        self.count(range, |n, by| *n -= by);
    }

    fn insert(&mut self, mut range: Range, changes: &mut Changes) {
        if let RangeState::Done { .. } | RangeState::Dead = range.state {
            return changes.give(range);
        }
        self.join(&mut range, changes);
        changes.put(range.clone());
        self.hold(range);
    }

    fn count(&mut self, range: &Range, change: impl FnOnce(&mut u64, u64)) {
        match &range.state {
            RangeState::Pending { .. } => change(&mut self.pending_tasks, range.len()),
            RangeState::Leased(lease) => {
                let todo = lease.marks.iter().filter(|m| **m == Mark::Todo).count();
                change(&mut self.leased_tasks, todo as u64);
            }
            RangeState::Done { .. } | RangeState::Dead => {}
        }
    }
}

/// Returns the first run of a range's tasks outside `except` (ascending, disjoint).
fn first_outside(range: &Range, except: &[Run]) -> Option<Run> {
    let mut lo = range.lo;
    for run in except {
        if run.hi <= lo {
            continue;
        }
        if run.lo > lo {
            let hi = run.lo.min(range.hi);
            return Some(Run { lo, hi });
        }
        lo = run.hi;
        if lo >= range.hi {
            return None;
        }
    }
    Some(Run { lo, hi: range.hi })
}
