//! How many connections there may be, and for how long they may be silent.

use std::time::Duration;

use super::slots::ConnectionSlots;
use crate::memory::MemoryBounds;

/// Bounds on connections to the gRPC port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Connections {
    /// Most concurrent connections; by default 20,000. The limit of open files may lower it.
    pub all: usize,
    /// Most connections of one remote address (or IPv6 /64 network); by default three quarters of
    /// `all`.
    pub per_address: Option<usize>,
    /// A connection without an admitted request is closed after this time (default 20 s).
    pub first_request: Duration,
    /// A connection without open streams is closed after this time (default 10 min). Clients
    /// reconnect when they need to.
    pub idle: Duration,
}

impl Default for Connections {
    fn default() -> Self {
        Self {
            all: 20_000,
            per_address: None,
            first_request: Duration::from_secs(20),
            idle: Duration::from_secs(600),
        }
    }
}

/// Open files other than connections: catalog, logs, the HTTP endpoint, the runtime.
const OTHER_FILES: u64 = 512;

impl Connections {
    /// Creates slots for these bounds, a limit of open files, and the available memory. If the
    /// limit is small, most of it is for connections.
    pub(crate) fn slots(&self, files: u64, memory: MemoryBounds) -> ConnectionSlots {
        let room = files.saturating_sub(OTHER_FILES).max(files / 2);
        let all = self
            .all
            .min(usize::try_from(room).unwrap_or(usize::MAX))
            .min(memory.connections())
            .max(1);
        let share = self.per_address.unwrap_or(all - all / 4);
        ConnectionSlots::new(all, share.clamp(1, all), memory.silent().min(all))
    }
}

/// Raises the limit of open files as far as the system allows. Returns the new limit.
pub(crate) fn raise_open_files() -> u64 {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let limit = getrlimit(Resource::Nofile);
    let raised = Rlimit {
        current: limit.maximum,
        ..limit
    };
    let now = match setrlimit(Resource::Nofile, raised) {
        Ok(()) => limit.maximum,
        Err(error) => {
            tracing::warn!(%error, "the limit of open files stays as it is");
            limit.current
        }
    };
    now.unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_stay_below_the_limit_of_open_files() {
        let slots = |all, per_address, files| {
            let bounds = Connections {
                all,
                per_address,
                ..Connections::default()
            };
            bounds.slots(files, MemoryBounds::default()).bounds()
        };
        assert_eq!(slots(20_000, None, 1 << 20), (20_000, 15_000));
        assert_eq!(slots(20_000, None, 1024), (512, 384));
        assert_eq!(slots(20_000, None, 256), (128, 96));
        assert_eq!(slots(100, Some(500), 1024), (100, 100));
        assert_eq!(slots(100, Some(0), 1024), (100, 1));
    }
}
