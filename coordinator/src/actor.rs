//! The one task that owns the core. It takes what has arrived, claims the tasks that are wanted, lets the core decide,
//! makes the outcome durable in one commit, and only then answers: whatever waits meanwhile forms the next commit.

use std::{
    collections::{HashMap, hash_map::Entry},
    panic::AssertUnwindSafe,
    sync::Arc,
    time::{Duration, Instant},
};

use futures::FutureExt;
use picofarm_catalog::{Catalog, CatalogError, Job, ResultSet, Run};
use picofarm_proto::{
    ids::{JobId, LeaseRef, StageRef},
    key::spec_hash,
    model::{
        Failure, Finished, JobPlan, JobSpec, JobState, JobStatus, SpecError, TaskLog, TaskProgress,
        WorkerHello,
    },
};
use tokio::{
    sync::{mpsc, oneshot, watch},
    time::MissedTickBehavior,
};
use tokio_util::sync::CancellationToken;
use tracing::Span;
use uuid::Uuid;

use crate::{
    clock::Clock,
    core::{
        Core, JobLook, Look, OutputHint, Prepared, Say, SessionId, Settings, Timings,
        place_is_free, stands_for,
    },
    http::Pulse,
    metrics::{Metrics, Tally},
    plan, trace,
};

/// Messages handled in one commit.
const BATCH: usize = 4096;
/// How long to wait before trying a catalog again that failed.
const MEND: Duration = Duration::from_secs(1);
/// How often the catalog hears that this house lives, and is asked for news.
const BEAT: Duration = Duration::from_secs(1);
/// How often jobs to forget are looked for, and how many are forgotten at a time: other work waits for it.
const FORGET: Duration = Duration::from_secs(600);
const FORGET_AT_ONCE: u32 = 4;
/// Jobs that a new one is compared with.
const RECENT: u32 = 50;
/// Least time between two beats, whatever the hints.
const BEAT_AT_LEAST: Duration = Duration::from_millis(100);

/// A question whose answer may be an error in words.
pub(crate) type Reply<T> = oneshot::Sender<Result<T, Refusal>>;

/// Why a request was not granted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Refusal {
    NoSuchJob(JobId),
    NotNow(String),
    TooMany(String),
    Spec(SpecError),
    Catalog(String),
}

/// Answer to a submission.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Submitted {
    pub job: JobId,
    pub existed: bool,
    pub plan: JobPlan,
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
        user: String,
        /// Jobs that the user may have that have not ended.
        most: u64,
        again: bool,
        reply: Reply<Submitted>,
    },
    List(Reply<Vec<JobStatus>>),
    Get(JobId, Reply<JobStatus>),
    Cancel {
        job: JobId,
        why: String,
        reply: Reply<JobStatus>,
    },
    Pause {
        job: JobId,
        paused: bool,
        who: String,
        reply: Reply<JobStatus>,
    },
    Drain(String, Reply<u32>),
    Retry(JobId, Reply<u64>),
    Workers(Reply<u32>),
    /// What the house knows, without asking the catalog.
    Look(Reply<Look>),
    LookAt {
        job: JobId,
        stage: Option<u32>,
        task: Option<u64>,
        reply: Reply<JobLook>,
    },
}

/// What a worker says in its session.
pub(crate) enum FromWorker {
    Credit(u32),
    Heartbeat(Vec<LeaseRef>, Vec<TaskProgress>),
    Done(Finished),
    Failed(Failure),
    Release(LeaseRef, String),
    Log(TaskLog),
    Closed,
}

/// What the actor runs with.
pub(crate) struct Actor {
    pub catalog: Arc<dyn Catalog>,
    pub settings: Settings,
    pub tick: Duration,
    /// Jobs that ended so long ago are forgotten.
    pub forget_after: Option<Duration>,
    pub clock: Clock,
    /// Grows with every change that people may want to see.
    pub revision: watch::Sender<u64>,
    pub metrics: Arc<Metrics>,
    pub pulse: Arc<Pulse>,
    pub stop: CancellationToken,
}

