//! What the worker holds: its leases, the task in hand, the reports not yet acknowledged. Pure: the time is
//! passed in, and what is to be sent is returned. See the parent module for the reasoning.

use std::{
    collections::{BTreeSet, VecDeque},
    sync::Arc,
    time::{Duration, Instant},
};

use picofarm_proto::{
    ids::{JobId, LeaseRef},
    key::StageKey,
    model::{Failure, FailureKind, Finished, Lease, StageSpec, TaskAt, TaskProgress},
};

use crate::executor::{Output, Task, TaskError};
use crate::{
    message::{Outgoing, Report},
    outbox::Outbox,
};

/// A further lease is asked for when the work at hand will last no longer than this, so that short tasks do not
/// wait for the coordinator and long ones are not hoarded.
const AHEAD: Duration = Duration::from_secs(2);

/// A lease and what is left of it.
#[derive(Debug)]
struct Held {
    lease: LeaseRef,
    job: JobId,
    spec: Arc<StageSpec>,
    stage: StageKey,
    traceparent: String,
    next: u64,
    hi: u64,
    skip: BTreeSet<u64>,
    /// When its present life began: at the sending of the heartbeat that renewed it, or at its receipt; by a clock that
    /// goes on while the machine is suspended.
    renewed_at: Instant,
    ttl: Duration,
}

impl Held {
    /// From here on no task of it may be started: two thirds of its life are over.
    fn fence(&self) -> Instant {
        self.renewed_at + self.ttl * 2 / 3
    }

    /// When it ends unless it is renewed.
    fn end(&self) -> Instant {
        self.renewed_at + self.ttl
    }

    /// Moves `next` to a task that is to be run, or to `hi`.
    fn pass_skipped(&mut self) {
        while self.next < self.hi && self.skip.contains(&self.next) {
            self.next += 1;
        }
    }
}

/// The task in hand.
#[derive(Debug)]
pub(crate) struct InHand {
    /// Its lease.
    pub(crate) lease: LeaseRef,
    /// What runs.
    pub(crate) task: Task,
    /// Where it is in a trace: at first where its lease is, then its own place.
    pub(crate) traceparent: String,
    /// Since when.
    pub(crate) since: Instant,
}

/// A heartbeat whose answer is awaited.
#[derive(Debug)]
struct Beat {
    sent: Instant,
    /// How long the machine was suspended since.
    slept: Duration,
    leases: Vec<LeaseRef>,
    /// It went out right after the withdrawal of all credit.
    withdrawal: bool,
}

/// The worker's assignments.
#[derive(Debug)]
pub(crate) struct Assignments {
    leases: Vec<Held>,
    in_hand: Option<InHand>,
    outbox: Outbox,
    /// Heartbeats of this connection without an answer, oldest first. Each answer belongs to the oldest.
    beats: VecDeque<Beat>,
    /// A lease has been asked for on this connection and not received yet.
    asked: bool,
    /// How long the last finished task took, and its stage: it tells nothing of another stage's tasks.
    pace: Option<(StageKey, Duration)>,
    /// No new work before this time.
    paused_until: Option<Instant>,
    /// When the worker must end, where that is known.
    ends_at: Option<Instant>,
    draining: bool,
}

impl Assignments {
    /// An empty assignments.
    pub(crate) fn new() -> Self {
        Self {
            leases: Vec::new(),
            in_hand: None,
            outbox: Outbox::default(),
            beats: VecDeque::new(),
            asked: false,
            pace: None,
            paused_until: None,
            ends_at: None,
            draining: false,
        }
    }

    /// Leases to name in hello and heartbeat: those with work left, in hand or unacknowledged.
    pub(crate) fn held(&self) -> Vec<LeaseRef> {
        self.leases.iter().map(|h| h.lease).collect()
    }

    /// The task in hand.
    pub(crate) fn in_hand(&self) -> Option<&InHand> {
        self.in_hand.as_ref()
    }

    /// Reports without an acknowledgement.
    pub(crate) fn unacknowledged(&self) -> usize {
        self.outbox.len()
    }

    /// Finished tasks without an acknowledgement.
    pub(crate) fn unacknowledged_outputs(&self) -> usize {
        self.outbox.finished()
    }

