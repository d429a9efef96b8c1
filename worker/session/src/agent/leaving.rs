//! Ends the worker: it gives back its leases, lets tasks finish or save their progress, and waits
//! for acknowledgements.

use std::time::{Duration, Instant};

use tracing::{info, warn};

use super::{Agent, connection::Link};
use crate::assignments::CurrentTask;

/// A running task with at most this remaining time may finish after the shutdown signal.
const FINISH_WITHIN: Duration = Duration::from_millis(1500);
/// Maximum time that a draining worker waits for its task.
const LONGEST_TASK: Duration = Duration::from_secs(30 * 86_400);
/// Maximum time for a task to stop before the worker leaves without it.
const STOP_WITHIN: Duration = Duration::from_secs(10);
/// The same limit for a task that saves its progress, because it may send gigabytes to a remote
/// store.
const SAVE_WITHIN: Duration = Duration::from_secs(300);
/// Maximum time to wait for acknowledgements before leaving.
const GOODBYE_WITHIN: Duration = Duration::from_secs(3);
const SHUTDOWN: &str = "the worker is shutting down";

/// How quickly to leave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Haste {
    /// At once.
    Stop,
    /// After the running task.
    Finish,
}

/// The state of a shutdown.
pub(super) struct Leaving {
    pub(super) haste: Haste,
    /// The running task is asked to stop at this time.
    pub(super) stop_at: Instant,
    /// The worker leaves at this time, regardless of running tasks or missing acknowledgements.
    pub(super) give_up: Instant,
    released: bool,
}

impl Agent {
    /// Ends a worker that has been idle for too long.
    pub(super) fn idle(&mut self, now: Instant) {
        let connected = matches!(self.link, Link::Up { .. });
        if !self.assignments.running().is_empty() || self.leaving.is_some() || !connected {
            self.idle_since = None;
            return;
        }
        let since = *self.idle_since.get_or_insert(now);
        if self.exit_idle.is_some_and(|most| now - since >= most) {
            info!(idle_s = (now - since).as_secs_f64(), "nothing to do");
            self.begin_leaving(Haste::Stop);
        }
    }

    /// Ends a worker at the end of its time.
    pub(super) fn end_in_time(&mut self, now: Instant) {
        let over = self.assignments.ends_at().is_some_and(|at| now >= at);
        let stopping = self
            .leaving
            .as_ref()
            .is_some_and(|l| l.haste == Haste::Stop);
        if over && !stopping {
            info!("the worker's time is over");
            self.begin_leaving(Haste::Stop);
        }
    }

    /// Begins to leave, because of a shutdown signal or the coordinator's request.
    pub(super) fn begin_leaving(&mut self, haste: Haste) {
        let now = Instant::now();
        self.assignments.drain();
        let nearly_done = self
            .remaining(now)
            .is_some_and(|left| left <= FINISH_WITHIN);
        let mut running = self.assignments.running().iter();
        let saves = running.any(|hand| hand.task.spec.task.resumes());
        let stop_at = match haste {
            Haste::Finish if saves => now,
            Haste::Finish => now + LONGEST_TASK,
            Haste::Stop if nearly_done => now + FINISH_WITHIN,
            Haste::Stop => now,
        };
        info!(
            running = self.assignments.running().len(),
            nearly_done,
            ?haste,
            "shutting down"
        );
        self.assignments.release_waiting(SHUTDOWN);
        if let Link::Up { session, .. } = &self.link {
            let progress = |task: &CurrentTask| self.lanes.progress(task);
            for message in self.assignments.withdraw(now, progress) {
                session.send(message);
            }
        }
        self.leaving = Some(Leaving {
            haste,
            stop_at,
            give_up: stop_at + if saves { SAVE_WITHIN } else { STOP_WITHIN },
            released: false,
        });
    }

    /// Estimates the remaining time of the running tasks from their progress so far. Returns `None`
    /// if no task is running, or one has made no progress.
    fn remaining(&self, now: Instant) -> Option<Duration> {
        let mut longest = None;
        for hand in self.assignments.running() {
            let fraction = self.lanes.control(hand)?.fraction();
            let left = (now - hand.since).as_secs_f64() * f64::from((1.0 - fraction) / fraction);
            longest = longest.max(Some(Duration::try_from_secs_f64(left).ok()?));
        }
        longest
    }

    /// Takes the next step of leaving. Returns `true` when the worker may end.
    pub(super) fn leave(&mut self, now: Instant) -> bool {
        let Some(leaving) = &mut self.leaving else {
            return false;
        };
        let running = !self.assignments.running().is_empty();
        if running && now < leaving.give_up {
            if now >= leaving.stop_at {
                self.lanes.stop();
            }
            return false;
        }
        if !leaving.released {
            if running {
                warn!("not all running tasks stopped; the worker leaves without them");
            }
            leaving.released = true;
            leaving.give_up = now + GOODBYE_WITHIN;
            self.assignments.release_all(SHUTDOWN);
        }
        // A lease in transit would be blocked until it expires, so the worker waits for it and
        // gives it back.
        let all_said = self.assignments.unacknowledged() == 0 && !self.assignments.expects_lease();
        all_said || now >= leaving.give_up
    }
}
