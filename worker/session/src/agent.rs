//! The worker's main loop: it drives connection, executor, clock and shutdown around the
//! [`Assignments`].

use std::{
    future::Future,
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use picofarm_proto::{
    PROTOCOL,
    ids::{Incarnation, WorkerId},
    model::{Abilities, WorkerHello},
    trace,
};
use tokio_util::sync::CancellationToken;
use tracing::{error, info, info_span, warn};
use uuid::Uuid;

use crate::{
    AgentConfig, AgentError, Control, Executor, Output, Summary, Target, TaskError,
    allow::StorePrefixes,
    assignments::Assignments,
    backoff::{Backoff, random},
    log::Unsent,
    message::{Incoming, Outgoing},
    runner::Runner,
    session::{self, LinkError, Session, Welcome},
    suspend::Suspends,
};

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
/// After a session of at least this duration, the next reconnect begins with a short wait.
const GOOD_SESSION: Duration = Duration::from_secs(10);
/// Maximum wait before the next coordinator of the list is tried, so that the workers of a lost
/// coordinator do not all reconnect at the same moment.
const NEXT_COORDINATOR: Duration = Duration::from_millis(300);
/// Interval for sending the log of the running task.
const TELL: Duration = Duration::from_secs(1);
const SHUTDOWN: &str = "the worker is shutting down";

/// Runs a worker with this executor until `shutdown` or a refusal.
///
/// # Errors
/// [`AgentError`]: an unusable setting, or the coordinator refuses this worker. An unreachable
/// coordinator is not an error: the worker retries forever.
pub fn run_with(
    config: AgentConfig,
    executor: Arc<dyn Executor>,
    shutdown: CancellationToken,
) -> Pin<Box<dyn Future<Output = Result<Summary, AgentError>> + Send>> {
    // The future is boxed, so that a crate that awaits it does not compile the session again.
    Box::pin(work(config, executor, shutdown))
}

async fn work(
    config: AgentConfig,
    executor: Arc<dyn Executor>,
    shutdown: CancellationToken,
) -> Result<Summary, AgentError> {
    config.check()?;
    let targets = session::targets(&config.coordinator, &config.access)?;
    let allowed = StorePrefixes::new(&config.store_prefixes)?;
    let hello = WorkerHello {
        id: config
            .worker_id
            .unwrap_or_else(|| WorkerId::from_uuid(Uuid::new_v4())),
        incarnation: Incarnation::from_uuid(Uuid::new_v4()),
        name: config.name.clone(),
        version: env!("CARGO_PKG_VERSION").into(),
        protocol: PROTOCOL,
        held: Vec::new(),
        ended: config.ended,
        ends_in_ms: None,
        abilities: Abilities {
            kinds: executor.kinds(),
            assets: executor.assets(),
            cores: u32::try_from(config.threads).unwrap_or(u32::MAX),
            memory_mib: config.memory_mib,
            gpus: executor.gpus(),
            labels: config.labels,
        },
    };
    info!(worker = %hello.id, name = hello.name, threads = config.threads,
        memory_mib = config.memory_mib, memory_from = config.memory_from,
        coordinator = config.coordinator, "worker starts");
    let mut agent = Agent {
        assignments: Assignments::new(),
        runner: Runner::start(executor, config.threads, allowed)?,
        control: None,
        unsent: Unsent::default(),
        tell_at: Instant::now(),
        suspends: Suspends::new(),
        targets,
        at: 0,
        welcomed: false,
        hello,
        link: Link::Down(Instant::now()),
        away_since: None,
        retry: Backoff::new(Duration::from_millis(200), Duration::from_secs(10)),
        relief: Backoff::new(Duration::from_secs(1), Duration::from_secs(60)),
        leaving: None,
        exit_idle: config.exit_idle,
        idle_since: None,
        summary: Summary::default(),
        coordinator: config.coordinator,
    };
    if let Some(at) = config.ends_at {
        let left = at.duration_since(SystemTime::now()).unwrap_or_default();
        info!(in_s = left.as_secs_f64(), "the worker stops work then");
        agent.assignments.must_end(Instant::now() + left);
    }
    let outcome = agent.live(shutdown).await;
    agent.summary.unacknowledged = agent.assignments.unacknowledged_outputs() as u64;
    outcome.map(|()| {
        info!(summary = ?agent.summary, "worker ends");
        agent.summary
    })
}

type Opening = Pin<Box<dyn Future<Output = Result<(Welcome, Box<Session>), LinkError>> + Send>>;

enum Link {
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

enum Event {
    Retry,
    Opened(Result<(Welcome, Box<Session>), LinkError>),
    Received(Result<Incoming, LinkError>),
    Beat,
}

impl Link {
    /// Returns the connection's next event. Cancel-safe.
    async fn event(&mut self) -> Event {
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

/// How quickly to leave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Haste {
    /// At once.
    Stop,
    /// After the running task.
    Finish,
}

/// The state of a shutdown.
struct Leaving {
    haste: Haste,
    /// The running task is asked to stop at this time.
    stop_at: Instant,
    /// The worker leaves at this time, regardless of running tasks or missing acknowledgements.
    give_up: Instant,
    released: bool,
}

struct Agent {
    assignments: Assignments,
    runner: Runner,
    /// The control of the running task.
    control: Option<Arc<Control>>,
    /// Unsent log lines of tasks.
    unsent: Unsent,
    /// The next time to send the log of the running task.
    tell_at: Instant,
    /// The configured coordinators.
    targets: Vec<Target>,
    /// Index of the coordinator in use or to be tried next.
    at: usize,
    suspends: Suspends,
    /// Whether this worker has been admitted before, in which case an apparently wrong setting may
    /// be temporary.
    welcomed: bool,
    hello: WorkerHello,
    link: Link,
    away_since: Option<Instant>,
    retry: Backoff,
    /// Waits after interruptions caused by this machine or the store.
    relief: Backoff,
    leaving: Option<Leaving>,
    /// The worker ends after being idle for this time.
    exit_idle: Option<Duration>,
    /// Since when the worker is idle while connected to a coordinator.
    idle_since: Option<Instant>,
    summary: Summary,
    coordinator: String,
}

impl Agent {
    async fn live(&mut self, shutdown: CancellationToken) -> Result<(), AgentError> {
        loop {
            let now = Instant::now();
            self.after_suspend(now);
            if self.leave(now) {
                return Ok(());
            }
            self.work(now);
            self.idle(now);
            self.end_in_time(now);
            let wake = self.wake(now);
            let stopping = self
                .leaving
                .as_ref()
                .is_some_and(|l| l.haste == Haste::Stop);
            tokio::select! {
                event = self.link.event() => self.link_event(event)?,
                result = self.runner.finished() => self.task_ended(result),
                () = tokio::time::sleep_until(wake.into()) => {}
                () = shutdown.cancelled(), if !stopping => self.begin_leaving(Haste::Stop),
            }
        }
    }

    /// After a suspend, leases are older than the clock indicates, so a heartbeat asks at once
    /// which are still valid.
    fn after_suspend(&mut self, now: Instant) {
        let Some(long) = self.suspends.new_one() else {
            return;
        };
        info!(
            suspended_s = long.as_secs_f64(),
            "the machine was suspended; asking which leases live on"
        );
        self.assignments.suspended(long);
        if let Link::Up { next_beat, .. } = &mut self.link {
            *next_beat = now;
        }
    }

    fn target(&self) -> &Target {
        &self.targets[self.at]
    }

    /// Starts the next task if none is running, and sends pending messages.
    fn work(&mut self, now: Instant) {
        if let Some(task) = self.assignments.begin(now) {
            info!(job = %task.job, task = task.index, "task starts");
            let control = Arc::new(Control::expecting(&task.spec.stores));
            self.control = Some(control.clone());
            let span = info_span!(target: trace::TARGET, "task", job = %task.job, stage = &*task.spec.name,
                task = task.index);
            if let Some(hand) = self.assignments.in_hand() {
                trace::join(&span, &hand.traceparent);
            }
            self.assignments.traced(trace::traceparent(&span));
            self.runner.begin(task, control, span);
        }
        if let Some(hand) = self.assignments.in_hand()
            && now >= self.tell_at
        {
            self.tell_at = now + TELL;
            let lines = self.runner.log().take();
            self.unsent.push(hand.lease, hand.task.index, lines);
        }
        if let Link::Up { session, .. } = &self.link {
            for log in self.unsent.drain(now) {
                session.send(Outgoing::Log(log));
            }
            for message in self.assignments.outgoing(now) {
                session.send(message);
            }
        }
    }

    /// Ends a worker that has been idle for too long.
    fn idle(&mut self, now: Instant) {
        let connected = matches!(self.link, Link::Up { .. });
        if self.assignments.in_hand().is_some() || self.leaving.is_some() || !connected {
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
    fn end_in_time(&mut self, now: Instant) {
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

    /// Returns the time at which the loop must run again even without an event.
    fn wake(&self, now: Instant) -> Instant {
        let leaving = self.leaving.iter().flat_map(|l| [l.stop_at, l.give_up]);
        let idle = self.idle_since.zip(self.exit_idle);
        leaving
            .chain(idle.map(|(since, most)| since + most))
            .chain(self.assignments.paused_until())
            .chain(self.assignments.ends_at())
            .chain(self.assignments.in_hand().map(|_| self.tell_at))
            .filter(|at| *at > now)
            .min()
            .unwrap_or(now + Duration::from_secs(60))
    }

    fn link_event(&mut self, event: Event) -> Result<(), AgentError> {
        let now = Instant::now();
        match event {
            Event::Retry => {
                let mut hello = self.hello.clone();
                hello.held = self.assignments.held();
                hello.ends_in_ms = self.assignments.ends_in_ms(now);
                self.link = Link::Opening(Box::pin(session::open(self.target().clone(), hello)));
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
        let (fraction, at) = self
            .control
            .as_ref()
            .map(|c| c.progress())
            .unwrap_or_default();
        session.send(self.assignments.heartbeat(now, fraction, at));
        *next_beat = now + welcome.heartbeat;
        Ok(())
    }

    /// Handles a lost or failed connection.
    fn lost(&mut self, now: Instant, error: LinkError) -> Result<(), AgentError> {
        let reason = match error {
            LinkError::Mismatch(reason) if self.welcomed => reason,
            LinkError::Refused(reason) | LinkError::Mismatch(reason) => {
                if let Some(control) = &self.control {
                    control.stop();
                }
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
        self.at = (self.at + 1) % self.targets.len();
        let wait = match self.at {
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
                if self.assignments.revoked(now, lease)
                    && let Some(control) = &self.control
                {
                    control.give_up();
                }
            }
            Incoming::Trim { lease, hi } => {
                info!(range = %lease.range, epoch = %lease.epoch, hi, "the end of this lease is another worker's now");
                self.assignments.trimmed(lease, hi);
            }
            Incoming::Drain => self.begin_leaving(Haste::Finish),
            Incoming::Unknown(what) => warn!(what, "the coordinator sent a message of no use"),
        }
    }

    fn task_ended(&mut self, result: Result<Output, TaskError>) {
        let now = Instant::now();
        self.control = None;
        let hand = self.assignments.ended(now, &result);
        // The lines are sent before the report, because log lines after it are ignored.
        let lines = self.runner.log().end();
        self.unsent.push(hand.lease, hand.task.index, lines);
        let (job, task, seconds) = (
            hand.task.job,
            hand.task.index,
            (now - hand.since).as_secs_f64(),
        );
        match &result {
            Ok(output) => {
                self.relief.reset();
                if output.adopted {
                    self.summary.adopted += 1;
                    info!(%job, task, seconds, "task adopted: its output was in the store");
                } else {
                    self.summary.computed += 1;
                    info!(%job, task, seconds, bytes = output.bytes, "task done");
                }
            }
            Err(TaskError::Stopped) => info!(%job, task, seconds, "task stopped"),
            Err(TaskError::Interrupted(why)) => {
                self.summary.failed += 1;
                let wait = self.relief.next(random());
                warn!(%job, task, why, wait_s = wait.as_secs_f64(),
                    "task interrupted; the worker hands its leases back and waits before taking more");
                self.assignments.pause(now + wait, why);
            }
            // The coordinator takes back tasks that need the store, and sends other work.
            Err(TaskError::Store(why)) => {
                self.summary.failed += 1;
                warn!(%job, task, why, "the task waits for its store; the worker takes other work");
            }
            Err(TaskError::Damaged(why)) => {
                self.summary.failed += 1;
                warn!(%job, task, why, "the task waits until what it reads is repaired");
            }
            Err(error) => {
                self.summary.failed += 1;
                error!(%job, task, seconds, %error, "task failed");
            }
        }
    }

    /// Begins to leave, because of a shutdown signal or the coordinator's request.
    fn begin_leaving(&mut self, haste: Haste) {
        let now = Instant::now();
        self.assignments.drain();
        let nearly_done = self
            .remaining(now)
            .is_some_and(|left| left <= FINISH_WITHIN);
        let saves = self
            .assignments
            .in_hand()
            .is_some_and(|hand| hand.task.spec.task.resumes());
        let stop_at = match haste {
            Haste::Finish if saves => now,
            Haste::Finish => now + LONGEST_TASK,
            Haste::Stop if nearly_done => now + FINISH_WITHIN,
            Haste::Stop => now,
        };
        info!(
            running = self.assignments.in_hand().is_some(),
            nearly_done,
            ?haste,
            "shutting down"
        );
        self.assignments.release_waiting(SHUTDOWN);
        let (fraction, at) = self
            .control
            .as_ref()
            .map(|c| c.progress())
            .unwrap_or_default();
        if let Link::Up { session, .. } = &self.link {
            for message in self.assignments.withdraw(now, fraction, at) {
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

    /// Estimates the remaining time of the running task from its progress so far.
    fn remaining(&self, now: Instant) -> Option<Duration> {
        let since = self.assignments.in_hand()?.since;
        let fraction = self.control.as_ref()?.fraction();
        let left = (now - since).as_secs_f64() * f64::from((1.0 - fraction) / fraction);
        Duration::try_from_secs_f64(left).ok()
    }

    /// Takes the next step of leaving. Returns `true` when the worker may end.
    fn leave(&mut self, now: Instant) -> bool {
        let Some(leaving) = &mut self.leaving else {
            return false;
        };
        let running = self.assignments.in_hand().is_some();
        if running && now < leaving.give_up {
            if let Some(control) = &self.control
                && now >= leaving.stop_at
            {
                control.stop();
            }
            return false;
        }
        if !leaving.released {
            if running {
                warn!("the running task did not stop; the worker leaves without it");
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