    /// The connection is gone: what was sent over it must be sent again.
    pub(crate) fn disconnected(&mut self) {
        self.outbox.rewind();
        self.beats.clear();
        self.asked = false;
    }

    /// The machine was suspended for so long, which the monotonic clock does not count: leases are older than it says. Those
    /// that are renewed in time by that clock alone may be others' by now.
    pub(crate) fn suspended(&mut self, long: Duration) {
        for held in &mut self.leases {
            // Where the clock began less than that ago, as old as can be said; the fence is then passed by the time to live.
            match held.renewed_at.checked_sub(long) {
                Some(before) => held.renewed_at = before,
                None => held.ttl = Duration::ZERO,
            }
        }
        for beat in &mut self.beats {
            beat.slept += long;
        }
        // Its end is a time of day.
        self.ends_at = self.ends_at.map(|at| at.checked_sub(long).unwrap_or(at));
    }

    /// The worker must end then.
    pub(crate) fn must_end(&mut self, at: Instant) {
        self.ends_at = Some(at);
    }

    /// When the worker must end, where that is known.
    pub(crate) fn ends_at(&self) -> Option<Instant> {
        self.ends_at
    }

    /// Milliseconds until the worker must end, at least 1, where that is known.
    pub(crate) fn ends_in_ms(&self, now: Instant) -> Option<u64> {
        let left = self.ends_at?.saturating_duration_since(now);
        Some(u64::try_from(left.as_millis()).unwrap_or(u64::MAX).max(1))
    }

    /// When the oldest unanswered heartbeat was sent.
    pub(crate) fn silent_since(&self) -> Option<Instant> {
        self.beats.front().map(|b| b.sent)
    }

    /// A lease arrives. `false` if it is held already.
    pub(crate) fn granted(&mut self, now: Instant, lease: Lease) -> bool {
        self.asked = false;
        if self.leases.iter().any(|h| h.lease == lease.lease) {
            return false;
        }
        self.leases.push(Held {
            lease: lease.lease,
            job: lease.job,
            stage: lease.key,
            traceparent: lease.traceparent,
            spec: Arc::new(lease.stage),
            next: lease.lo,
            hi: lease.hi,
            skip: lease.skip.into_iter().collect(),
            renewed_at: now,
            ttl: Duration::from_millis(lease.ttl_ms.into()),
        });
        let held = self.leases.last_mut().expect("just pushed");
        held.pass_skipped();
        if held.next == held.hi {
            self.release(lease.lease, "it names no task that is still to run");
        } else if self.draining {
            self.release(lease.lease, "the worker is shutting down");
        }
        true
    }

    /// A lease arrived that cannot be used: it goes back.
    pub(crate) fn unusable(&mut self, lease: Option<LeaseRef>, why: &str) {
        self.asked = false;
        if let Some(lease) = lease {
            self.outbox.push(Report::Release {
                lease,
                reason: format!("the worker cannot use this lease: {why}"),
            });
        }
    }

