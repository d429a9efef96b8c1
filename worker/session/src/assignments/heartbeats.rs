//! Heartbeats and their answers, which renew leases.

use std::time::{Duration, Instant};

use picofarm_proto::{
    ids::LeaseRef,
    messages::{TaskAt, TaskProgress},
};

use super::{Assignments, CurrentTask};
use crate::message::Outgoing;

/// An unanswered heartbeat.
#[derive(Debug)]
pub(super) struct Beat {
    sent: Instant,
    /// Duration of suspends since it was sent.
    slept: Duration,
    leases: Vec<LeaseRef>,
    /// Whether it was sent right after all credit was withdrawn.
    withdrawal: bool,
}

impl Assignments {
    /// Handles a suspend of the machine. The monotonic clock does not count this time, so leases
    /// are older than it indicates. By that clock they may seem to be renewed in time although
    /// other workers already have them.
    pub(crate) fn suspended(&mut self, long: Duration) {
        for held in &mut self.leases {
            // If the clock began later than that, the lease is made as old as possible; its zero
            // lifetime then puts it past the fence.
            match held.renewed_at.checked_sub(long) {
                Some(before) => held.renewed_at = before,
                None => held.ttl = Duration::ZERO,
            }
        }
        for beat in &mut self.beats {
            beat.slept += long;
        }
        // Its end is a wall-clock time.
        self.ends_at = self.ends_at.map(|at| at.checked_sub(long).unwrap_or(at));
    }

    /// Returns when the oldest unanswered heartbeat was sent.
    pub(crate) fn silent_since(&self) -> Option<Instant> {
        self.beats.front().map(|b| b.sent)
    }

    /// Handles the answer to the oldest unanswered heartbeat: the leases `named` are renewed.
    /// Returns the leases that the heartbeat listed and the answer does not. These are lost, and
    /// only tasks already running continue.
    pub(crate) fn renewed(
        &mut self,
        now: Instant,
        named: &[LeaseRef],
        ttl: Duration,
    ) -> Vec<LeaseRef> {
        let beat = self.beats.pop_front();
        if beat.as_ref().is_some_and(|b| b.withdrawal) {
            // Messages keep their order, so every lease granted before the withdrawal has arrived.
            self.asked = false;
        }
        // `None` if that time is before the clock's start; then nothing is renewed.
        let begun = beat
            .as_ref()
            .map_or(Some(now), |b| b.sent.checked_sub(b.slept));
        for held in &mut self.leases {
            if let Some(begun) = begun
                && named.contains(&held.lease)
            {
                held.renewed_at = held.renewed_at.max(begun);
                held.ttl = ttl;
            }
        }
        let mut lost = beat.map(|b| b.leases).unwrap_or_default();
        lost.retain(|l| !named.contains(l) && self.leases.iter().any(|h| h.lease == *l));
        self.leases.retain(|h| !lost.contains(&h.lease));
        lost
    }

    /// Withdraws a request for a lease. Returns the zero credit and a heartbeat; the answer to this
    /// heartbeat proves that no lease is in transit.
    pub(crate) fn withdraw(
        &mut self,
        now: Instant,
        progress: impl Fn(&CurrentTask) -> (f32, TaskAt),
    ) -> Vec<Outgoing> {
        if !self.asked {
            return Vec::new();
        }
        let heartbeat = self.heartbeat(now, progress);
        if let Some(beat) = self.beats.back_mut() {
            beat.withdrawal = true;
        }
        vec![Outgoing::Credit(0), heartbeat]
    }

    /// Returns the heartbeat to send now, with the `progress` and activity of each running task.
    pub(crate) fn heartbeat(
        &mut self,
        now: Instant,
        progress: impl Fn(&CurrentTask) -> (f32, TaskAt),
    ) -> Outgoing {
        let leases = self.held();
        self.beats.push_back(Beat {
            sent: now,
            slept: Duration::ZERO,
            leases: leases.clone(),
            withdrawal: false,
        });
        let progress = self
            .running
            .iter()
            .filter(|t| leases.contains(&t.lease))
            .map(|t| {
                let (fraction, at) = progress(t);
                TaskProgress {
                    lease: t.lease,
                    index: t.task.index,
                    fraction,
                    at,
                }
            })
            .collect();
        Outgoing::Heartbeat {
            leases,
            progress,
            ends_in_ms: self.ends_in_ms(now).unwrap_or(0),
        }
    }
}
