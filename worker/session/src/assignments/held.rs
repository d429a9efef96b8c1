//! A lease that the worker holds.

use std::{
    collections::BTreeSet,
    sync::Arc,
    time::{Duration, Instant},
};

use picofarm_proto::{
    ids::{JobId, LeaseRef},
    key::StageKey,
    spec::StageSpec,
};

/// A lease and its remaining tasks.
#[derive(Debug)]
pub(super) struct HeldLease {
    pub(super) lease: LeaseRef,
    pub(super) job: JobId,
    pub(super) spec: Arc<StageSpec>,
    pub(super) stage: StageKey,
    pub(super) traceparent: String,
    pub(super) next: u64,
    pub(super) hi: u64,
    pub(super) skip: BTreeSet<u64>,
    /// Start of its current lifetime: when the renewing heartbeat was sent, or when the lease was
    /// received. It is adjusted for suspends of the machine.
    pub(super) renewed_at: Instant,
    pub(super) ttl: Duration,
}

impl HeldLease {
    /// Returns the time after which none of its tasks may be started: after two thirds of its
    /// lifetime.
    pub(super) fn fence(&self) -> Instant {
        self.renewed_at + self.ttl * 2 / 3
    }

    /// Returns the time at which it expires unless it is renewed.
    pub(super) fn end(&self) -> Instant {
        self.renewed_at + self.ttl
    }

    /// Advances `next` to a task that must be run, or to `hi`.
    pub(super) fn pass_skipped(&mut self) {
        while self.next < self.hi && self.skip.contains(&self.next) {
            self.next += 1;
        }
    }
}
