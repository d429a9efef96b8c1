//! The core's time limits, its source of ids, and the bounds on users.

use std::collections::BTreeMap;

use uuid::Uuid;

use super::budget::Backoff;

/// Version of this program. Workers must have the same.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Generates UUIDs. It is an argument so that the core is deterministic.
pub(crate) type MakeId = Box<dyn FnMut() -> Uuid + Send + Sync>;

/// The core's time limits.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Settings {
    /// Duration of a lease, milliseconds.
    pub lease_ms: u32,
    /// Time in which a disconnected worker may reconnect before its leases go to others,
    /// milliseconds.
    pub reconnect_ms: u32,
    /// Delays after failures.
    pub backoff: Backoff,
    /// The rest of a lease is shared with an idle worker if it takes at least this long,
    /// milliseconds.
    pub worth_ms: u32,
    /// Shortest run time after which an idle worker runs a task a second time, milliseconds. The
    /// task must also have taken three times the mean of its stage.
    pub slow_ms: u32,
}

/// A bound for each user.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Bound<T> {
    /// The bound for users without one of their own; `None` for no bound.
    pub every: Option<T>,
    /// The bounds of single users.
    pub of: BTreeMap<String, T>,
}

impl<T> Default for Bound<T> {
    fn default() -> Self {
        Self {
            every: None,
            of: BTreeMap::new(),
        }
    }
}

impl<T: Copy> Bound<T> {
    /// Returns the bound of a user, if any.
    pub(crate) fn of(&self, user: &str) -> Option<T> {
        self.of.get(user).copied().or(self.every)
    }

    /// Returns whether no user is bounded.
    pub(crate) fn is_none(&self) -> bool {
        self.every.is_none() && self.of.is_empty()
    }
}

/// The bounds on users.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct UserQuotas {
    /// Cores that a user's jobs use at a time.
    pub cores: Bound<u32>,
    /// Bytes that a user's jobs publish, over all time.
    pub bytes: Bound<u64>,
}
