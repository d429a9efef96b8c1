//! The messages of the core to workers.

use picofarm_proto::{
    ids::LeaseRef,
    messages::{Examine, Lease},
};

/// Number of a session, unique in this process.
pub(crate) type SessionId = u64;

/// A message to a worker, sent once the changes are durable.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum ToWorker {
    Lease(Box<Lease>),
    Acknowledge {
        lease: LeaseRef,
        index: u64,
        accepted: bool,
        reason: String,
    },
    Renewed {
        leases: Vec<LeaseRef>,
        ttl_ms: u32,
    },
    Revoke {
        lease: LeaseRef,
        reason: String,
    },
    /// Tasks of this lease from `hi` on now belong to another worker.
    Trim {
        lease: LeaseRef,
        hi: u64,
    },
    /// Finish the current tasks, then end.
    Drain,
    /// Check the machine.
    Examine(Examine),
    /// The session ends because a newer one has replaced it.
    Replaced,
}
