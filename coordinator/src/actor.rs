//! The task that owns the core. It receives commands, claims the tasks that workers want, lets the
//! core decide, and commits the outcome. It answers only after the commit. Commands that arrive
//! during a commit form the next batch.

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

/// Most commands handled in one commit.
const BATCH: usize = 4096;
/// Delay before the catalog is tried again after a failure.
const RETRY_AFTER: Duration = Duration::from_secs(1);
/// Most claims in one turn. Further claims wait for the next turn.
const ROUNDS: usize = 8;
/// Interval at which this instance renews its registration in the catalog and fetches news.
const BEAT: Duration = Duration::from_secs(1);
/// Shortest interval between two beats, even if the catalog reports changes more often.
const BEAT_AT_LEAST: Duration = Duration::from_millis(100);

/// A job is read again if it is still unknown this long after its read began.
const READ_AGAIN: Duration = Duration::from_secs(30);
/// Most disputed reports that are checked against a store at a time. For further reports the
/// recorded result stands.
const DISPUTES: usize = 64;

/// Sends the answer to a request, or the reason for its refusal.
pub(crate) type Reply<T> = oneshot::Sender<Result<T, Refusal>>;

/// The reason why a request was refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Refusal {
    NoSuchJob(JobId),
    Denied(String),
    NotNow(String),
    /// The catalog rejects the content of the request.
    Content(String),
    TooMany(String),
    Spec(SpecError),
    Catalog(String),
}

/// The answer to a submission.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Submitted {
    pub job: JobId,
    pub existed: bool,
    pub plan: JobPlan,
}

/// A request of the rpc modules to the actor.
pub(crate) enum Command {
    Open {
        session: SessionId,
        hello: WorkerHello,
        say: mpsc::Sender<Say>,
        /// The session's heartbeats that wait in the queue.
        waiting: Waiting,
        /// Whether the worker runs on the coordinator's machine.
        here: bool,
    },
    Worker(SessionId, FromWorker),
    /// Reports that were checked against their store.
    Verified {
        store: String,
        reports: Vec<(Reported, Verdict)>,
        /// Whether the store that was checked is not the one that the workers write to.
        blind: bool,
    },
    /// A report that differs from the recorded result, with the ruling on the record.
    Judged(SessionId, Finished, Ruling),
    /// A catalog write outside the actor failed. A new life begins, as after a failed write of the
    /// actor.
    Broken(CatalogError),
    /// A job was recorded. Contains its content if the job is active; otherwise only watchers are
    /// notified.
    Learn(Option<Box<Learnt>>, Reply<()>),
    /// Returns this instance's knowledge of one job, or of all jobs.
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
    /// Returns which connected workers could run a planned job.
    Fits(Arc<JobSpec>, Reply<Fits>),
    /// Returns this instance's knowledge without a query to the catalog.
    Look(Reply<Look>),
    LookAt {
        job: JobId,
        stage: Option<u32>,
        task: Option<u64>,
        reply: Reply<JobLook>,
    },
}

/// Decides which of two results of a task counts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Ruling {
    /// The reported result counts, because the record of the other one was dropped. Contains the
    /// reason.
    Overruled(String),
    /// The recorded result counts.
    Stands,
    /// This coordinator cannot find out which result counts.
    Unknown,
}

/// The result of checking a report against its store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The store contains the reported result.
    Held,
    /// This coordinator cannot check the store.
    Unknown,
    /// The store does not contain the reported result. Contains the reason for the refusal.
    Contradicted(String),
}

/// A message of a worker in its session.
pub(crate) enum FromWorker {
    Credit(u32),
    /// Contains the milliseconds until the worker must end, if known.
    Heartbeat(Vec<LeaseRef>, Vec<TaskProgress>, Option<u64>),
    Done(Finished),
    Failed(Failure),
    /// A report with impossible values on this task. Contains the reason.
    Unusable(LeaseRef, u64, String),
    Release(LeaseRef, String),
    Log(TaskLog),
    Closed,
}

/// The environment in which the actor runs.
pub(crate) struct Actor {
    pub catalog: Arc<dyn Catalog>,
    pub settings: Settings,
    pub tick: Duration,
    pub clock: Clock,
    /// Increases with every change that clients may want to display.
    pub revision: watch::Sender<u64>,
    pub metrics: Arc<Metrics>,
    pub health: Arc<Health>,
    pub stop: CancellationToken,
    pub memory: Arc<Memory>,
    pub aside: Arc<dyn Aside>,
}

