//! The one task that owns the core. It takes what has arrived, claims the tasks that are wanted, lets the core decide,
//! makes the outcome durable in one commit, and only then answers: whatever waits meanwhile forms the next commit.

use std::{
    collections::{HashMap, hash_map::Entry},
    panic::AssertUnwindSafe,
    sync::Arc,
    time::{Duration, Instant},
};

use futures::FutureExt;
use picofarm_catalog::{Catalog, CatalogError, Changes, Job, Settled};
use picofarm_proto::{
    ids::{JobId, LeaseRef, StageRef},
    model::{
        Failure, FailureKind, Finished, JobPlan, JobSpec, JobState, SpecError, TaskLog,
        TaskProgress, WorkerHello,
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
        Core, Fits, JobLook, Learnt, Look, OutputHint, Overlay, Reported, Say, SessionId, Settings,
        Timings,
    },
    health::Health,
    memory::{Memory, kept_cost},
    metrics::{Metrics, Tally},
    sessions::{Sessions, Waiting},
    trace,
};

/// Messages handled in one commit.
const BATCH: usize = 4096;
/// How long to wait before trying a catalog again that failed.
const RETRY_AFTER: Duration = Duration::from_secs(1);
/// Claims in one turn at most; the rest waits for the next turn.
const ROUNDS: usize = 8;
/// How often the catalog hears that this instance lives, and is asked for news.
const BEAT: Duration = Duration::from_secs(1);
/// Least time between two beats, whatever the hints.
const BEAT_AT_LEAST: Duration = Duration::from_millis(100);

/// A job that was to be read and is not known after so long is read again.
const READ_AGAIN: Duration = Duration::from_secs(30);
/// Disputed reports for which stores are asked at a time; of more, what is recorded stands.
const DISPUTES: usize = 64;

/// A question whose answer may be an error in words.
pub(crate) type Reply<T> = oneshot::Sender<Result<T, Refusal>>;

/// Why a request was not granted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Refusal {
    NoSuchJob(JobId),
    Denied(String),
    NotNow(String),
    /// The catalog cannot hold what was sent.
    Content(String),
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
        /// Heartbeats of the session that wait here to be handled.
        waiting: Waiting,
        /// The worker is on the coordinator's machine.
        here: bool,
    },
    Worker(SessionId, FromWorker),
    /// Reports whose store was looked into.
    Verified {
        store: String,
        reports: Vec<(Reported, Verdict)>,
        /// The store turned out to be another one than that of the workers.
        blind: bool,
    },
    /// A report of another result than the recorded one, and what became of that record.
    Judged(SessionId, Finished, Ruling),
    /// The catalog has failed to write beside the actor: a new life begins, as when it fails to write here.
    Broken(CatalogError),
    /// A job that was recorded, if it is active; otherwise there is only something to look at.
    Learn(Option<Box<Learnt>>, Reply<()>),
    /// What is known here of a job, or of all.
    Overlay(Option<JobId>, Reply<Overlay>),
    Cancel {
        job: JobId,
        why: String,
        reply: Reply<()>,
    },
    Pause {
        job: JobId,
        paused: bool,
        who: String,
        reply: Reply<()>,
    },
    Drain(String, Reply<u32>),
    Retry(JobId, Reply<u64>),
    Workers(Reply<u32>),
    /// Which connected workers could run a job that is planned.
    Fits(Arc<JobSpec>, Reply<Fits>),
    /// What the instance knows, without asking the catalog.
    Look(Reply<Look>),
    LookAt {
        job: JobId,
        stage: Option<u32>,
        task: Option<u64>,
        reply: Reply<JobLook>,
    },
}

/// Which of two results of a task counts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Ruling {
    /// The reported one: the record of the other is gone. In words.
    Overruled(String),
    /// The recorded one.
    Stands,
    /// That cannot be found out from here.
    Unknown,
}

/// Whether a store holds what was reported.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// It does.
    Held,
    /// That cannot be found out from here.
    Unknown,
    /// It does not: why the report is refused.
    Contradicted(String),
}

/// What a worker says in its session.
pub(crate) enum FromWorker {
    Credit(u32),
    /// With the milliseconds until the worker must end, where that is known.
    Heartbeat(Vec<LeaseRef>, Vec<TaskProgress>, Option<u64>),
    Done(Finished),
    Failed(Failure),
    /// A report on this task that says what cannot be: why.
    Unusable(LeaseRef, u64, String),
    Release(LeaseRef, String),
    Log(TaskLog),
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
    pub metrics: Arc<Metrics>,
    pub health: Arc<Health>,
    pub stop: CancellationToken,
    pub memory: Arc<Memory>,
    pub aside: Arc<dyn Aside>,
}

