//! The worker's main loop: it drives connection, executor, clock and shutdown around the
//! [`Assignments`].

mod connection;
mod leaving;

use std::{
    future::Future,
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use picofarm_proto::{
    PROTOCOL,
    ids::{Incarnation, LeaseRef, WorkerId},
    messages::{Abilities, WorkerHello},
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
    examine::Examiner,
    lanes::Lanes,
    log::{TaskLine, Unsent},
    message::Outgoing,
    session,
    suspend::Suspends,
};
use connection::Link;
use leaving::{Haste, Leaving};

/// Interval for sending the logs of the running tasks.
const LOG_INTERVAL: Duration = Duration::from_secs(1);

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
        examiner: Examiner::new(Arc::clone(&executor), allowed.clone()),
        lanes: Lanes::start(executor, config.threads, allowed)?,
        unsent: Unsent::default(),
        log_at: Instant::now(),
        suspends: Suspends::new(),
        targets,
        target: 0,
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

struct Agent {
    assignments: Assignments,
    lanes: Lanes,
    examiner: Examiner,
    /// Unsent log lines of tasks.
    unsent: Unsent,
    /// The next time to send the logs of the running tasks.
    log_at: Instant,
    /// The configured coordinators.
    targets: Vec<Target>,
    /// Index of the coordinator in use or to be tried next.
    target: usize,
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
            self.work(now)?;
            self.idle(now);
            self.end_in_time(now);
            let wake = self.wake(now);
            let stopping = self
                .leaving
                .as_ref()
                .is_some_and(|l| l.haste == Haste::Stop);
            tokio::select! {
                event = self.link.event() => self.link_event(event)?,
                (lease, index, lines, result) = self.lanes.finished() => {
                    self.task_ended((lease, index), lines, result);
                }
                examined = self.examiner.finished() => {
                    if let Link::Up { session, .. } = &self.link {
                        session.send(Outgoing::Examined(examined));
                    }
                }
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

    /// Starts the next tasks that may run now, and sends pending messages.
    fn work(&mut self, now: Instant) -> Result<(), AgentError> {
        while let Some(task) = self
            .assignments
            .begin(now, |task| self.lanes.together(task))
        {
            info!(job = %task.job, task = task.index, "task starts");
            let control = Arc::new(Control::expecting(&task.spec.stores));
            let span = info_span!(target: trace::TARGET, "task", job = %task.job, stage = &*task.spec.name,
                task = task.index);
            let hand = self.assignments.running().last();
            let hand = hand.expect("a task that is begun is running");
            let lease = hand.lease;
            trace::join(&span, &hand.traceparent);
            self.assignments.traced(trace::traceparent(&span));
            self.lanes.begin(task, lease, control, span)?;
        }
        if !self.assignments.running().is_empty() && now >= self.log_at {
            self.log_at = now + LOG_INTERVAL;
            for (lease, index, lines) in self.lanes.logs() {
                self.unsent.push(lease, index, lines);
            }
        }
        if let Link::Up { session, .. } = &self.link {
            for log in self.unsent.drain(now) {
                session.send(Outgoing::Log(log));
            }
            for message in self.assignments.outgoing(now) {
                session.send(message);
            }
        }
        Ok(())
    }

    /// Returns the time at which the loop must run again even without an event.
    fn wake(&self, now: Instant) -> Instant {
        let leaving = self.leaving.iter().flat_map(|l| [l.stop_at, l.give_up]);
        let idle = self.idle_since.zip(self.exit_idle);
        leaving
            .chain(idle.map(|(since, most)| since + most))
            .chain(self.assignments.paused_until())
            .chain(self.assignments.ends_at())
            .chain(self.assignments.running().first().map(|_| self.log_at))
            .filter(|at| *at > now)
            .min()
            .unwrap_or(now + Duration::from_secs(60))
    }

    fn task_ended(
        &mut self,
        task: (LeaseRef, u64),
        lines: Vec<TaskLine>,
        result: Result<Output, TaskError>,
    ) {
        let now = Instant::now();
        let hand = self.assignments.ended(now, task, &result);
        // The lines are sent before the report, because log lines after it are ignored.
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
}
