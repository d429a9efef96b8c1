//! Ranges of tasks and their states.

use picofarm_proto::ids::{Epoch, Incarnation, LeaseRef, RangeId, StageRef, WorkerId};

/// Tasks `lo ≤ i < hi`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// First task.
    pub lo: u64,
    /// One past the last task.
    pub hi: u64,
}

/// Consecutive tasks of a stage in one state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Range {
    /// The range's id, which with the epoch identifies a lease.
    pub id: RangeId,
    /// The stage.
    pub stage: StageRef,
    /// First task.
    pub lo: u64,
    /// One past the last task.
    pub hi: u64,
    /// Incremented at each lease.
    pub epoch: Epoch,
    /// Number of workers lost while they ran this range or one that it was split from. A range with
    /// crashes is not merged with others, so that halving isolates a poison task.
    pub crashes: u32,
    /// The range's state.
    pub state: RangeState,
}

/// The state of a range.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RangeState {
    /// Waiting for a worker.
    Pending {
        /// Not leased before this Unix time in milliseconds; 0 means at once.
        not_before_ms: i64,
    },
    /// Leased to a worker.
    Leased(LeaseState),
    /// All outputs are committed.
    Done {
        /// The outputs existed before this job ran the tasks.
        reused: bool,
    },
    /// Given up.
    Dead,
}

/// The holder of a lease, its expiry and its progress.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeaseState {
    /// The worker.
    pub worker: WorkerId,
    /// The worker process.
    pub incarnation: Incarnation,
    /// Unix time in milliseconds at which the lease expires.
    pub until_ms: i64,
    /// One mark for each task of the range.
    pub marks: Vec<Mark>,
}

/// The state of one task in a leased range.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Mark {
    /// Not finished yet.
    Todo = 0,
    /// Committed, computed under this lease.
    Done = 1,
    /// Committed, because the store already had the output.
    Reused = 2,
    /// Failed under this lease; the task now has a range of its own.
    Left = 3,
}

impl Range {
    /// Returns the number of tasks.
    pub fn len(&self) -> u64 {
        self.hi - self.lo
    }

    /// Returns `false`, because a range has at least one task.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Returns whether the task is pending or unfinished under a lease.
    pub fn has_to_do(&self, task: u64) -> bool {
        match &self.state {
            RangeState::Pending { .. } => (self.lo..self.hi).contains(&task),
            RangeState::Leased(lease) => {
                let at = task.checked_sub(self.lo);
                at.and_then(|at| lease.marks.get(usize::try_from(at).ok()?)) == Some(&Mark::Todo)
            }
            RangeState::Done { .. } | RangeState::Dead => false,
        }
    }

    /// Returns whether the range may be merged with a neighbour in the same state. Suspected ranges
    /// and ranges with a start time are never merged.
    pub fn merges(&self) -> bool {
        self.crashes == 0
            && match self.state {
                RangeState::Pending { not_before_ms } => not_before_ms == 0,
                RangeState::Leased(_) => false,
                RangeState::Done { .. } | RangeState::Dead => true,
            }
    }

    /// Returns the lease's identity.
    pub fn lease(&self) -> LeaseRef {
        LeaseRef {
            range: self.id,
            epoch: self.epoch,
        }
    }
}