    /// The answer to the oldest unanswered heartbeat: `named` live on. Returns the leases that the heartbeat
    /// named and the answer does not: they are lost, and only a task already running goes on.
    pub(crate) fn renewed(
        &mut self,
        now: Instant,
        named: &[LeaseRef],
        ttl: Duration,
    ) -> Vec<LeaseRef> {
        let beat = self.beats.pop_front();
        if beat.as_ref().is_some_and(|b| b.withdrawal) {
            // Answers keep their order: whatever was granted before the withdrawal has arrived.
            self.asked = false;
        }
        // `None` where that is longer ago than the clock can say: then nothing is renewed by it.
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

    /// A lease is revoked. `true` if the task in hand belongs to it and must stop: only while the lease was
    /// live, for then the work is not wanted. One that had run out is merely lost.
    pub(crate) fn revoked(&mut self, now: Instant, lease: LeaseRef) -> bool {
        let live = self
            .leases
            .iter()
            .any(|h| h.lease == lease && now < h.end());
        self.leases.retain(|h| h.lease != lease);
        live && self.in_hand.as_ref().is_some_and(|t| t.lease == lease)
    }

    /// Tasks of a lease from `hi` on are another worker's.
    pub(crate) fn trimmed(&mut self, lease: LeaseRef, hi: u64) {
        if let Some(held) = self.leases.iter_mut().find(|h| h.lease == lease) {
            held.hi = held.hi.min(hi);
            held.next = held.next.min(held.hi);
        }
        self.tidy();
    }

    /// An acknowledgement arrived. Returns the report it answers.
    pub(crate) fn acknowledged(&mut self, lease: LeaseRef, index: u64) -> Option<Report> {
        let report = self.outbox.acknowledge(lease, index);
        self.tidy();
        report
    }

    /// Takes the next task that may be started, if the hand is free.
    pub(crate) fn begin(&mut self, now: Instant) -> Option<Task> {
        if self.in_hand.is_some() || self.draining || self.paused(now) {
            return None;
        }
        let held = self
            .leases
            .iter_mut()
            .find(|h| h.next < h.hi && now < h.fence())?;
        let task = Task {
            job: held.job,
            spec: held.spec.clone(),
            stage: held.stage,
            index: held.next,
        };
        held.next += 1;
        held.pass_skipped();
        self.in_hand = Some(InHand {
            lease: held.lease,
            task: task.clone(),
            traceparent: held.traceparent.clone(),
            since: now,
        });
        Some(task)
    }

    /// The task in hand has a place of its own in a trace.
    pub(crate) fn traced(&mut self, traceparent: String) {
        if let Some(hand) = &mut self.in_hand {
            hand.traceparent = traceparent;
        }
    }

    /// The task in hand ended. What is to be reported goes to the outbox: every finished task, even if its lease
    /// is lost (the output stands); failures only where the lease is still held.
    pub(crate) fn ended(&mut self, now: Instant, result: &Result<Output, TaskError>) -> InHand {
        let hand = self
            .in_hand
            .take()
            .expect("only the task in hand can end: the runner runs one at a time");
        let held = self.leases.iter().any(|h| h.lease == hand.lease);
        if result.is_ok() {
            self.pace = Some((hand.task.stage, now - hand.since));
        }
        match result {
            Ok(output) => self.outbox.push(Report::Done(Finished {
                lease: hand.lease,
                index: hand.task.index,
                key: hand.task.key(),
                manifest_sha256: output.manifest_sha256.clone(),
                bytes: output.bytes,
                seconds: (now - hand.since).as_secs_f64(),
                adopted: output.adopted,
                traceparent: hand.traceparent.clone(),
            })),
            Err(_) if !held => {}
            Err(TaskError::Stopped) => self.release(hand.lease, "the task was stopped half-way"),
            Err(error) => self.outbox.push(Report::Failed(Failure {
                lease: hand.lease,
                index: hand.task.index,
                kind: match error {
                    TaskError::User(_) => FailureKind::User,
                    TaskError::Crash(_) => FailureKind::Crash,
                    TaskError::Interrupted(_) | TaskError::Stopped => FailureKind::Interrupted,
                    TaskError::Store(_) => FailureKind::Store,
                    TaskError::Damaged(_) => FailureKind::Damaged,
                },
                message: error.to_string(),
            })),
        }
        self.tidy();
        hand
    }

    /// Gives every lease with work left back and takes no more until `until`.
    pub(crate) fn pause(&mut self, until: Instant, reason: &str) {
        self.paused_until = Some(until);
        self.release_all(reason);
    }

    /// The end of a pause that is still to come.
    pub(crate) fn paused_until(&self) -> Option<Instant> {
        self.paused_until
    }

    fn paused(&mut self, now: Instant) -> bool {
        if self.paused_until.is_some_and(|until| now >= until) {
            self.paused_until = None;
        }
        self.paused_until.is_some()
    }

    /// From now on no task is started and no lease asked for.
    pub(crate) fn drain(&mut self) {
        self.draining = true;
    }

    /// Gives back every lease that has work left or in hand.
    pub(crate) fn release_all(&mut self, reason: &str) {
        let in_hand = self.in_hand.as_ref().map(|t| t.lease);
        let open: Vec<_> = self
            .leases
            .iter()
            .filter(|h| h.next < h.hi || Some(h.lease) == in_hand)
            .map(|h| h.lease)
            .collect();
        for lease in open {
            self.release(lease, reason);
        }
    }

    /// Gives back every lease with work left but for the one in hand, of which the rest is given back with it.
    pub(crate) fn release_waiting(&mut self, reason: &str) {
        let in_hand = self.in_hand.as_ref().map(|t| t.lease);
        let open: Vec<_> = self
            .leases
            .iter()
            .filter(|h| h.next < h.hi && Some(h.lease) != in_hand)
            .map(|h| h.lease)
            .collect();
        for lease in open {
            self.release(lease, reason);
        }
    }

    fn release(&mut self, lease: LeaseRef, reason: &str) {
        self.leases.retain(|h| h.lease != lease);
        self.outbox.push(Report::Release {
            lease,
            reason: reason.to_owned(),
        });
    }

    /// Whether to ask for a lease: none is on its way, and the work at hand is over or soon will be. After a stage of short
    /// tasks, one of another stage may take days: while any is held, no more is asked for.
    fn wants(&self) -> bool {
        let waiting: u64 = self.leases.iter().map(|h| h.hi - h.next).sum();
        let left = waiting + u64::from(self.in_hand.is_some());
        let ahead = self.leases.iter().filter(|h| h.next < h.hi);
        let in_hand = self.in_hand.iter().map(|hand| hand.task.stage);
        let mut stages = ahead.map(|h| h.stage).chain(in_hand);
        let soon_over = self.pace.is_some_and(|(stage, pace)| {
            if stages.any(|other| other != stage) {
                return false;
            }
            let left = u32::try_from(left).unwrap_or(u32::MAX);
            pace.saturating_mul(left) <= AHEAD
        });
        !self.asked && !self.draining && (left == 0 || soon_over)
    }

    /// What is to be sent now: reports not yet sent on this connection, and the wish for a lease.
    pub(crate) fn outgoing(&mut self, now: Instant) -> Vec<Outgoing> {
        let mut messages: Vec<_> = self
            .outbox
            .unsent()
            .into_iter()
            .map(Outgoing::Report)
            .collect();
        if !self.paused(now) && self.wants() {
            self.asked = true;
            messages.push(Outgoing::Credit(1));
        }
        messages
    }

    /// Takes back what was asked for: the credit, and a heartbeat whose answer shows that no lease is under way
    /// any more.
    pub(crate) fn withdraw(&mut self, now: Instant, fraction: f32, at: TaskAt) -> Vec<Outgoing> {
        if !self.asked {
            return Vec::new();
        }
        let heartbeat = self.heartbeat(now, fraction, at);
        if let Some(beat) = self.beats.back_mut() {
            beat.withdrawal = true;
        }
        vec![Outgoing::Credit(0), heartbeat]
    }

    /// Whether a lease may be under way to this worker.
    pub(crate) fn expects_lease(&self) -> bool {
        self.asked
    }

    /// The heartbeat to send now.
    pub(crate) fn heartbeat(&mut self, now: Instant, fraction: f32, at: TaskAt) -> Outgoing {
        let leases = self.held();
        self.beats.push_back(Beat {
            sent: now,
            slept: Duration::ZERO,
            leases: leases.clone(),
            withdrawal: false,
        });
        let progress = self
            .in_hand
            .iter()
            .filter(|t| leases.contains(&t.lease))
            .map(|t| TaskProgress {
                lease: t.lease,
                index: t.task.index,
                fraction,
                at: at.clone(),
            })
            .collect();
        Outgoing::Heartbeat {
            leases,
            progress,
            ends_in_ms: self.ends_in_ms(now).unwrap_or(0),
        }
    }

    /// Forgets leases that are worked off and about which nothing waits for an acknowledgement.
    fn tidy(&mut self) {
        let in_hand = self.in_hand.as_ref().map(|t| t.lease);
        let outbox = &self.outbox;
        self.leases
            .retain(|h| h.next < h.hi || Some(h.lease) == in_hand || outbox.mentions(h.lease));
    }
}
