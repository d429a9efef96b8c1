//! How much memory connections, jobs and requests may take.

pub(super) const MIB: u64 = 1 << 20;
/// Memory of the process if no limit is known.
const DEFAULT: u64 = 2048 * MIB;
/// Memory of a worker's connection with its session.
pub(super) const CONNECTION: u64 = 36 << 10;
/// Most memory of a connection without an accepted request: half of a TLS handshake or of a
/// request's headers, or a hundred refusals that the client does not receive.
const SILENT: u64 = 128 << 10;

/// Limit on the memory of a coordinator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryBounds {
    /// Bytes of the whole process, from its control group's limit or an option.
    pub process: u64,
}

impl Default for MemoryBounds {
    fn default() -> Self {
        Self { process: DEFAULT }
    }
}

impl MemoryBounds {
    /// Returns the memory of connections, jobs and requests together. The rest is for the program
    /// and the allocator.
    pub(super) fn pool(self) -> u64 {
        self.process / 4 * 3
    }

    /// Returns the memory of one caller's requests and answers.
    pub(super) fn caller(self) -> u64 {
        self.pool() / 2
    }

    /// Returns the memory of requests and answers on one connection.
    pub(super) fn connection(self) -> u64 {
        self.pool() / 8 * 3
    }

    /// Returns the largest number of connections.
    pub(crate) fn connections(self) -> usize {
        usize::try_from(self.pool() / CONNECTION).unwrap_or(usize::MAX)
    }

    /// Returns the largest number of connections that have not sent a request.
    pub(crate) fn silent(self) -> usize {
        usize::try_from(self.process / 8 / SILENT).unwrap_or(usize::MAX)
    }

    /// Returns the memory of the specs of unfinished jobs, which the coordinator keeps.
    pub(super) fn jobs(self) -> u64 {
        self.process / 4
    }
}

/// Formats bytes as mebibytes.
pub(super) fn mib(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / MIB as f64)
}
