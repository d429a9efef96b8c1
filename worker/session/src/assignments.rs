//! The worker's leases, its running tasks, and its unacknowledged reports. Pure: the time is passed
//! in, and messages to send are returned. See the parent module for the reasoning.

mod heartbeats;
mod held;
mod returns;

use std::{
    collections::VecDeque,
    sync::Arc,
    time::{Duration, Instant},
};

use picofarm_proto::{
    ids::LeaseRef,
    key::StageKey,
    messages::{Failure, FailureKind, Finished, Lease},
};

use crate::{
    executor::{Output, Task, TaskError},
    message::{Outgoing, Report},
    outbox::Outbox,
};
use heartbeats::Beat;
use held::HeldLease;

/// The worker asks for another lease when its remaining work will take at most this time. Thus
/// short tasks do not wait for the coordinator, and long ones are not hoarded.
const AHEAD: Duration = Duration::from_secs(2);

/// A running task.
#[derive(Debug)]
pub(crate) struct CurrentTask {
    /// Its lease.
    pub(crate) lease: LeaseRef,
    /// The task itself.
    pub(crate) task: Task,
    /// Its parent in a trace: at first that of its lease, then its own span.
    pub(crate) traceparent: String,
    /// The time at which it started.
    pub(crate) since: Instant,
}

/// The worker's assignments.
#[derive(Debug)]
pub(crate) struct Assignments {
    leases: Vec<HeldLease>,
    /// The running tasks. All are of one stage.
    running: Vec<CurrentTask>,
    outbox: Outbox,
    /// Unanswered heartbeats of this connection, oldest first. Each answer belongs to the oldest.
    beats: VecDeque<Beat>,
    /// Whether a lease was requested on this connection and has not arrived yet.
    asked: bool,
    /// Duration of the last finished task, and its stage, because it does not predict tasks of
    /// another stage.
    pace: Option<(StageKey, Duration)>,
    /// No new work is started before this time.
    paused_until: Option<Instant>,
    /// When the worker must end, if known.
    ends_at: Option<Instant>,
    draining: bool,
}

impl Assignments {
    /// Returns assignments without leases.
    pub(crate) fn new() -> Self {
        Self {
            leases: Vec::new(),
            running: Vec::new(),
            outbox: Outbox::default(),
            beats: VecDeque::new(),
            asked: false,
            pace: None,
            paused_until: None,
            ends_at: None,
            draining: false,
        }
    }

    /// Returns the leases to list in hello and heartbeat: those with remaining, running or
    /// unacknowledged tasks.
    pub(crate) fn held(&self) -> Vec<LeaseRef> {
        self.leases.iter().map(|h| h.lease).collect()
    }

    /// Returns the running tasks.
    pub(crate) fn running(&self) -> &[CurrentTask] {
        &self.running
    }

    /// Returns the number of unacknowledged reports.
    pub(crate) fn unacknowledged(&self) -> usize {
        self.outbox.len()
    }

    /// Returns the number of unacknowledged finished tasks.
    pub(crate) fn unacknowledged_outputs(&self) -> usize {
        self.outbox.finished()
    }

    /// Handles a lost connection: everything sent over it must be sent again.
    pub(crate) fn disconnected(&mut self) {
        self.outbox.rewind();
        self.beats.clear();
        self.asked = false;
    }

    /// Sets the time at which the worker must end.
    pub(crate) fn must_end(&mut self, at: Instant) {
        self.ends_at = Some(at);
    }

    /// Returns the time at which the worker must end, if known.
    pub(crate) fn ends_at(&self) -> Option<Instant> {
        self.ends_at
    }

    /// Returns the milliseconds until the worker must end, at least 1, if known.
    pub(crate) fn ends_in_ms(&self, now: Instant) -> Option<u64> {
        let left = self.ends_at?.saturating_duration_since(now);
        Some(u64::try_from(left.as_millis()).unwrap_or(u64::MAX).max(1))
    }

