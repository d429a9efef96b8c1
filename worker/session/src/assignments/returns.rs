//! Gives leases back to the coordinator.

use std::time::Instant;

use picofarm_proto::ids::LeaseRef;

use super::Assignments;
use crate::message::Report;

impl Assignments {
    /// Returns an unusable lease to the coordinator.
    pub(crate) fn unusable(&mut self, lease: Option<LeaseRef>, why: &str) {
        self.asked = false;
        if let Some(lease) = lease {
            self.outbox.push(Report::Release {
                lease,
                reason: format!("the worker cannot use this lease: {why}"),
            });
        }
    }

    /// Gives back every lease with remaining tasks, and accepts no work until `until`.
    pub(crate) fn pause(&mut self, until: Instant, reason: &str) {
        self.paused_until = Some(until);
        self.release_all(reason);
    }

    /// Returns the end of the current pause.
    pub(crate) fn paused_until(&self) -> Option<Instant> {
        self.paused_until
    }

    /// From now on, no task is started and no lease requested.
    pub(crate) fn drain(&mut self) {
        self.draining = true;
    }

    /// Gives back every lease with remaining or running tasks.
    pub(crate) fn release_all(&mut self, reason: &str) {
        let open: Vec<_> = self
            .leases
            .iter()
            .filter(|h| h.next < h.hi || self.runs(h.lease))
            .map(|h| h.lease)
            .collect();
        for lease in open {
            self.release(lease, reason);
        }
    }

    /// Gives back every lease with remaining tasks, except those of running tasks; their remaining
    /// tasks are given back when these end.
    pub(crate) fn release_waiting(&mut self, reason: &str) {
        let open: Vec<_> = self
            .leases
            .iter()
            .filter(|h| h.next < h.hi && !self.runs(h.lease))
            .map(|h| h.lease)
            .collect();
        for lease in open {
            self.release(lease, reason);
        }
    }

    /// Returns whether a task of the lease is running.
    fn runs(&self, lease: LeaseRef) -> bool {
        self.running.iter().any(|t| t.lease == lease)
    }

    pub(super) fn release(&mut self, lease: LeaseRef, reason: &str) {
        self.leases.retain(|h| h.lease != lease);
        self.outbox.push(Report::Release {
            lease,
            reason: reason.to_owned(),
        });
    }
}