/// What takes too long for the actor, and comes back as a command.
pub(crate) trait Aside: Send + Sync {
    /// Reads a job that the actor has heard of: [`Command::Learn`].
    fn learn(&self, job: JobId);
    /// Asks the store whether a report or what is recorded instead is right: [`Command::Judged`]. `false` where no store can
    /// be asked; then nothing comes.
    fn judge(&self, session: SessionId, report: &Finished, dispute: Dispute) -> bool;
    /// Drops what is recorded instead of a report on which two workers agree: [`Command::Judged`].
    fn replace(&self, session: SessionId, report: &Finished, dispute: Dispute);
    /// Whether any store can be looked into.
    fn looks(&self) -> bool;
    /// Looks for reported results in their store: [`Command::Verified`].
    fn verify(&self, store: String, reports: Vec<Reported>);
}

/// A report of another manifest than the one that is recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Dispute {
    pub stage: StageRef,
    pub recorded: [u8; 32],
}

/// What the catalog holds for the tasks that were just reported.
type Known = HashMap<(StageRef, u64), Option<[u8; 32]>>;

/// One life of a core: from a load of the catalog to the first failure to write it.
struct Life<'a> {
    actor: &'a Actor,
    core: Core,
    sessions: Sessions,
    tally: Tally,
    /// Of reports that are not durable yet.
    commits: Vec<Span>,
    /// By the clock that counts stalls and suspends: when that was looked at last.
    looked_ms: i64,
    /// Memory that the specs of jobs take that have not ended.
    kept: HashMap<JobId, u64>,
    /// Jobs that are being read, and since when.
    learning: HashMap<JobId, Instant>,
    /// Reports about which a store is being asked.
    disputes: usize,
    /// Stores that are being looked into, and the reports that wait until that is done.
    looking: HashMap<String, Vec<Reported>>,
}

impl Actor {
    /// Runs until `stop`. When the catalog fails, sessions end (workers keep computing and come back), and the
    /// state is loaded afresh.
    pub(crate) async fn run(self, mut commands: mpsc::Receiver<Command>) {
        while !self.stop.is_cancelled() {
            let life = async { self.begin().await?.run(&mut commands).await };
            // A panic is a bug, but no reason to drop everyone: the state is loaded afresh.
            let (brief, why) = match AssertUnwindSafe(life).catch_unwind().await {
                Ok(Ok(())) => break,
                Ok(Err(error)) => (error.brief(), error.to_string()),
                Err(_) => (
                    "the coordinator failed",
                    "the coordinator panicked; please report this with its log".to_owned(),
                ),
            };
            tracing::error!("{why}; trying again in {} s", RETRY_AFTER.as_secs());
            self.health.fault(brief, &why);
            tokio::select! {
                () = tokio::time::sleep(RETRY_AFTER) => {}
                () = self.stop.cancelled() => {}
            }
            // Those who asked meanwhile get an error at once rather than kept waiting.
            while let Ok(command) = commands.try_recv() {
                refuse(command, &why);
            }
        }
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
        tracing::debug!(instance = %snapshot.instance, jobs = snapshot.jobs.len(),
            ranges = snapshot.owned.ranges.len(), "an instance begins");
        let jobs = snapshot.jobs.iter();
        let kept = jobs.map(|job| (job.id, kept_cost(&job.spec))).collect();
        let core = Core::load(
            snapshot,
            &timings,
            self.settings,
            Box::new(Uuid::now_v7),
            self.clock.now_ms(),
        );
        let life = Life {
            actor: self,
            core,
            kept,
            sessions: Sessions::default(),
            tally: Tally::default(),
            commits: Vec::new(),
            looked_ms: self.clock.passed_ms(),
            learning: HashMap::new(),
            disputes: 0,
            looking: HashMap::new(),
        };
        life.note_kept();
        Ok(life)
    }
}