/// Work too slow for the actor. Each result comes back as a command.
pub(crate) trait Aside: Send + Sync {
    /// Reads a job that the actor does not know yet and sends [`Command::Learn`].
    fn learn(&self, job: JobId);
    /// Checks against the store whether a report or the recorded result is right and sends
    /// [`Command::Judged`]. Returns `false`, and sends nothing, if no store can be checked.
    fn judge(&self, session: SessionId, report: &Finished, dispute: Dispute) -> bool;
    /// Replaces the recorded result by a report on which two workers agree and sends
    /// [`Command::Judged`].
    fn replace(&self, session: SessionId, report: &Finished, dispute: Dispute);
    /// Returns whether any store can be checked.
    fn looks(&self) -> bool;
    /// Checks reported results against their store and sends [`Command::Verified`].
    fn verify(&self, store: String, reports: Vec<Reported>);
}

/// A report with a manifest that differs from the recorded one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Dispute {
    pub stage: StageRef,
    pub recorded: [u8; 32],
}

/// The recorded manifest hash of each task in a batch of reports.
type Known = HashMap<(StageRef, u64), Option<[u8; 32]>>;

/// One life of a core, from a load of the catalog to the first failed write.
struct Life<'a> {
    actor: &'a Actor,
    core: Core,
    sessions: Sessions,
    tally: Tally,
    /// Spans of the reports that are not durable yet.
    commits: Vec<Span>,
    /// Time at which stalls were last checked, by the clock that also counts suspended time.
    looked_ms: i64,
    /// Memory used by the specs of the jobs that have not ended.
    kept: HashMap<JobId, u64>,
    /// Jobs that are being read, with the time at which each read began.
    learning: HashMap<JobId, Instant>,
    /// Number of reports that are being checked because they differ from the record.
    disputes: usize,
    /// Stores that are being checked, with the reports that wait for the next check.
    looking: HashMap<String, Vec<Reported>>,
}

