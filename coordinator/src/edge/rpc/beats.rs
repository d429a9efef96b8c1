//! Sessions answer heartbeats at once, for the leases that the actor last reported as live. A lease
//! must not run out because the actor waits for the catalog. The actor still receives each
//! heartbeat, and its answer takes precedence.

use std::{
    collections::{HashMap, VecDeque},
    sync::{Mutex, MutexGuard},
    time::{Duration, Instant},
};

use picofarm_proto::ids::LeaseRef;

use crate::core::ToWorker;

/// Longest time for which leases are extended without an answer of the actor: this time, or the
/// number of lease periods below. Afterwards the worker should look for another coordinator.
const SILENCE: Duration = Duration::from_secs(60);
const LEASES: u32 = 4;

/// A lease that the actor reported as live.
#[derive(Debug, Clone, Copy)]
struct Live {
    /// The number of heartbeats sent to the actor before it last reported the lease as live.
    told: u64,
    /// Tasks with unanswered reports; `None` if unknown, in which case the next answer may be the
    /// last.
    left: Option<u64>,
}

/// The leases of one session.
#[derive(Debug)]
pub(super) struct Beats {
    state: Mutex<State>,
    silence: Duration,
}

#[derive(Debug)]
struct State {
    live: HashMap<LeaseRef, Live>,
    /// Number of heartbeats sent to the actor.
    told: u64,
    /// Heartbeats that the actor has not answered, with the session's own answer.
    open: VecDeque<(u64, Option<Vec<LeaseRef>>)>,
    /// Number of the heartbeat after the worker withdrew its request for leases. The worker takes
    /// the answer to that heartbeat as the end of earlier grants.
    withdrawn: Option<u64>,
    /// Time of the actor's last message.
    heard: Instant,
}

impl Beats {
    pub(super) fn new(lease_ms: u32) -> Self {
        let lease = Duration::from_millis(lease_ms.into());
        Self {
            state: Mutex::new(State {
                live: HashMap::new(),
                told: 0,
                open: VecDeque::new(),
                withdrawn: None,
                heard: Instant::now(),
            }),
            silence: SILENCE.max(lease * LEASES),
        }
    }

    /// Returns the answer to a heartbeat for these leases, if there are any and all of them are
    /// known to be live. Answers stay in order, so there is none while the actor has an unanswered
    /// heartbeat.
    pub(super) fn answer(&self, leases: &[LeaseRef]) -> Option<Vec<LeaseRef>> {
        let state = self.lock();
        let known = leases.iter().all(|lease| state.live.contains_key(lease));
        let owed = state.open.iter().any(|(_, answered)| answered.is_none());
        let heard = state.heard.elapsed() < self.silence;
        let free = !owed && state.withdrawn.is_none();
        (known && heard && free && !leases.is_empty()).then(|| leases.to_vec())
    }

    /// Records that the worker has withdrawn its request for leases.
    pub(super) fn withdraw(&self) {
        let mut state = self.lock();
        state.withdrawn = Some(state.told + 1);
    }

    /// Records a heartbeat sent to the actor, with the session's own answer, if any.
    pub(super) fn tell(&self, answered: Option<Vec<LeaseRef>>) {
        let mut state = self.lock();
        state.told += 1;
        let told = state.told;
        state.open.push_back((told, answered));
    }

    /// Returns the messages to the worker that follow from a message of the actor. Each heartbeat
    /// has one answer.
    pub(super) fn hear(&self, say: ToWorker) -> Vec<ToWorker> {
        let mut state = self.lock();
        state.heard = Instant::now();
        match &say {
            ToWorker::Lease(lease) => {
                let told = state.told;
                let tasks = (lease.hi - lease.lo).saturating_sub(lease.skip.len() as u64);
                let left = Some(tasks);
                state.live.insert(lease.lease, Live { told, left });
            }
            ToWorker::Revoke { lease, .. } => {
                state.live.remove(lease);
            }
            ToWorker::Renewed { leases, .. } => {
                if let Some((told, answered)) = state.open.pop_front() {
                    let instead = state.renewed(told, answered, leases);
                    return instead.unwrap_or_else(|| vec![say]);
                }
            }
            ToWorker::Acknowledge { lease, .. } => {
                let live = state.live.get_mut(lease);
                let left = live.map(|live| {
                    live.left = live.left.map(|left| left.saturating_sub(1));
                    live.left.unwrap_or(0)
                });
                if left == Some(0) {
                    state.live.remove(lease);
                }
            }
            ToWorker::Trim { lease, .. } => {
                if let Some(live) = state.live.get_mut(lease) {
                    live.left = None;
                }
            }
            ToWorker::Drain | ToWorker::Examine(_) | ToWorker::Replaced => {}
        }
        vec![say]
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no panic while locked")
    }
}

