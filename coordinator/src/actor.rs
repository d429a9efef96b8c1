//! The one task that owns the core. It takes what has arrived, lets the core decide, makes the outcome durable in
//! one commit, and only then answers: whatever waits meanwhile forms the next commit.

use std::{
    collections::{HashMap, hash_map::Entry},
    panic::AssertUnwindSafe,
    sync::Arc,
    time::{Duration, Instant},
};

use futures::FutureExt;
use picofarm_catalog::{Catalog, CatalogError, ResultSet};
use picofarm_proto::{
    ids::{JobId, LeaseRef},
    model::{Failure, Finished, JobPlan, JobSpec, JobStatus, SpecError, TaskProgress, WorkerHello},
};
use tokio::{
    sync::{mpsc, oneshot, watch},
    time::MissedTickBehavior,
};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use crate::{
    clock::Clock,
    core::{Core, OutputHint, Say, SessionId, Settings, Submitted},
};

/// Messages handled in one commit.
const BATCH: usize = 1024;
/// How long to wait before trying a catalog again that failed.
const MEND: Duration = Duration::from_secs(1);

/// A question whose answer may be an error in words.
pub(crate) type Reply<T> = oneshot::Sender<Result<T, Refusal>>;

/// Why a request was not granted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Refusal {
    NoSuchJob(JobId),
    NotNow(String),
    Spec(SpecError),
    Catalog(String),
}

/// What the rpc modules ask of the actor.
pub(crate) enum Command {
    Open {
        session: SessionId,
        hello: WorkerHello,
        say: mpsc::Sender<Say>,
    },
    Worker(SessionId, FromWorker),
    Plan(Box<JobSpec>, Reply<JobPlan>),
    Submit {
        spec: Box<JobSpec>,
        again: bool,
        reply: Reply<Submitted>,
    },
    List(Reply<Vec<JobStatus>>),
    Get(JobId, Reply<JobStatus>),
    Cancel(JobId, Reply<JobStatus>),
    Retry(JobId, Reply<u64>),
    Workers(Reply<u32>),
}

/// What a worker says in its session.
pub(crate) enum FromWorker {
    Credit(u32),
    Heartbeat(Vec<LeaseRef>, Vec<TaskProgress>),
    Done(Finished),
    Failed(Failure),
    Release(LeaseRef, String),
    Closed,
}

/// What the actor runs with.
pub(crate) struct Actor {
    pub catalog: Arc<dyn Catalog>,
    pub settings: Settings,
    pub tick: Duration,
    pub clock: Clock,
    /// Grows with every change that people may want to see.
    pub revision: watch::Sender<u64>,
    pub stop: CancellationToken,
}

/// An answer that waits for the commit.
type Deferred = Box<dyn FnOnce(Result<(), &CatalogError>) + Send>;

/// One life of a core: from a load of the catalog to the first failure to write it.
struct Life<'a> {
    actor: &'a Actor,
    core: Core,
    sessions: HashMap<SessionId, mpsc::Sender<Say>>,
    deferred: Vec<Deferred>,
}

impl Actor {
    /// Runs until `stop`. When the catalog fails, sessions end (workers keep computing and come back), and the
    /// state is loaded afresh.
    pub(crate) async fn run(self, mut commands: mpsc::Receiver<Command>) {
        while !self.stop.is_cancelled() {
            let life = async { self.begin().await?.run(&mut commands).await };
            // A panic is a bug, but no reason to drop everyone: the state is loaded afresh.
            let why = match AssertUnwindSafe(life).catch_unwind().await {
                Ok(Ok(())) => break,
                Ok(Err(error)) => error.to_string(),
                Err(_) => "the coordinator panicked; please report this with its log".to_owned(),
            };
            tracing::error!("{why}; trying again in {} s", MEND.as_secs());
            tokio::select! {
                () = tokio::time::sleep(MEND) => {}
                () = self.stop.cancelled() => {}
            }
            // Those who asked meanwhile are told at once rather than kept waiting.
            while let Ok(command) = commands.try_recv() {
                refuse(command, &why);
            }
        }
        self.catalog.close().await;
    }