/// One life of a core: from a load of the catalog to the first failure to write it.
struct Life<'a> {
    actor: &'a Actor,
    core: Core,
    sessions: HashMap<SessionId, mpsc::Sender<Say>>,
    tally: Tally,
    /// Of reports that are not durable yet.
    commits: Vec<Span>,
    /// When jobs to forget were last looked for and none were left.
    forgot: Option<Instant>,
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
            self.pulse.trouble(&why);
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
        let mut timings = Timings::new();
        for stage in snapshot.jobs.iter().flat_map(Job::stages) {
            if let Entry::Vacant(entry) = timings.entry(stage.set) {
                let seconds = self.catalog.timing(entry.key()).await?;
                entry.insert(seconds);
            }
        }
        tracing::debug!(house = %snapshot.house, jobs = snapshot.jobs.len(),
            ranges = snapshot.owned.ranges.len(), "a house begins");
        let core = Core::load(
            snapshot,
            &timings,
            self.settings,
            Box::new(Uuid::now_v7),
            self.clock.now_ms(),
        );
        Ok(Life {
            actor: self,
            core,
            sessions: HashMap::new(),
            tally: Tally::default(),
            commits: Vec::new(),
            forgot: None,
        })
    }
}

impl Life<'_> {
    async fn run(mut self, commands: &mut mpsc::Receiver<Command>) -> Result<(), CatalogError> {
        let mut tick = tokio::time::interval(self.actor.tick);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut ticked = Instant::now();
        // The first beat at once: news that are missed between loading and now come with it.
        let mut beaten: Option<Instant> = None;
        let mut hinted = false;
        let mut batch = Vec::with_capacity(BATCH);
        loop {
            let due = match beaten {
                None => Duration::ZERO,
                Some(at) if hinted => BEAT_AT_LEAST.saturating_sub(at.elapsed()),
                Some(at) => BEAT.saturating_sub(at.elapsed()),
            };
            if due.is_zero() {
                // Not left to the timer below: while messages keep coming, one made anew each turn is never heard.
                beaten = Some(Instant::now());
                hinted = false;
                self.beat().await?;
            } else {
                tokio::select! {
                    biased;
                    () = self.actor.stop.cancelled() => return self.end().await,
                    () = self.actor.catalog.changed(), if !hinted => {
                        hinted = true;
                        continue;
                    }
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
                        for (job, deadline) in self.core.overdue(now) {
                            self.flush().await?;
                            self.cancel(job, &format!("limits.deadline = {deadline:?} has passed")).await?;
                        }
                    }
                    n = commands.recv_many(&mut batch, BATCH) => {
                        if n == 0 {
                            return self.end().await;
                        }
                        self.actor.metrics.handled(n);
                        self.handle(&mut batch).await?;
                    }
                    () = tokio::time::sleep(due) => continue,
                }
            }
            self.supply().await?;
            self.core.dispatch(self.now());
            self.flush().await?;
        }
    }

    /// The orderly end of a house: what nobody runs is free for others.
    async fn end(mut self) -> Result<(), CatalogError> {
        self.core.give_back();
        self.flush().await
    }

    /// Claims what connected workers could run.
    async fn supply(&mut self) -> Result<(), CatalogError> {
        let wants = self.core.wants(self.now());
        if wants.is_empty() {
            return Ok(());
        }
        // What is noted so far first: the catalog must know this house's ranges as they are.
        self.flush().await?;
        let claims = self.actor.catalog.claim(&wants).await?;
        let now = self.now();
        for (want, claim) in wants.iter().zip(claims) {
            self.core.supplied(want.stage, claim, now);
        }
        Ok(())
    }

    /// Forgets a few of the jobs that ended long ago, if it is time to look for some.
    async fn forget(&mut self) -> Result<(), CatalogError> {
        let Some(age) = self.actor.forget_after else {
            return Ok(());
        };
        if self.forgot.is_some_and(|at| at.elapsed() < FORGET) {
            return Ok(());
        }
        let before_ms = self.now() - i64::try_from(age.as_millis()).unwrap_or(i64::MAX);
        let forgotten = self.actor.catalog.forget(before_ms, FORGET_AT_ONCE).await?;
        if forgotten > 0 {
            tracing::info!(
                jobs = forgotten,
                "jobs that ended long ago are forgotten; their outputs stay"
            );
        }
        // Where there are more, they follow with the next beat.
        if forgotten < FORGET_AT_ONCE {
            self.forgot = Some(Instant::now());
        }
        Ok(())
    }

    /// Tells the catalog that this house lives, and hears what is new.
    async fn beat(&mut self) -> Result<(), CatalogError> {
        self.forget().await?;
        self.core.give_back();
        self.flush().await?;
        let news = self.actor.catalog.beat(self.core.connected()).await?;
        self.actor.pulse.beat();
        let now = self.now();
        for job in self.core.hear(news, now) {
            if let Some(record) = self.actor.catalog.job(job).await? {
                self.learn(&record.job).await?;
            }
        }
        Ok(())
    }

    /// Takes note of a job that is new here.
    async fn learn(&mut self, job: &Job) -> Result<(), CatalogError> {
        if job.state != JobState::Active || self.core.knows(job.id) {
            return Ok(());
        }
        let mut timings = Timings::new();
        for set in self.core.untimed(std::slice::from_ref(job)) {
            let seconds = self.actor.catalog.timing(&set).await?;
            timings.insert(set, seconds);
        }
        self.core.add_job(job, &timings);
        Ok(())
    }

    fn now(&self) -> i64 {
        self.actor.clock.now_ms()
    }

    async fn handle(&mut self, batch: &mut Vec<Command>) -> Result<(), CatalogError> {
        // What the catalog holds for the tasks reported, in one go.
        let asked: Vec<(StageRef, u64)> = batch
            .iter()
            .filter_map(|command| match command {
                Command::Worker(_, FromWorker::Done(report)) => {
                    Some((self.core.stage_of(report)?, report.index))
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
                    // The worker brings its leases along, from whichever coordinator.
                    self.flush().await?;
                    let owned = self.actor.catalog.adopt(hello.id).await?;
                    let now = self.now();
                    self.core.receive(owned, now);
                    self.sessions.insert(session, say);
                    self.core.hello(session, hello, now);
                }
                Command::Worker(session, said) => self.worker_said(session, said, &known),
                Command::Plan(spec, reply) => {
                    self.flush().await?;
                    let answer = self.plan(&spec).await?;
                    let _ = reply.send(answer.map(|(plan, _)| plan));
                }
                Command::Submit {
                    spec,
                    user,
                    most,
                    again,
                    reply,
                } => {
                    // First what is under way, so that no output is missed.
                    self.flush().await?;
                    let answer = self.submit(*spec, user, most, again).await?;
                    let _ = reply.send(answer);
                }
                Command::List(reply) => {
                    self.flush().await?;
                    let records = self.actor.catalog.jobs().await?;
                    let now = self.now();
                    let list = records.into_iter().map(|r| self.core.status(r, now));
                    let _ = reply.send(Ok(list.collect()));
                }
                Command::Get(id, reply) => {
                    self.flush().await?;
                    let _ = reply.send(self.status(id).await?);
                }
                Command::Cancel { job, why, reply } => {
                    self.flush().await?;
                    self.cancel(job, &why).await?;
                    let _ = reply.send(self.status(job).await?);
                }
                Command::Pause {
                    job,
                    paused,
                    who,
                    reply,
                } => {
                    self.flush().await?;
                    let _ = reply.send(self.pause(job, paused, &who).await?);
                }
                Command::Retry(id, reply) => {
                    self.flush().await?;
                    let _ = reply.send(self.retry(id).await?);
                }
                Command::Workers(reply) => {
                    let _ = reply.send(Ok(self.core.everywhere()));
                }
                Command::Look(reply) => {
                    let _ = reply.send(Ok(self.core.look()));
                }
                Command::LookAt {
                    job,
                    stage,
                    task,
                    reply,
                } => {
                    let look = self.core.look_at(job, stage, task, self.now());
                    let _ = reply.send(Ok(look));
                }
                Command::Drain(worker, reply) => {
                    let _ = reply.send(Ok(self.core.drain(&worker)));
                }
            }
        }
        Ok(())
    }

    fn worker_said(
        &mut self,
        session: SessionId,
        said: FromWorker,
        known: &HashMap<(StageRef, u64), Option<[u8; 32]>>,
    ) {
        let now = self.now();
        match said {
            FromWorker::Credit(n) => self.core.credit(session, n),
            FromWorker::Heartbeat(leases, progress) => {
                self.core.heartbeat(session, &leases, &progress, now);
            }
            FromWorker::Done(report) => {
                self.commits.extend(trace::commit(&report));
                let hint = self
                    .core
                    .stage_of(&report)
                    .and_then(|stage| known.get(&(stage, report.index)).copied().flatten());
                self.core.finished(session, &report, OutputHint(hint), now);
            }
            FromWorker::Failed(failure) => {
                let before = self.core.noted();
                self.core.failed(session, &failure, now);
                // A refused report leaves no line.
                if self.core.noted() > before {
                    self.tally.failed(failure.kind);
                }
            }
            FromWorker::Release(lease, reason) => self.core.released(session, lease, &reason, now),
            FromWorker::Log(log) => self.core.logged(session, &log, now),
            FromWorker::Closed => {
                self.sessions.remove(&session);
                self.core.closed(session, now);
            }
        }
    }

    async fn status(&self, id: JobId) -> Result<Result<JobStatus, Refusal>, CatalogError> {
        let record = self.actor.catalog.job(id).await?;
        let status = record.map(|r| self.core.status(r, self.now()));
        Ok(status.ok_or(Refusal::NoSuchJob(id)))
    }

    /// Stops a job, if it is active.
    async fn cancel(&mut self, job: JobId, why: &str) -> Result<(), CatalogError> {
        let catalog = &self.actor.catalog;
        if catalog.job(job).await?.is_some() && catalog.cancel(job, why, self.now()).await? {
            self.core.drop_job(job, "the job was cancelled");
            self.flush().await?;
        }
        Ok(())
    }

    async fn pause(
        &mut self,
        job: JobId,
        paused: bool,
        who: &str,
    ) -> Result<Result<JobStatus, Refusal>, CatalogError> {
        let catalog = &self.actor.catalog;
        let Some(record) = catalog.job(job).await? else {
            return Ok(Err(Refusal::NoSuchJob(job)));
        };
        if record.job.state != JobState::Active {
            return Ok(Err(Refusal::NotNow(format!("job {job} has ended"))));
        }
        if catalog.pause(job, paused, who, self.now()).await? {
            self.core.paused(job, paused);
            self.flush().await?;
        }
        self.status(job).await
    }

    /// What submitting would do, and the job that has this spec already.
    async fn plan(
        &self,
        spec: &JobSpec,
    ) -> Result<Result<(JobPlan, Option<Job>), Refusal>, CatalogError> {
        let catalog = &self.actor.catalog;
        for stage in &spec.stages {
            let set = ResultSet::of(stage);
            if stage.task.writes().is_none() {
                continue;
            }
            let others = catalog.jobs_at(&set.store, &set.dataset).await?;
            if let Err(why) = place_is_free(stage, &others) {
                return Ok(Err(Refusal::Spec(spec.at(stage, why))));
            }
        }
        let runs = self.existing(spec).await?;
        let latest = catalog.job_with(&spec_hash(spec)).await?;
        let recent = catalog.recent(RECENT).await?;
        let plan = plan::plan(spec, &runs, latest.as_ref().map(|job| job.id), &recent);
        Ok(Ok((plan, latest)))
    }

    /// The outputs there are, by stage.
    async fn existing(&self, spec: &JobSpec) -> Result<Vec<Vec<Run>>, CatalogError> {
        let mut runs = Vec::with_capacity(spec.stages.len());
        for stage in &spec.stages {
            let set = ResultSet::of(stage);
            runs.push(self.actor.catalog.output_runs(&set, stage.tasks()).await?);
        }
        Ok(runs)
    }

    async fn submit(
        &mut self,
        spec: JobSpec,
        user: String,
        most: u64,
        again: bool,
    ) -> Result<Result<Submitted, Refusal>, CatalogError> {
        let (plan, latest) = match self.plan(&spec).await? {
            Ok(found) => found,
            Err(why) => return Ok(Err(why)),
        };
        let existed = |job: JobId, plan| {
            Ok(Ok(Submitted {
                job,
                existed: true,
                plan,
            }))
        };
        if let Some(job) = stands_for(latest, again) {
            return existed(job.id, plan);
        }
        let catalog = &self.actor.catalog;
        if catalog.jobs_of(&user).await? >= most {
            return Ok(Err(Refusal::TooMany(format!(
                "{user:?} has {most} jobs that have not ended, the most that --max-jobs-per-user allows; wait for some to \
                 end, or cancel some"
            ))));
        }
        let runs = self.existing(&spec).await?;
        let now = self.now();
        let Prepared {
            job,
            ranges,
            events,
        } = self.core.prepare(spec, user, &runs, now);
        if !catalog.submit(&job, &ranges, &events).await? {
            // Another coordinator was first.
            return Ok(match catalog.job_with(&job.spec_hash).await? {
                Some(first) => return existed(first.id, plan),
                None => Err(Refusal::NotNow(
                    "the same job is being submitted by someone else; try again".into(),
                )),
            });
        }
        // A job without anything to run has ended by now.
        if let Some(record) = catalog.job(job.id).await? {
            self.learn(&record.job).await?;
        }
        self.actor.revision.send_modify(|n| *n += 1);
        Ok(Ok(Submitted {
            job: job.id,
            existed: false,
            plan,
        }))
    }

    async fn retry(&mut self, id: JobId) -> Result<Result<u64, Refusal>, CatalogError> {
        let catalog = &self.actor.catalog;
        let Some(record) = catalog.job(id).await? else {
            return Ok(Err(Refusal::NoSuchJob(id)));
        };
        if record.job.state == JobState::Cancelled {
            return Ok(Err(Refusal::NotNow(format!(
                "job {id} was cancelled; submit it again instead (finished tasks are reused)"
            ))));
        }
        let retried = match catalog.retry(id, self.now()).await {
            Ok(retried) => retried,
            Err(CatalogError::Conflict(why)) => return Ok(Err(Refusal::NotNow(why))),
            Err(error) => return Err(error),
        };
        if retried > 0 {
            self.core.retried(id);
            if let Some(record) = catalog.job(id).await? {
                self.learn(&record.job).await?;
            }
        }
        Ok(Ok(retried))
    }

    /// Makes what the core decided durable, then says it.
    async fn flush(&mut self) -> Result<(), CatalogError> {
        let (changes, mut say) = self.core.take();
        // Spans end when what they stand for is durable.
        let _grants = trace::grants(&mut say);
        let _commits = std::mem::take(&mut self.commits);
        let changed = !changes.is_empty();
        let mut tally = std::mem::take(&mut self.tally);
        tally.note(&changes, &say);
        let began = Instant::now();
        let settled = self.actor.catalog.commit(changes).await?;
        self.actor.metrics.add(&tally);
        if changed {
            self.actor.metrics.committed(began.elapsed());
        }
        self.core.settled(&settled);
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
        Command::Get(_, reply) | Command::Cancel { reply, .. } | Command::Pause { reply, .. } => {
            no(reply, error)
        }
        Command::Drain(_, reply) => no(reply, error),
        Command::Retry(_, reply) => no(reply, error),
        Command::Workers(reply) => no(reply, error),
        Command::Look(reply) => no(reply, error),
        Command::LookAt { reply, .. } => no(reply, error),
    }
}