impl State {
    /// Handles the actor's answer to a heartbeat. If the session has answered it already, returns
    /// the remaining messages to the worker.
    fn renewed(
        &mut self,
        told: u64,
        answered: Option<Vec<LeaseRef>>,
        leases: &[LeaseRef],
    ) -> Option<Vec<ToWorker>> {
        if self.withdrawn.is_some_and(|at| at <= told) {
            self.withdrawn = None;
        }
        let revoke = |lease: LeaseRef| ToWorker::Revoke {
            lease,
            reason: "the lease is no longer live: it ran out or is finished".into(),
        };
        let instead = answered.map(|answered| {
            let known = answered.into_iter().filter(|l| self.live.contains_key(l));
            let lost = known.filter(|lease| !leases.contains(lease));
            lost.map(revoke).collect()
        });
        // Leases granted since the heartbeat was sent are not among its leases.
        self.live
            .retain(|lease, live| live.told >= told || leases.contains(lease));
        for lease in leases {
            let live = self.live.entry(*lease);
            live.or_insert(Live { told, left: None }).told = told;
        }
        instead
    }
}

#[cfg(test)]
mod tests {
    use picofarm_proto::ids::{Epoch, RangeId};
    use uuid::Uuid;

    use super::*;

    fn lease(n: u128) -> LeaseRef {
        LeaseRef {
            range: RangeId::from_uuid(Uuid::from_u128(n)),
            epoch: Epoch(1),
        }
    }

    fn renewed(leases: &[LeaseRef]) -> ToWorker {
        ToWorker::Renewed {
            leases: leases.to_vec(),
            ttl_ms: 1,
        }
    }

    #[test]
    fn only_what_the_actor_said_is_live_is_prolonged_and_each_heartbeat_has_one_answer() {
        let beats = Beats::new(1_000);
        let (a, b) = (lease(1), lease(2));
        assert_eq!(beats.answer(&[a]), None, "the actor has not said so");
        beats.tell(None);
        assert_eq!(beats.answer(&[]), None, "the actor owes an answer");
        assert_eq!(beats.hear(renewed(&[a])), [renewed(&[a])]);
        assert_eq!(beats.answer(&[a]), Some(vec![a]));
        assert_eq!(beats.answer(&[a, b]), None);
        beats.tell(beats.answer(&[a]));
        assert_eq!(beats.hear(renewed(&[a])), [], "the worker has heard it");
        beats.tell(beats.answer(&[a]));
        let heard = beats.hear(renewed(&[]));
        assert!(
            matches!(&heard[..], [ToWorker::Revoke { lease, .. }] if *lease == a),
            "the actor knows better: {heard:?}"
        );
        assert_eq!(beats.answer(&[a]), None);
    }

    #[test]
    fn a_lease_whose_last_report_was_answered_is_not_prolonged() {
        let beats = Beats::new(1_000);
        let a = lease(1);
        beats.tell(None);
        beats.hear(renewed(&[a]));
        assert_eq!(beats.answer(&[a]), Some(vec![a]));
        beats.hear(ToWorker::Acknowledge {
            lease: a,
            index: 0,
            accepted: true,
            reason: String::new(),
        });
        assert_eq!(beats.answer(&[a]), None, "how many are left is not known");
    }

    #[test]
    fn the_answer_after_a_withdrawal_is_the_actors() {
        let beats = Beats::new(1_000);
        let a = lease(1);
        beats.tell(None);
        beats.hear(renewed(&[a]));
        beats.tell(beats.answer(&[a]));
        beats.withdraw();
        assert_eq!(beats.answer(&[a]), None);
        assert_eq!(beats.hear(renewed(&[a])), [], "this one was sent before it");
        assert_eq!(beats.answer(&[a]), None);
        beats.tell(None);
        assert_eq!(beats.hear(renewed(&[a])), [renewed(&[a])]);
        assert_eq!(beats.answer(&[a]), Some(vec![a]));
    }

    #[test]
    fn a_revoked_lease_is_not_prolonged_and_a_silent_actor_prolongs_none() {
        let mut beats = Beats::new(1_000);
        let (a, b) = (lease(1), lease(2));
        for one in [a, b] {
            beats.tell(None);
            beats.hear(renewed(&[one]));
        }
        assert_eq!(beats.answer(&[a]), None, "the worker named it no more");
        let reason = String::new();
        beats.hear(ToWorker::Revoke { lease: b, reason });
        assert_eq!(beats.answer(&[b]), None);
        beats.tell(None);
        beats.hear(renewed(&[a]));
        beats.silence = Duration::ZERO;
        assert_eq!(beats.answer(&[a]), None);
    }
}