    async fn begin(&self) -> Result<Life<'_>, CatalogError> {
        let snapshot = self.catalog.load().await?;
        let mut timing = HashMap::new();
        for job in &snapshot.jobs {
            if let Entry::Vacant(entry) = timing.entry(ResultSet::of(&job.spec)) {
                let seconds = self.catalog.timing(entry.key()).await?;
                entry.insert(seconds);
            }
        }
        let core = Core::load(
            snapshot,
            &timing,
            self.settings,
            Box::new(Uuid::now_v7),
            self.clock.now_ms(),
        );
        Ok(Life {
            actor: self,
            core,
            sessions: HashMap::new(),
            deferred: Vec::new(),
        })
    }
}

impl Life<'_> {
    async fn run(mut self, commands: &mut mpsc::Receiver<Command>) -> Result<(), CatalogError> {
        let mut tick = tokio::time::interval(self.actor.tick);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut ticked = Instant::now();
        let mut batch = Vec::with_capacity(BATCH);
        loop {
            tokio::select! {
                biased;
                () = self.actor.stop.cancelled() => return Ok(()),
                _ = tick.tick() => {
                    let now = self.now();
                    // A stall of this process (a suspended laptop, a stopped debugger) is no worker's fault.
                    let stall = ticked.elapsed();
                    if stall > self.actor.tick + Duration::from_millis(u64::from(self.actor.settings.lease_ms) / 2) {
                        tracing::warn!(seconds = stall.as_secs_f64(), "the coordinator was stalled; leases are prolonged");
                        self.core.grace(now);
                    }
                    ticked = Instant::now();
                    self.core.expire(now);
                }
                n = commands.recv_many(&mut batch, BATCH) => {
                    if n == 0 {
                        return Ok(());
                    }
                    self.handle(&mut batch).await?;
                }
            }
            self.core.dispatch(self.now());
            self.flush().await?;
        }
    }

    fn now(&self) -> i64 {
        self.actor.clock.now_ms()
    }

    async fn handle(&mut self, batch: &mut Vec<Command>) -> Result<(), CatalogError> {
        // What the catalog holds for the tasks reported, in one go.
        let asked: Vec<(JobId, u64)> = batch
            .iter()
            .filter_map(|command| match command {
                Command::Worker(_, FromWorker::Done(report)) => {
                    Some((self.core.job_of(report)?, report.index))
                }
                _ => None,
            })
            .collect();
        let found = self.actor.catalog.manifests(&asked).await?;
        let known: HashMap<_, _> = asked.into_iter().zip(found).collect();
        for command in batch.drain(..) {
            match command {
                Command::Open {
                    session,
                    hello,
                    say,
                } => {
                    let now = self.now();
                    self.sessions.insert(session, say);
                    self.core.hello(session, hello, now);
                }
                Command::Worker(session, said) => self.worker_said(session, said, &known),
                Command::Plan(spec, reply) => {
                    self.flush().await?;
                    let set = ResultSet::of(&spec);
                    let runs = self
                        .actor
                        .catalog
                        .output_runs(&set, spec.scenes.count)
                        .await?;
                    let plan = self
                        .core
                        .place_is_free(&spec)
                        .map(|()| self.core.plan(&spec, &runs));
                    let _ = reply.send(plan.map_err(Refusal::Spec));
                }
                Command::Submit { spec, again, reply } => {
                    // First what is under way, so that no output is missed.
                    self.flush().await?;
                    let set = ResultSet::of(&spec);
                    let runs = self
                        .actor
                        .catalog
                        .output_runs(&set, spec.scenes.count)
                        .await?;
                    let timing = self.actor.catalog.timing(&set).await?;
                    let now = self.now();
                    let submitted = self.core.submit(*spec, again, &runs, timing, now);
                    self.defer(reply, submitted.map_err(Refusal::Spec));
                }
                Command::List(reply) => {
                    let list = self.core.list(self.now());
                    self.defer(reply, Ok(list));
                }
                Command::Get(id, reply) => {
                    let status = self.core.status(id, self.now());
                    self.defer(reply, status.ok_or(Refusal::NoSuchJob(id)));
                }
                Command::Cancel(id, reply) => {
                    let now = self.now();
                    let status = self.core.cancel(id, now);
                    self.defer(reply, status.ok_or(Refusal::NoSuchJob(id)));
                }
                Command::Retry(id, reply) => {
                    let now = self.now();
                    let answer = match self.core.retry(id, now) {
                        None => Err(Refusal::NoSuchJob(id)),
                        Some(answer) => answer.map_err(Refusal::NotNow),
                    };
                    self.defer(reply, answer);
                }
                Command::Workers(reply) => {
                    let _ = reply.send(Ok(self.core.connected()));
                }
            }
        }
        Ok(())
    }

    fn worker_said(
        &mut self,
        session: SessionId,
        said: FromWorker,
        known: &HashMap<(JobId, u64), Option<[u8; 32]>>,
    ) {
        let now = self.now();
        match said {
            FromWorker::Credit(n) => self.core.credit(session, n),
            FromWorker::Heartbeat(leases, progress) => {
                self.core.heartbeat(session, &leases, &progress, now);
            }
            FromWorker::Done(report) => {
                let hint = self
                    .core
                    .job_of(&report)
                    .and_then(|job| known.get(&(job, report.index)).copied().flatten());
                self.core.finished(session, &report, OutputHint(hint), now);
            }
            FromWorker::Failed(failure) => self.core.failed(session, &failure, now),
            FromWorker::Release(lease, reason) => self.core.released(session, lease, &reason, now),
            FromWorker::Closed => {
                self.sessions.remove(&session);
                self.core.closed(session, now);
            }
        }
    }

    /// Answers after the next commit.
    fn defer<T: Send + 'static>(&mut self, reply: Reply<T>, answer: Result<T, Refusal>) {
        self.deferred.push(Box::new(move |committed| {
            // Who has gone needs no answer.
            let _ = reply.send(match committed {
                Ok(()) => answer,
                Err(error) => Err(Refusal::Catalog(error.to_string())),
            });
        }));
    }

    /// Makes what the core decided durable, then says it.
    async fn flush(&mut self) -> Result<(), CatalogError> {
        let (changes, say) = self.core.take();
        let changed = !changes.is_empty();
        let result = self.actor.catalog.commit(changes).await;
        for answer in self.deferred.drain(..) {
            answer(result.as_ref().copied());
        }
        result?;
        let mut deaf = Vec::new();
        for (session, what) in say {
            let over = what == Say::Replaced;
            let Some(sender) = self.sessions.get(&session) else {
                continue;
            };
            if let Err(error) = sender.try_send(what) {
                tracing::warn!(session, %error, "the worker does not listen; its session ends");
                deaf.push(session);
            }
            if over {
                self.sessions.remove(&session);
            }
        }
        let heard = changed || !deaf.is_empty();
        for session in deaf {
            self.sessions.remove(&session);
            let now = self.now();
            self.core.closed(session, now);
        }
        if heard {
            self.actor.revision.send_modify(|n| *n += 1);
        }
        Ok(())
    }
}

/// Tells whoever asks that the catalog is out of order.
fn refuse(command: Command, error: &str) {
    fn no<T>(reply: Reply<T>, error: &str) {
        let _ = reply.send(Err(Refusal::Catalog(error.to_owned())));
    }
    match command {
        // Dropping a session's sender ends it.
        Command::Open { .. } | Command::Worker(..) => {}
        Command::Plan(_, reply) => no(reply, error),
        Command::Submit { reply, .. } => no(reply, error),
        Command::List(reply) => no(reply, error),
        Command::Get(_, reply) | Command::Cancel(_, reply) => no(reply, error),
        Command::Retry(_, reply) => no(reply, error),
        Command::Workers(reply) => no(reply, error),
    }
}
