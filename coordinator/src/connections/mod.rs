//! Connections: how many there may be, for how long they may say nothing, and how TLS begins on them.

mod doors;
mod incoming;
mod streams;
mod watched;

use std::time::Duration;

use crate::memory::MemoryBounds;

pub(crate) use doors::{Counts, Doors, Group, Place};
pub(crate) use incoming::{Peer, accept};
pub(crate) use streams::Streams;
pub(crate) use watched::follow as follow_certificates;

/// Bounds on connections to the gRPC port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Connections {
    /// At a time; by default 20,000. Never more than the limit of open files allows.
    pub all: usize,
    /// Of one remote address (of IPv6 one /64 network); by default three quarters of all.
    pub per_address: Option<usize>,
    /// A connection on which no request was let in for so long is closed (default 20 s).
    pub first_request: Duration,
    /// One without open streams for so long is closed (default 10 min). Clients open another when they need one.
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

/// Files that the process opens besides connections: catalog, logs, the HTTP endpoint, the runtime.
const OTHER_FILES: u64 = 512;

impl Connections {
    /// Doors for these bounds where so many files may be open and there is so much memory. The greater part of a small limit
    /// of files is for connections.
    pub(crate) fn doors(&self, files: u64, memory: MemoryBounds) -> Doors {
        let room = files.saturating_sub(OTHER_FILES).max(files / 2);
        let all = self
            .all
            .min(usize::try_from(room).unwrap_or(usize::MAX))
            .min(memory.connections())
            .max(1);
        let share = self.per_address.unwrap_or(all - all / 4);
        Doors::new(all, share.clamp(1, all), memory.silent().min(all))
    }
}

/// Raises the limit of open files as far as the system lets us; returns it.
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
        let doors = |all, per_address, files| {
            let bounds = Connections {
                all,
                per_address,
                ..Connections::default()
            };
            bounds.doors(files, MemoryBounds::default()).bounds()
        };
        assert_eq!(doors(20_000, None, 1 << 20), (20_000, 15_000));
        assert_eq!(doors(20_000, None, 1024), (512, 384));
        assert_eq!(doors(20_000, None, 256), (128, 96));
        assert_eq!(doors(100, Some(500), 1024), (100, 100));
        assert_eq!(doors(100, Some(0), 1024), (100, 1));
    }
}
