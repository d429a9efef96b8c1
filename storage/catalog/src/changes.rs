//! A set of changes for one atomic commit.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_proto::ids::{RangeId, StageRef, WorkerId};

use crate::{
    event::NewEvent,
    instance::Worker,
    range::Range,
    task::{Exception, Output},
    usage::NewUsage,
};

/// The writes of one commit. If a range, exception or worker changes several times, only the last
/// state is written.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Changes {
    /// Current state of the ranges that this instance owns.
    pub ranges: BTreeMap<RangeId, Range>,
    /// Current state of the ranges that this instance releases: done and dead ones for good,
    /// pending ones for the next instance that claims them. The catalog may merge them with their
    /// neighbours.
    pub free: BTreeMap<RangeId, Range>,
    /// Ranges that no longer exist.
    pub gone: BTreeSet<RangeId>,
    /// Ids among these that were created since the last commit, so that the catalog does not know
    /// them. The catalog must know all others as owned by this instance.
    pub minted: BTreeSet<RangeId>,
    /// New outputs.
    pub outputs: Vec<Output>,
    /// Current state of the failed tasks.
    pub exceptions: BTreeMap<(StageRef, u64), Exception>,
    /// Current state of the workers.
    pub workers: BTreeMap<WorkerId, Worker>,
    /// What the tasks consumed.
    pub usage: NewUsage,
    /// New history events, in order.
    pub events: Vec<NewEvent>,
    /// Stages in which this instance has no ranges left, with the Unix time in milliseconds. If no
    /// other instance has any either, the stage is over, and its job may be over too.
    pub perhaps_over: BTreeMap<StageRef, i64>,
}

impl Changes {
    /// Returns whether there is nothing to write.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Records the current state of a range that this instance owns.
    pub fn put(&mut self, range: Range) {
        self.gone.remove(&range.id);
        self.free.remove(&range.id);
        self.ranges.insert(range.id, range);
    }

    /// Records that this instance releases a range.
    pub fn give(&mut self, range: Range) {
        self.gone.remove(&range.id);
        self.ranges.remove(&range.id);
        self.free.insert(range.id, range);
    }

    /// Records that a range no longer exists.
    pub fn remove(&mut self, id: RangeId) {
        self.ranges.remove(&id);
        self.free.remove(&id);
        self.gone.insert(id);
    }

    /// Returns the ranges that the catalog must know as owned by this instance. If it does not,
    /// another instance has taken them.
    pub fn known(&self) -> impl Iterator<Item = RangeId> + '_ {
        self.ranges
            .keys()
            .chain(self.free.keys())
            .chain(&self.gone)
            .filter(|id| !self.minted.contains(id))
            .copied()
    }
}