impl Life<'_> {
    async fn run(mut self, commands: &mut mpsc::Receiver<Command>) -> Result<(), CatalogError> {
        let mut tick = tokio::time::interval(self.actor.tick);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        // The first beat at once: news that are missed between loading and now come with it.
        let mut beaten: Option<Instant> = None;
        let mut hinted = false;
        let mut batch = Vec::with_capacity(BATCH);
        loop {
            self.actor.health.turn();
            self.after_stall();
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
                        // In this order: a stall between the two is seen with the next tick.
                        let now = self.now();
                        self.after_stall();
                        // Whoever's heartbeat waits here is not late.
                        for session in self.sessions.waiting() {
                            self.core.spare(session, now);
                        }
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
                        // First of all: what has just come may be about leases that ran out meanwhile.
                        self.after_stall();
                        self.handle(&mut batch).await?;
                    }
                    () = tokio::time::sleep(due) => continue,
                }
            }
            self.serve().await?;
        }
    }

    /// Claims and grants until nothing more can be granted now: what a claim did not bring is
    /// another job's turn.
    async fn serve(&mut self) -> Result<(), CatalogError> {
        for _ in 0..ROUNDS {
            let claimed = self.supply().await?;
            self.core.dispatch(self.now());
            if !claimed {
                break;
            }
        }
        self.flush().await
    }

    /// A stall of this process (a suspended machine, a stopped debugger, a catalog that does not answer) is no worker's
    /// fault: its leases begin anew. To be called before anything is judged by the clock.
    fn after_stall(&mut self) {
        let passed = self.actor.clock.passed_ms();
        let stall = passed - std::mem::replace(&mut self.looked_ms, passed);
        let tick = i64::try_from(self.actor.tick.as_millis()).unwrap_or(i64::MAX);
        if stall > tick.saturating_add(i64::from(self.actor.settings.lease_ms) / 2) {
            let seconds = stall as f64 / 1000.0;
            tracing::warn!(seconds, "the coordinator was stalled; leases are prolonged");
            self.core.grace(self.now());
        }
    }

    /// The orderly end of an instance: what nobody runs is free for others.
    async fn end(mut self) -> Result<(), CatalogError> {
        self.core.give_back();
        self.flush().await
    }

    /// Claims what connected workers could run; `false` where nothing is to be claimed.
    async fn supply(&mut self) -> Result<bool, CatalogError> {
        let wants = self.core.wants(self.now());
        if wants.is_empty() {
            return Ok(false);
        }
        // What is noted so far first: the catalog must know this instance's ranges as they are.
        self.flush().await?;
        let claims = self.actor.catalog.claim(&wants).await?;
        let now = self.now();
        for (want, claim) in wants.iter().zip(claims) {
            self.core.claimed(want.stage, claim, now);
        }
        Ok(true)
    }

    /// Tells the catalog that this instance lives, and hears what is new.
    async fn beat(&mut self) -> Result<(), CatalogError> {
        self.core.give_back();
        self.flush().await?;
        let connected = self.core.connected();
        let news = self.actor.catalog.beat(connected, self.now()).await?;
        self.actor.health.beat();
        let now = self.now();
        let unknown = self.core.hear(news, now);
        self.kept.retain(|job, _| self.core.knows(*job));
        self.note_kept();
        let begun = |at: &mut Instant| at.elapsed() < READ_AGAIN;
        self.learning
            .retain(|job, at| unknown.contains(job) && begun(at));
        for job in unknown {
            if let Entry::Vacant(entry) = self.learning.entry(job) {
                entry.insert(Instant::now());
                self.actor.aside.learn(job);
            }
        }
        Ok(())
    }

    /// Takes note of a job that is new here.
    fn learn(&mut self, learnt: Learnt) {
        self.learning.remove(&learnt.job.id);
        if !self.core.knows(learnt.job.id) {
            self.kept.insert(learnt.job.id, learnt.kept);
            self.core
                .add_job(&learnt.job, learnt.stages, &learnt.timings);
            self.note_kept();
        }
    }

    /// Says how much memory the specs of jobs take that have not ended.
    fn note_kept(&self) {
        self.actor.memory.keep_jobs(self.kept.values().sum());
    }

    fn now(&self) -> i64 {
        self.actor.clock.now_ms()
    }

    async fn handle(&mut self, batch: &mut Vec<Command>) -> Result<(), CatalogError> {
        // What the catalog holds for the tasks reported, in one go.
        let reports = batch.iter().flat_map(|command| match command {
            Command::Worker(_, FromWorker::Done(report)) | Command::Judged(_, report, _) => {
                vec![report]
            }
            Command::Verified { reports, .. } => reports
                .iter()
                .map(|(reported, _)| &reported.report)
                .collect(),
            _ => Vec::new(),
        });
        let asked: Vec<(StageRef, u64)> = reports
            .filter_map(|report| Some((self.core.stage_of(report)?, report.index)))
            .collect();
        let mut new: HashMap<String, Vec<Reported>> = HashMap::new();
        let found = self.actor.catalog.manifests(&asked).await?;
        let known: Known = asked.into_iter().zip(found).collect();
        for command in batch.drain(..) {
            match command {
                Command::Open {
                    session,
                    hello,
                    say,
                    waiting,
                    here,
                } => {
                    // The worker brings its leases along, from whichever coordinator.
                    self.flush().await?;
                    let owned = self.actor.catalog.adopt(hello.id).await?;
                    let now = self.now();
                    self.core.receive(owned, now);
                    self.sessions.open(session, say, waiting);
                    self.core.hello(session, hello, now);
                    self.core.is_here(session, here);
                }
                Command::Worker(session, FromWorker::Done(report)) => {
                    let looks = self.actor.aside.looks();
                    match self.core.reported(session, &report).filter(|_| looks) {
                        _ if self.disputed(session, &report, &known) => {}
                        Some(reported) => {
                            let reports = new.entry(reported.store.clone()).or_default();
                            reports.push(reported);
                        }
                        None => self.done(session, &report, &known, false),
                    }
                }
                Command::Verified {
                    store,
                    reports,
                    blind,
                } => {
                    self.verified(&store, reports, blind, &known);
                }
                Command::Judged(session, report, ruling) => {
                    self.disputes = self.disputes.saturating_sub(1);
                    match ruling {
                        Ruling::Unknown if self.outvoted(session, &report, &known) => {}
                        Ruling::Overruled(note) => {
                            self.core.overruled(session, &report, note, self.now());
                            self.done(session, &report, &known, false);
                        }
                        Ruling::Stands | Ruling::Unknown => {
                            self.done(session, &report, &known, false);
                        }
                    }
                }
                Command::Worker(session, said) => self.worker_said(session, said),
                Command::Broken(error) => return Err(error),
                Command::Learn(learnt, reply) => {
                    if let Some(learnt) = learnt {
                        self.learn(*learnt);
                    }
                    self.actor.revision.send_modify(|n| *n += 1);
                    let _ = reply.send(Ok(()));
                }
                Command::Overlay(one, reply) => {
                    let _ = reply.send(Ok(self.core.overlay(one, self.now())));
                }
                Command::Cancel { job, why, reply } => {
                    self.flush().await?;
                    let cancelled = self.cancel(job, &why).await;
                    answer(reply, cancelled.map(Ok))?;
                }
                Command::Pause {
                    job,
                    paused,
                    who,
                    reply,
                } => {
                    self.flush().await?;
                    answer(reply, self.pause(job, paused, &who).await)?;
                }
                Command::Retry(id, reply) => {
                    self.flush().await?;
                    answer(reply, self.retry(id).await)?;
                }
                Command::Workers(reply) => {
                    let _ = reply.send(Ok(self.core.everywhere()));
                }
                Command::Fits(spec, reply) => {
                    let _ = reply.send(Ok(self.core.fits(&spec)));
                }
                Command::Look(reply) => {
                    let _ = reply.send(Ok(self.core.look(self.now())));
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
        for (store, reports) in new {
            self.look_for(store, reports);
        }
        Ok(())
    }

    /// Has reported results looked for in their store: one look at a time, since the next one takes what has come meanwhile.
    fn look_for(&mut self, store: String, reports: Vec<Reported>) {
        match self.looking.entry(store) {
            Entry::Occupied(mut waiting) => waiting.get_mut().extend(reports),
            Entry::Vacant(entry) if !reports.is_empty() => {
                self.actor.aside.verify(entry.key().clone(), reports);
                entry.insert(Vec::new());
            }
            Entry::Vacant(_) => {}
        }
    }

    /// Commits or refuses reports whose store was looked into.
    fn verified(
        &mut self,
        store: &str,
        reports: Vec<(Reported, Verdict)>,
        blind: bool,
        known: &Known,
    ) {
        if blind {
            self.core.forgive(store);
        }
        for (
            Reported {
                session, report, ..
            },
            verdict,
        ) in reports
        {
            match verdict {
                Verdict::Contradicted(why) => {
                    self.core.contradicted(session, &report, &why, self.now());
                }
                _ if self.disputed(session, &report, known) => {}
                verdict => self.done(session, &report, known, verdict == Verdict::Held),
            }
        }
        if let Some(waiting) = self.looking.remove(store) {
            self.look_for(store.to_owned(), waiting);
        }
    }

    /// Whether this report is the second of another result than the recorded one: then the record gives way, and the report
    /// is answered after that.
    fn outvoted(&mut self, session: SessionId, report: &Finished, known: &Known) -> bool {
        let Some(dispute) = self.dispute(report, known) else {
            return false;
        };
        let outvoted = self.core.outvoted(session, report);
        if outvoted {
            self.disputes += 1;
            self.actor.aside.replace(session, report, dispute);
        }
        outvoted
    }

    /// Whether a store is asked before this report is answered: another manifest is recorded, and who came first is no
    /// reason to believe it.
    fn disputed(&mut self, session: SessionId, report: &Finished, known: &Known) -> bool {
        let Some(dispute) = self.dispute(report, known) else {
            return false;
        };
        let asked = self.disputes < DISPUTES && self.actor.aside.judge(session, report, dispute);
        self.disputes += usize::from(asked);
        asked || self.outvoted(session, report, known)
    }

    /// The record that a report contradicts.
    fn dispute(&self, report: &Finished, known: &Known) -> Option<Dispute> {
        let stage = self.core.stage_of(report)?;
        let recorded = known.get(&(stage, report.index)).copied().flatten()?;
        let same = hex::encode(recorded).eq_ignore_ascii_case(&report.manifest_sha256);
        (!same).then_some(Dispute { stage, recorded })
    }

    fn done(&mut self, session: SessionId, report: &Finished, known: &Known, checked: bool) {
        self.commits.extend(trace::commit(report));
        let stage = self.core.stage_of(report);
        let hint = stage.and_then(|stage| known.get(&(stage, report.index)).copied().flatten());
        let now = self.now();
        self.core
            .finished(session, report, OutputHint(hint), checked, now);
    }

    fn worker_said(&mut self, session: SessionId, said: FromWorker) {
        let now = self.now();
        match said {
            FromWorker::Credit(n) => self.core.credit(session, n),
            FromWorker::Heartbeat(leases, progress, ends_in_ms) => {
                self.sessions.heard(session);
                self.core.ends(session, ends_in_ms, now);
                self.core.heartbeat(session, &leases, &progress, now);
            }
            FromWorker::Done(_) => unreachable!("handled with what the catalog holds"),
            FromWorker::Unusable(lease, index, why) => {
                let before = self.core.noted();
                self.core.unusable(session, lease, index, &why, now);
                if self.core.noted() > before {
                    self.tally.failed(FailureKind::User);
                }
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
                self.sessions.close(session);
                self.core.closed(session, now);
                self.core.is_here(session, false);
            }
        }
    }

    /// Stops a job, if it is active.
    async fn cancel(&mut self, job: JobId, why: &str) -> Result<(), CatalogError> {
        let catalog = &self.actor.catalog;
        if catalog.state(job).await?.is_some() && catalog.cancel(job, why, self.now()).await? {
            self.core.drop_job(job, "the job was cancelled");
            self.flush().await?;
            // Whoever watches a job of which nothing is in hand here hears of it, too.
            self.actor.revision.send_modify(|n| *n += 1);
        }
        Ok(())
    }

    async fn pause(
        &mut self,
        job: JobId,
        paused: bool,
        who: &str,
    ) -> Result<Result<(), Refusal>, CatalogError> {
        let catalog = &self.actor.catalog;
        match catalog.state(job).await? {
            None => return Ok(Err(Refusal::NoSuchJob(job))),
            Some(JobState::Active) => {}
            Some(_) => return Ok(Err(Refusal::NotNow(format!("job {job} has ended")))),
        }
        if catalog.pause(job, paused, who, self.now()).await? {
            self.core.paused(job, paused);
            self.flush().await?;
            self.actor.revision.send_modify(|n| *n += 1);
        }
        Ok(Ok(()))
    }

    async fn retry(&mut self, id: JobId) -> Result<Result<u64, Refusal>, CatalogError> {
        let catalog = &self.actor.catalog;
        let Some(state) = catalog.state(id).await? else {
            return Ok(Err(Refusal::NoSuchJob(id)));
        };
        if state == JobState::Cancelled {
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
            self.actor.revision.send_modify(|n| *n += 1);
        }
        Ok(Ok(retried))
    }

    /// Commits all of a change set but the rows that the catalog refuses by their content, with what follows from that for
    /// their tasks (see [`picofarm_catalog::culprits`] and [`Core::refused`]).
    ///
    /// # Errors
    /// Those of a commit; `error` where no row is found that is to blame.
    async fn commit_the_rest(
        &mut self,
        changes: &mut Changes,
        say: &mut [(SessionId, Say)],
        mut error: CatalogError,
    ) -> Result<Settled, CatalogError> {
        let catalog = &self.actor.catalog;
        // First with other words, then without them.
        for again in [false, true] {
            let culprits = picofarm_catalog::culprits(catalog.as_ref(), changes).await?;
            if culprits.is_empty() {
                break;
            }
            let now = self.actor.clock.now_ms();
            self.core.refused(changes, say, &culprits, again, now);
            match catalog.commit(changes).await {
                Err(refused @ CatalogError::Refused { .. }) => error = refused,
                settled => return settled,
            }
        }
        Err(error)
    }

    /// Makes what the core decided durable, then says it.
    async fn flush(&mut self) -> Result<(), CatalogError> {
        let (mut changes, mut say) = self.core.take();
        // Spans end when what they stand for is durable.
        let _grants = trace::grants(&mut say);
        let _commits = std::mem::take(&mut self.commits);
        let changed = !changes.is_empty();
        let began = Instant::now();
        let settled = match self.actor.catalog.commit(&changes).await {
            Err(error @ CatalogError::Refused { .. }) => {
                self.commit_the_rest(&mut changes, &mut say, error).await?
            }
            settled => settled?,
        };
        let mut tally = std::mem::take(&mut self.tally);
        tally.note(&changes, &say);
        self.actor.metrics.add(&tally);
        if changed {
            self.actor.metrics.committed(began.elapsed());
        }
        self.core.settled(&settled);
        let mut deaf = Vec::new();
        for (session, what) in say {
            let over = what == Say::Replaced;
            let Some(sender) = self.sessions.get(session) else {
                continue;
            };
            if let Err(error) = sender.try_send(what) {
                tracing::warn!(session, %error, "the worker does not listen; its session ends");
                deaf.push(session);
            }
            if over {
                self.sessions.close(session);
            }
        }
        let heard = changed || !deaf.is_empty();
        for session in deaf {
            self.sessions.close(session);
            let now = self.now();
            self.core.closed(session, now);
        }
        if heard {
            self.actor.revision.send_modify(|n| *n += 1);
        }
        Ok(())
    }
}

/// Answers a request. What the catalog refuses for its content is the asker's error, and no reason to begin anew; any other
/// failure of the catalog is logged and ends this life.
fn answer<T>(
    reply: Reply<T>,
    found: Result<Result<T, Refusal>, CatalogError>,
) -> Result<(), CatalogError> {
    let (answer, end) = match found {
        Ok(answer) => (answer, Ok(())),
        Err(CatalogError::Refused { what, .. }) => (Err(Refusal::Content(what)), Ok(())),
        Err(error) => (Err(Refusal::Catalog(error.to_string())), Err(error)),
    };
    // Nobody may wait any more.
    let _ = reply.send(answer);
    end
}

/// Tells whoever asks that the catalog is out of order.
fn refuse(command: Command, error: &str) {
    fn no<T>(reply: Reply<T>, error: &str) {
        let _ = reply.send(Err(Refusal::Catalog(error.to_owned())));
    }
    match command {
        // Dropping a session's sender ends it.
        Command::Open { .. }
        | Command::Worker(..)
        | Command::Verified { .. }
        | Command::Judged(..)
        | Command::Broken(_) => {}
        Command::Learn(_, reply) | Command::Cancel { reply, .. } | Command::Pause { reply, .. } => {
            no(reply, error)
        }
        Command::Overlay(_, reply) => no(reply, error),
        Command::Drain(_, reply) => no(reply, error),
        Command::Retry(_, reply) => no(reply, error),
        Command::Workers(reply) => no(reply, error),
        Command::Fits(_, reply) => no(reply, error),
        Command::Look(reply) => no(reply, error),
        Command::LookAt { reply, .. } => no(reply, error),
    }
}
