//! The connection to a coordinator: it is opened, used, lost and opened again.

use std::{
    future::Future,
    pin::Pin,
    time::{Duration, Instant},
};

use tracing::{error, info, warn};

use super::{Agent, leaving::Haste};
use crate::{
    AgentError, Target,
    assignments::CurrentTask,
    backoff::random,
    message::Incoming,
    session::{self, LinkError, Session, Welcome},
};

/// After a session of at least this duration, the next reconnect begins with a short wait.
const GOOD_SESSION: Duration = Duration::from_secs(10);
/// Maximum wait before the next coordinator of the list is tried, so that the workers of a lost
/// coordinator do not all reconnect at the same moment.
const NEXT_COORDINATOR: Duration = Duration::from_millis(300);

type Opening = Pin<Box<dyn Future<Output = Result<(Welcome, Box<Session>), LinkError>> + Send>>;

/// The connection to a coordinator.
pub(super) enum Link {
    /// Not connected; the next attempt is at this time.
    Down(Instant),
    Opening(Opening),
    Up {
        session: Box<Session>,
        welcome: Welcome,
        since: Instant,
        next_beat: Instant,
    },
}

/// An event of the connection.
pub(super) enum Event {
    Retry,
    Opened(Result<(Welcome, Box<Session>), LinkError>),
    Received(Result<Incoming, LinkError>),
    Beat,
}

impl Link {
    /// Returns the connection's next event. Cancel-safe.
    pub(super) async fn event(&mut self) -> Event {
        match self {
            Link::Down(until) => {
                tokio::time::sleep_until((*until).into()).await;
                Event::Retry
            }
            Link::Opening(opening) => Event::Opened(opening.await),
            Link::Up {
                session, next_beat, ..
            } => tokio::select! {
                received = session.receive() => Event::Received(received),
                () = tokio::time::sleep_until((*next_beat).into()) => Event::Beat,
            },
        }
    }
}

impl Agent {
    fn current_target(&self) -> &Target {
        &self.targets[self.target]
    }

    pub(super) fn link_event(&mut self, event: Event) -> Result<(), AgentError> {
        let now = Instant::now();
        match event {
            Event::Retry => {
                let mut hello = self.hello.clone();
                hello.held = self.assignments.held();
                hello.ends_in_ms = self.assignments.ends_in_ms(now);
                self.link = Link::Opening(Box::pin(session::open(
                    self.current_target().clone(),
                    hello,
                )));
            }
            Event::Opened(Ok((welcome, session))) => {
                self.welcomed = true;
                match self.away_since.take() {
                    Some(since) => {
                        self.summary.reconnects += 1;
                        info!(
                            away_s = (now - since).as_secs_f64(),
                            held = self.assignments.held().len(),
                            unacknowledged = self.assignments.unacknowledged(),
                            "reconnected"
                        );
                    }
                    None => info!(coordinator = self.coordinator, "connected"),
                }
                self.link = Link::Up {
                    session,
                    welcome,
                    since: now,
                    next_beat: now,
                };
            }
            Event::Opened(Err(error)) | Event::Received(Err(error)) => self.lost(now, error)?,
            Event::Received(Ok(message)) => self.received(now, message),
            Event::Beat => self.beat(now)?,
        }
        Ok(())
    }

    fn beat(&mut self, now: Instant) -> Result<(), AgentError> {
        let Link::Up {
            session,
            welcome,
            next_beat,
            ..
        } = &mut self.link
        else {
            return Ok(());
        };
        let silent = self.assignments.silent_since().map(|since| now - since);
        if let Some(silent) = silent.filter(|s| *s > welcome.lease / 2) {
            let text = format!("no answer to heartbeats for {:.1} s", silent.as_secs_f64());
            return self.lost(now, LinkError::Down(text));
        }
        let progress = |task: &CurrentTask| self.lanes.progress(task);
        session.send(self.assignments.heartbeat(now, progress));
        *next_beat = now + welcome.heartbeat;
        Ok(())
    }

    /// Handles a lost or failed connection.
    fn lost(&mut self, now: Instant, error: LinkError) -> Result<(), AgentError> {
        let reason = match error {
            LinkError::Mismatch(reason) if self.welcomed => reason,
            LinkError::Refused(reason) | LinkError::Mismatch(reason) => {
                self.lanes.stop();
                return Err(AgentError::Refused {
                    coordinator: self.coordinator.clone(),
                    reason,
                });
            }
            LinkError::Down(reason) => reason,
        };
        if matches!(self.link, Link::Up { since, .. } if now - since > GOOD_SESSION) {
            self.retry.reset();
        }
        // The next coordinator of the list is tried at once; the first one again only after a wait.
        self.target = (self.target + 1) % self.targets.len();
        let wait = match self.target {
            0 => self.retry.next(random()),
            _ => NEXT_COORDINATOR.mul_f64(random()),
        };
        if self.away_since.is_none() {
            warn!(
                reason,
                coordinator = self.coordinator,
                unacknowledged = self.assignments.unacknowledged(),
                "no coordinator; the worker goes on with what it holds and tries again until one answers"
            );
        } else {
            info!(
                reason,
                retry_in_s = wait.as_secs_f64(),
                "still no coordinator"
            );
        }
        self.away_since.get_or_insert(now);
        self.assignments.disconnected();
        self.link = Link::Down(now + wait);
        Ok(())
    }

    fn received(&mut self, now: Instant, message: Incoming) {
        match message {
            Incoming::Lease(lease) => {
                info!(job = %lease.job, range = %lease.lease.range, epoch = %lease.lease.epoch,
                    lo = lease.lo, hi = lease.hi, skip = lease.skip.len(), "lease granted");
                self.assignments.granted(now, *lease);
            }
            Incoming::UnusableLease(lease, why) => {
                error!(
                    why,
                    "the coordinator granted a lease that cannot be used; it goes back"
                );
                self.assignments.unusable(lease, &why);
                self.assignments
                    .pause(now + self.relief.next(random()), &why);
            }
            Incoming::Acknowledge {
                lease,
                index,
                accepted,
                reason,
            } => {
                let known = self.assignments.acknowledged(lease, index).is_some();
                if known && !accepted {
                    warn!(range = %lease.range, epoch = %lease.epoch, task = index, reason,
                        "report not accepted; nothing to do, any output stands");
                }
            }
            Incoming::Renewed { leases, ttl_ms } => {
                let ttl = Duration::from_millis(ttl_ms.into());
                for lost in self.assignments.renewed(now, &leases, ttl) {
                    warn!(range = %lost.range, epoch = %lost.epoch, "lease lost: not renewed");
                }
            }
            Incoming::Revoke { lease, reason } => {
                info!(range = %lease.range, epoch = %lease.epoch, reason, "lease revoked");
                if self.assignments.revoked(now, lease) {
                    self.lanes.give_up(lease);
                }
            }
            Incoming::Trim { lease, hi } => {
                info!(range = %lease.range, epoch = %lease.epoch, hi, "the end of this lease is another worker's now");
                self.assignments.trimmed(lease, hi);
            }
            Incoming::Examine(what) => {
                info!(
                    store = what.store,
                    scenes = what.scenes,
                    "the coordinator asks for an examination of this machine"
                );
                self.examiner.begin(what);
            }
            Incoming::Drain => self.begin_leaving(Haste::Finish),
            Incoming::Unknown(what) => warn!(what, "the coordinator sent a message of no use"),
        }
    }
}