    /// Adds a received lease. Returns `false` if the worker already has it.
    pub(crate) fn granted(&mut self, now: Instant, lease: Lease) -> bool {
        self.asked = false;
        if self.leases.iter().any(|h| h.lease == lease.lease) {
            return false;
        }
        self.leases.push(HeldLease {
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

    /// Handles a revoked lease. Returns `true` if running tasks belong to it and must stop. This is
    /// the case only if the lease was still live, because then its work is not wanted. A lease that
    /// had already expired is merely lost.
    pub(crate) fn revoked(&mut self, now: Instant, lease: LeaseRef) -> bool {
        let live = self
            .leases
            .iter()
            .any(|h| h.lease == lease && now < h.end());
        self.leases.retain(|h| h.lease != lease);
        live && self.running.iter().any(|t| t.lease == lease)
    }

    /// Handles a lease with tasks from `hi` on moved to another worker.
    pub(crate) fn trimmed(&mut self, lease: LeaseRef, hi: u64) {
        if let Some(held) = self.leases.iter_mut().find(|h| h.lease == lease) {
            held.hi = held.hi.min(hi);
            held.next = held.next.min(held.hi);
        }
        self.tidy();
    }

    /// Handles an acknowledgement. Returns the report that it answers.
    pub(crate) fn acknowledged(&mut self, lease: LeaseRef, index: u64) -> Option<Report> {
        let report = self.outbox.acknowledge(lease, index);
        self.tidy();
        report
    }

    /// Takes the next task that may be started: if none is running, or if fewer tasks of its stage
    /// are running than may run `together`.
    pub(crate) fn begin(
        &mut self,
        now: Instant,
        together: impl Fn(&Task) -> usize,
    ) -> Option<Task> {
        if self.draining || self.paused(now) {
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
        let other = |t: &CurrentTask| t.task.stage != task.stage || t.task.job != task.job;
        if !self.running.is_empty()
            && (self.running.iter().any(other) || self.running.len() >= together(&task))
        {
            return None;
        }
        held.next += 1;
        held.pass_skipped();
        self.running.push(CurrentTask {
            lease: held.lease,
            task: task.clone(),
            traceparent: held.traceparent.clone(),
            since: now,
        });
        Some(task)
    }

    /// Records the own span of the task that was begun last in a trace.
    pub(crate) fn traced(&mut self, traceparent: String) {
        if let Some(hand) = self.running.last_mut() {
            hand.traceparent = traceparent;
        }
    }

    /// Handles the end of a running task. Its report goes to the outbox: every finished task,
    /// even if its lease is lost (the output is valid anyway), and failures only if the worker
    /// still has the lease.
    pub(crate) fn ended(
        &mut self,
        now: Instant,
        (lease, index): (LeaseRef, u64),
        result: &Result<Output, TaskError>,
    ) -> CurrentTask {
        let mut running = self.running.iter();
        let at = running.position(|t| (t.lease, t.task.index) == (lease, index));
        let hand = self
            .running
            .remove(at.expect("only a running task can end"));
        let held = self.leases.iter().any(|h| h.lease == hand.lease);
        let shared = u32::try_from(self.running.len() + 1).unwrap_or(u32::MAX);
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
                shared,
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
                milliseconds: u64::try_from((now - hand.since).as_millis()).unwrap_or(0),
                shared,
            })),
        }
        self.tidy();
        hand
    }

    fn paused(&mut self, now: Instant) -> bool {
        if self.paused_until.is_some_and(|until| now >= until) {
            self.paused_until = None;
        }
        self.paused_until.is_some()
    }

    /// Returns whether to ask for a lease: none is in transit, and the work is finished or soon
    /// will be. After a stage of short tasks, a task of another stage may take days. Therefore no
    /// lease is requested while the worker has tasks of another stage.
    fn wants(&self) -> bool {
        let waiting: u64 = self.leases.iter().map(|h| h.hi - h.next).sum();
        let left = waiting + self.running.len() as u64;
        let ahead = self.leases.iter().filter(|h| h.next < h.hi);
        let current = self.running.iter().map(|hand| hand.task.stage);
        let mut stages = ahead.map(|h| h.stage).chain(current);
        let soon_over = self.pace.is_some_and(|(stage, pace)| {
            if stages.any(|other| other != stage) {
                return false;
            }
            let left = left.div_ceil(self.running.len().max(1) as u64);
            let left = u32::try_from(left).unwrap_or(u32::MAX);
            pace.saturating_mul(left) <= AHEAD
        });
        !self.asked && !self.draining && (left == 0 || soon_over)
    }

    /// Returns the messages to send now: reports not yet sent on this connection, and a request for
    /// a lease.
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

    /// Returns whether a lease may be in transit to this worker.
    pub(crate) fn expects_lease(&self) -> bool {
        self.asked
    }

    /// Drops leases that are finished and have no unacknowledged reports.
    fn tidy(&mut self) {
        let (running, outbox) = (&self.running, &self.outbox);
        let runs = |lease| running.iter().any(|t| t.lease == lease);
        self.leases
            .retain(|h| h.next < h.hi || runs(h.lease) || outbox.mentions(h.lease));
    }
}