impl Actor {
    /// Runs until `stop`. If the catalog fails, the sessions end and the state is loaded again.
    /// Workers keep computing and reconnect.
    pub(crate) async fn run(self, mut commands: mpsc::Receiver<Command>) {
        while !self.stop.is_cancelled() {
            let life = async { self.begin().await?.run(&mut commands).await };
            // A panic is a bug, but no reason to end the process: the state is loaded again.
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
            // Requests that arrived meanwhile fail at once instead of waiting.
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
        // The first beat comes at once, because it brings the news missed between loading and now.
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
                // A due beat must not wait for the timer below, which never fires while
                // messages keep arriving: each turn starts a new one.
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
                        // This order matters: a stall between the two calls is noticed at the next
                        // tick.
                        let now = self.now();
                        self.after_stall();
                        // A worker with a heartbeat in the queue is not late.
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
                        // This comes first, because the batch may be about leases that ran out
                        // during a stall.
                        self.after_stall();
                        self.handle(&mut batch).await?;
                    }
                    () = tokio::time::sleep(due) => continue,
                }
            }
            self.serve().await?;
        }
    }

    /// Claims and grants until no further grant is possible. Tasks that one claim did not bring are
    /// left to the next job.
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

    /// Extends all leases after a stall of this process, because a stall is no worker's fault. A
    /// stall is a suspended machine, a stopped debugger or a catalog that does not answer. Call it
    /// before any decision that depends on the clock.
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

    /// Ends the instance in order: pending ranges without a worker become free for other instances.
    async fn end(mut self) -> Result<(), CatalogError> {
        self.core.give_back();
        self.flush().await
    }

    /// Claims tasks for connected workers. Returns `false` if there is nothing to claim.
    async fn supply(&mut self) -> Result<bool, CatalogError> {
        let wants = self.core.wants(self.now());
        if wants.is_empty() {
            return Ok(false);
        }
        // Pending changes go first, because the catalog must know the current ranges of this
        // instance.
        self.flush().await?;
        let claims = self.actor.catalog.claim(&wants).await?;
        let now = self.now();
        for (want, claim) in wants.iter().zip(claims) {
            self.core.claimed(want.stage, claim, now);
        }
        Ok(true)
    }

    /// Renews this instance's registration in the catalog and applies the news.
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

    /// Adds a job new to this instance.
    fn learn(&mut self, learnt: Learnt) {
        self.learning.remove(&learnt.job.id);
        if !self.core.knows(learnt.job.id) {
            self.kept.insert(learnt.job.id, learnt.kept);
            self.core
                .add_job(&learnt.job, learnt.stages, &learnt.timings);
            self.note_kept();
        }
    }

    /// Records how much memory the specs of unfinished jobs use.
    fn note_kept(&self) {
        self.actor.memory.keep_jobs(self.kept.values().sum());
    }

    fn now(&self) -> i64 {
        self.actor.clock.now_ms()
    }

    async fn handle(&mut self, batch: &mut Vec<Command>) -> Result<(), CatalogError> {
        // The recorded results of all reported tasks are fetched with one query.
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
                    // The worker keeps its leases, whichever coordinator granted them.
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

    /// Starts a check of reported results against their store. Each store has one check at a time;
    /// reports that arrive meanwhile are part of the next check.
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

    /// Commits or refuses the reports that were checked against their store.
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

    /// Returns whether this is the second report of a result that differs from the record. If so,
    /// the record is replaced first and the report is answered afterwards.
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

    /// Returns whether the store must be checked before this report is answered. This is the case
    /// if a different manifest is recorded, because the earlier report is not necessarily the right
    /// one.
    fn disputed(&mut self, session: SessionId, report: &Finished, known: &Known) -> bool {
        let Some(dispute) = self.dispute(report, known) else {
            return false;
        };
        let asked = self.disputes < DISPUTES && self.actor.aside.judge(session, report, dispute);
        self.disputes += usize::from(asked);
        asked || self.outvoted(session, report, known)
    }

    /// Returns the record that a report contradicts.
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
                // A refused report adds no line to the history.
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

    /// Cancels a job, if it is active.
    async fn cancel(&mut self, job: JobId, why: &str) -> Result<(), CatalogError> {
        let catalog = &self.actor.catalog;
        if catalog.state(job).await?.is_some() && catalog.cancel(job, why, self.now()).await? {
            self.core.drop_job(job, "the job was cancelled");
            self.flush().await?;
            // Watchers are notified even if this instance has no tasks of the job.
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

    /// Commits a change set without the rows that the catalog rejects for their content. The tasks
    /// of those rows are handled by [`Core::refused`]; [`picofarm_catalog::culprits`] finds them.
    ///
    /// # Errors
    /// Returns the errors of a commit, or `error` if no row is at fault.
    async fn commit_the_rest(
        &mut self,
        changes: &mut Changes,
        say: &mut [(SessionId, Say)],
        mut error: CatalogError,
    ) -> Result<Settled, CatalogError> {
        let catalog = &self.actor.catalog;
        // The first attempt rewords the rejected rows; the second leaves them out.
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

    /// Makes the core's decisions durable, then sends its messages.
    async fn flush(&mut self) -> Result<(), CatalogError> {
        let (mut changes, mut say) = self.core.take();
        // A span ends when the operation it measures is durable.
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

/// Answers a request. If the catalog rejects the request's content, the error goes to the client
/// and the life continues. Any other failure of the catalog is logged and ends this life.
fn answer<T>(
    reply: Reply<T>,
    found: Result<Result<T, Refusal>, CatalogError>,
) -> Result<(), CatalogError> {
    let (answer, end) = match found {
        Ok(answer) => (answer, Ok(())),
        Err(CatalogError::Refused { what, .. }) => (Err(Refusal::Content(what)), Ok(())),
        Err(error) => (Err(Refusal::Catalog(error.to_string())), Err(error)),
    };
    // The client may have stopped waiting.
    let _ = reply.send(answer);
    end
}

/// Answers a request with the error that the catalog is unavailable.
fn refuse(command: Command, error: &str) {
    fn no<T>(reply: Reply<T>, error: &str) {
        let _ = reply.send(Err(Refusal::Catalog(error.to_owned())));
    }
    match command {
        // The session ends because its sender is dropped.
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
