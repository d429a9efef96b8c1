//! A set of changes that becomes durable as a whole.

use std::collections::{BTreeMap, BTreeSet};

use picofarm_proto::ids::{RangeId, StageRef, WorkerId};

use crate::{
    event::NewEvent,
    instance::Worker,
    range::Range,
    task::{Exception, Output},
};

/// What one commit writes. For each range, exception and worker only the last word counts.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Changes {
    /// Ranges that this instance owns, as they are now.
    pub ranges: BTreeMap<RangeId, Range>,
    /// Ranges that this instance gives out of its hands, as they are now: done and dead ones for good, pending ones
    /// for whoever claims them. The catalog may merge them with their neighbours.
    pub free: BTreeMap<RangeId, Range>,
    /// Ranges that are no more.
    pub gone: BTreeSet<RangeId>,
    /// Ids among these that were made since the last commit: the catalog does not know them. It must know all others
    /// as this instance's.
    pub minted: BTreeSet<RangeId>,
    /// New outputs.
    pub outputs: Vec<Output>,
    /// Failed tasks as they are now.
    pub exceptions: BTreeMap<(StageRef, u64), Exception>,
    /// Workers as they are now.
    pub workers: BTreeMap<WorkerId, Worker>,
    /// History, in order.
    pub events: Vec<NewEvent>,
    /// Stages of which this instance has nothing left: if nobody else has either, they are over, and with them perhaps
    /// their jobs.
    pub perhaps_over: BTreeMap<StageRef, i64>,
}

impl Changes {
    /// Whether there is nothing to write.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Notes a range of this instance as it is now.
    pub fn put(&mut self, range: Range) {
        self.gone.remove(&range.id);
        self.free.remove(&range.id);
        self.ranges.insert(range.id, range);
    }

    /// Notes a range that is nobody's from now on.
    pub fn give(&mut self, range: Range) {
        self.gone.remove(&range.id);
        self.ranges.remove(&range.id);
        self.free.insert(range.id, range);
    }

    /// Notes that a range is no more.
    pub fn remove(&mut self, id: RangeId) {
        self.ranges.remove(&id);
        self.free.remove(&id);
        self.gone.insert(id);
    }

    /// The ranges that the catalog must know as this instance's, or else somebody has taken them.
    pub fn known(&self) -> impl Iterator<Item = RangeId> + '_ {
        self.ranges
            .keys()
            .chain(self.free.keys())
            .chain(&self.gone)
            .filter(|id| !self.minted.contains(id))
            .copied()
    }
}
