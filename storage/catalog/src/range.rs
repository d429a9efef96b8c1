//! Ranges of tasks, and their states.

use picofarm_proto::ids::{Epoch, Incarnation, LeaseRef, RangeId, StageRef, WorkerId};

/// Tasks `lo ≤ i < hi`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// First task.
    pub lo: u64,
    /// One past the last task.
    pub hi: u64,
}

/// Consecutive tasks of a job in one state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Range {
    /// Its id; with the epoch, the name of a lease.
    pub id: RangeId,
    /// The stage.
    pub stage: StageRef,
    /// First task.
    pub lo: u64,
    /// One past the last task.
    pub hi: u64,
    /// Grows at each grant.
    pub epoch: Epoch,
    /// Workers lost with this range or one it was cut from; such a range is not merged with others, so that
    /// a poison task is cornered by halving.
    pub crashes: u32,
    /// What may happen to it.
    pub state: RangeState,
}

/// The state of a range.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RangeState {
    /// Waits for a worker.
    Pending {
        /// Not granted before this Unix time, milliseconds; 0 = at once.
        not_before_ms: i64,
    },
    /// A worker has it.
    Leased(LeaseState),
    /// Every output is committed.
    Done {
        /// The outputs were there before this job ran the tasks.
        reused: bool,
    },
    /// Given up.
    Dead,
}

/// Who holds a range, until when, and how far it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LeaseState {
    /// The worker.
    pub worker: WorkerId,
    /// The process of the worker.
    pub incarnation: Incarnation,
    /// Unix time at which the lease runs out, milliseconds.
    pub until_ms: i64,
    /// One for each task of the range.
    pub marks: Vec<Mark>,
}

/// What became of one task of a leased range.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Mark {
    /// To be run.
    Todo = 0,
    /// Committed, computed under this lease.
    Done = 1,
    /// Committed, found in the store.
    Reused = 2,
    /// Failed under this lease; a range of its own has the task now.
    Left = 3,
}

impl Range {
    /// Number of tasks between `lo` and `hi`.
    pub fn len(&self) -> u64 {
        self.hi - self.lo
    }

    /// Never: a range holds at least one task.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Whether a task waits here or is under way.
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

    /// Whether it may become one with a neighbour in the same state that may too: never those under suspicion, or
    /// waiting for a time.
    pub fn merges(&self) -> bool {
        self.crashes == 0
            && match self.state {
                RangeState::Pending { not_before_ms } => not_before_ms == 0,
                RangeState::Leased(_) => false,
                RangeState::Done { .. } | RangeState::Dead => true,
            }
    }

    /// The lease's name.
    pub fn lease(&self) -> LeaseRef {
        LeaseRef {
            range: self.id,
            epoch: self.epoch,
        }
    }
}
