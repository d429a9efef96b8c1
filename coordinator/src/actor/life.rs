//! The actor, which lives from a load of the catalog to the first failed write, and then begins a
//! new life.

mod flush;
mod handle;
mod reports;

use std::{
    collections::{BTreeMap, HashMap, hash_map::Entry},
    panic::AssertUnwindSafe,
    sync::Arc,
    time::{Duration, Instant},
};

use futures::FutureExt;
use picofarm_catalog::{Catalog, CatalogError, Job, Sight, published};
use picofarm_proto::ids::JobId;
use tokio::{
    sync::{mpsc, watch},
    time::MissedTickBehavior,
};
use tokio_util::sync::CancellationToken;
use tracing::Span;
use uuid::Uuid;

use super::{
    command::{Command, refuse},
    sessions::Sessions,
    slow_work::SlowWork,
};
use crate::{
    core::{Clock, Core, NewJob, Reported, Settings, Timings, UserQuotas},
    memory::{Memory, kept_cost},
    observe::{
        health::Health,
        metrics::{Metrics, Tally},
    },
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
    /// Returns the current bounds on users.
    pub quotas: Box<dyn Fn() -> UserQuotas + Send + Sync>,
    pub slow_work: Arc<dyn SlowWork>,
}

/// One life of a core, from a load of the catalog to the first failed write.
struct Life<'a> {
    actor: &'a Actor,
    core: Core,
    sessions: Sessions,
    tally: Tally,
    /// Spans of the reports that are not durable yet.
    commits: Vec<Span>,
    /// Time at which stalls were last checked, by the clock that also counts suspended time.
    stall_checked_ms: i64,
    /// Memory used by the specs of the jobs that have not ended.
    kept: HashMap<JobId, u64>,
    /// Jobs that are being read, with the time at which each read began.
    reading: HashMap<JobId, Instant>,
    /// Number of reports that are being checked because they differ from the record.
    disputes: usize,
    /// Stores that are being checked, with the reports that wait for the next check.
    checking: HashMap<String, Vec<Reported>>,
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
        let mut core = Core::load(
            snapshot,
            &timings,
            self.settings,
            Box::new(Uuid::now_v7),
            self.clock.now_ms(),
        );
        core.set_quotas((self.quotas)());
        let life = Life {
            actor: self,
            core,
            kept,
            sessions: Sessions::default(),
            tally: Tally::default(),
            commits: Vec::new(),
            stall_checked_ms: self.clock.passed_ms(),
            reading: HashMap::new(),
            disputes: 0,
            checking: HashMap::new(),
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
        let stall = passed - std::mem::replace(&mut self.stall_checked_ms, passed);
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
        self.read_quotas().await?;
        let now = self.now();
        let unknown = self.core.apply_news(news, now);
        self.kept.retain(|job, _| self.core.knows(*job));
        self.note_kept();
        let begun = |at: &mut Instant| at.elapsed() < READ_AGAIN;
        self.reading
            .retain(|job, at| unknown.contains(job) && begun(at));
        for job in unknown {
            if let Entry::Vacant(entry) = self.reading.entry(job) {
                entry.insert(Instant::now());
                self.actor.slow_work.learn(job);
            }
        }
        Ok(())
    }

    /// Reads the bounds on users and, if they include bytes, the bytes that all coordinators have
    /// counted.
    async fn read_quotas(&mut self) -> Result<(), CatalogError> {
        let quotas = (self.actor.quotas)();
        let published = match quotas.bytes.is_none() {
            true => BTreeMap::new(),
            false => published(&*self.actor.catalog, Sight::All).await?,
        };
        self.core.set_quotas(quotas);
        self.core.set_published(published);
        Ok(())
    }

    /// Adds a job new to this instance.
    fn learn(&mut self, new_job: NewJob) {
        self.reading.remove(&new_job.job.id);
        if !self.core.knows(new_job.job.id) {
            self.kept.insert(new_job.job.id, new_job.kept);
            self.core
                .add_job(&new_job.job, new_job.stages, &new_job.timings);
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
}
