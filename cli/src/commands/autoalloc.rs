//! `picofarm autoalloc`: starts workers by a batch system when tasks wait. It has no state of its
//! own: the coordinator knows what waits, and the batch system knows the allocations.

mod command;
mod decide;
mod fruitless;
mod scheduler;
mod script;
mod slurm;

use std::{
    collections::BTreeSet,
    time::{Duration, Instant},
};

use picofarm_proto::{
    PROTOCOL,
    ids::{Incarnation, WorkerId},
    messages::{Abilities, WorkerHello},
    show,
};
use picofarm_tasks::{Executor, TaskExecutor};
use serde::Serialize;
use tokio::runtime::Handle;
use uuid::Uuid;

use self::{
    command::Commands,
    decide::{Allocation, Bounds, Decision, decide},
    fruitless::Fruitless,
    scheduler::{Request, Scheduler},
    slurm::Slurm,
};
use crate::{
    args::{Autoalloc, HAND_OVER, PoolArgs},
    client::{Client, Demand},
    error::{CliError, Code, Result},
    output::{Output, duration},
    settings::Settings,
    signals,
};

/// An allocation requests the worker's memory divided by this, because a worker uses three quarters
/// of its memory for tasks.
const FOR_TASKS: f64 = 0.75;
/// Time from the start of an allocation until its worker takes a task.
const STARTS: Duration = Duration::from_secs(10);
/// First and longest pause after the batch system refused a submission.
const PAUSE: Duration = Duration::from_secs(5);
const LONGEST_PAUSE: Duration = Duration::from_secs(600);

/// Times that a single decision waits for the coordinator to know what waits.
const ASK_AGAIN: u32 = 5;

/// A decision, and what came of it. One line of the output.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Round {
    #[serde(flatten)]
    decision: Decision,
    /// Ids of the submitted allocations.
    submitted: Vec<String>,
    /// Ids of the cancelled allocations.
    cancelled: Vec<String>,
    /// The batch system's refusal, in its words.
    refused: Option<String>,
    /// Seconds until the next submission after refusals.
    pause_s: Option<u64>,
    /// Whether nothing was done because of --dry-run.
    dry_run: bool,
}

/// Runs a pool until a signal, or for one decision.
///
/// # Errors
/// Fails if a setting cannot be used or the coordinator refuses; with --once, also if the
/// coordinator cannot be reached or the batch system refuses.
pub async fn run(what: Autoalloc, settings: &Settings, output: Output) -> Result<()> {
    let (pool, scheduler) = match what {
        Autoalloc::Slurm { pool, sbatch } => (pool, Scheduler::Slurm(Slurm { options: sbatch })),
        Autoalloc::Command {
            pool,
            submit,
            list,
            cancel,
        } => {
            let commands = Commands {
                submit,
                list,
                cancel,
            };
            (pool, Scheduler::Commands(commands))
        }
    };
    let request = Request {
        name: allocation_name(&pool.pool, &settings.coordinator),
        pool: pool.pool.clone(),
        cores: pool.cores,
        memory_mib: (pool.memory_gib * 1024.0 / FOR_TASKS).ceil() as u64,
        gpus: pool.gpus,
        time_limit: pool.time_limit,
        script: script::script(&pool, settings)?,
    };
    let hello = hello(&pool, settings);
    let stop = signals::stop_on_signal()?;
    let mut pool = Pool {
        scheduler,
        request,
        hello,
        settings,
        client: None,
        surplus: BTreeSet::new(),
        fruitless: Fruitless::default(),
        refusals: 0,
        pause_until: None,
        said: String::new(),
        output,
        args: pool,
    };
    if pool.args.once {
        return pool.round(true).await;
    }
    output.say(format!(
        "pool {} for {}: allocations are named {}; Ctrl-C ends this program and leaves them",
        pool.args.pool, settings.coordinator, pool.request.name
    ));
    loop {
        match pool.round(false).await {
            Ok(()) => {}
            // A lost coordinator or batch system comes back; a wrong setting or token does not.
            Err(e) if e.denied || matches!(e.code, Code::Input) => return Err(e),
            Err(e) => pool.say_once(&format!("no decision: {}", e.message)),
        }
        tokio::select! {
            () = tokio::time::sleep(pool.args.every) => {}
            () = stop.cancelled() => return Ok(()),
        }
    }
}

struct Pool<'a> {
    scheduler: Scheduler,
    request: Request,
    hello: WorkerHello,
    settings: &'a Settings,
    client: Option<Client>,
    args: PoolArgs,
    /// Allocations that the last decision wanted to cancel. Demand that is absent for one moment
    /// costs no place in the queue.
    surplus: BTreeSet<String>,
    /// Allocations whose workers have not connected.
    fruitless: Fruitless,
    /// Refusals of the batch system, and allocations without a worker, in a row.
    refusals: u32,
    /// No submission before this time.
    pause_until: Option<Instant>,
    /// The last line, which is not repeated.
    said: String,
    output: Output,
}

impl Pool<'_> {
    /// Decides once, and acts.
    async fn round(&mut self, once: bool) -> Result<()> {
        // Before the allocations: a worker that connects in between then counts once, as starting.
        let mut demand = self.demand().await?;
        for _ in 0..ASK_AGAIN {
            if !once || !demand.unknown {
                break;
            }
            // The coordinator reads its catalog once a second.
            tokio::time::sleep(Duration::from_secs(1)).await;
            demand = self.demand().await?;
        }
        let listed = self.scheduler.list(&self.request).await;
        let allocations = listed.map_err(|why| CliError::new(Code::Resource, why))?;
        let prefix = script::prefix(&self.args.pool);
        self.look(&demand, &allocations, &prefix);
        let bounds = Bounds {
            max_workers: self.args.max_workers,
            backlog: self.args.backlog,
            work_s: self.args.work_per_worker.as_secs_f64(),
        };
        let decision = decide(&demand, &allocations, &bounds, |name, allocation| {
            is_worker(name, &prefix, allocation)
        });
        let surplus: BTreeSet<String> = decision.cancel.iter().cloned().collect();
        let mut round = Round {
            submitted: Vec::new(),
            cancelled: Vec::new(),
            refused: None,
            pause_s: None,
            dry_run: self.args.dry_run,
            decision,
        };
        if !self.args.dry_run {
            self.submit(&mut round).await;
            for id in &round.decision.cancel {
                if !once && !self.surplus.contains(id) {
                    continue;
                }
                match self.scheduler.cancel(&self.request, id).await {
                    Ok(()) => {
                        self.fruitless.cancelled(id);
                        round.cancelled.push(id.clone());
                    }
                    Err(why) => self.output.warn(format!("warning: {why}")),
                }
            }
        }
        self.surplus = surplus;
        // Numbers of tasks change all the time; a line is worth it if a number of workers does.
        let d = &round.decision;
        let state = format!(
            "{:?} {:?}",
            (d.wanted, d.pending, d.running, d.unable, d.submit),
            (&round.submitted, &round.cancelled, &round.refused)
        );
        if state != self.said || once {
            self.output.result(&round, || words(&round));
            self.said = state;
        }
        match round.refused {
            Some(why) if once => Err(CliError::new(Code::Resource, why)),
            _ => Ok(()),
        }
    }

    /// Pauses if allocations end before their workers connect.
    fn look(&mut self, demand: &Demand, allocations: &[Allocation], prefix: &str) {
        let connected = |a: &Allocation| {
            let workers = &demand.workers;
            workers.iter().any(|w| is_worker(&w.name, prefix, a))
        };
        let news = self.fruitless.look(allocations, connected);
        if news.connected {
            self.refusals = 0;
            self.pause_until = None;
        }
        // Between two rounds, a worker may connect and end only if it is idle for less.
        if !news.ended.is_empty() && self.args.idle > self.args.every {
            let pause = self.pause();
            self.output.warn(format!(
                "warning: {} ended before a worker connected, or the list leaves it out; the logs of the allocations may tell why; submits again in {}",
                news.ended.join(", "),
                duration(pause.as_secs_f64())
            ));
        }
    }

    /// Begins the next pause and returns its length.
    fn pause(&mut self) -> Duration {
        let pause = pause(self.refusals);
        self.refusals += 1;
        self.pause_until = Some(Instant::now() + pause);
        pause
    }

    /// Submits the decided allocations until one is refused.
    async fn submit(&mut self, round: &mut Round) {
        let now = Instant::now();
        if let Some(left) = self
            .pause_until
            .and_then(|at| at.checked_duration_since(now))
        {
            if round.decision.submit > 0 {
                round.pause_s = Some(left.as_secs() + 1);
            }
            return;
        }
        for _ in 0..round.decision.submit {
            match self.scheduler.submit(&self.request).await {
                Ok(id) => {
                    self.fruitless.submitted(&id);
                    round.submitted.push(id);
                    self.pause_until = None;
                }
                Err(why) => {
                    round.refused = Some(why);
                    round.pause_s = Some(self.pause().as_secs());
                    return;
                }
            }
        }
    }

    /// Returns what waits for the pool's workers.
    async fn demand(&mut self) -> Result<Demand> {
        let mut client = match self.client.take() {
            Some(client) => client,
            None => Client::connect(&self.settings.coordinator, &self.settings.access()?).await?,
        };
        let demand = client.demand(&self.hello).await?;
        self.client = Some(client);
        Ok(demand)
    }

    fn say_once(&mut self, line: &str) {
        if self.said != line {
            self.output.warn(format!("warning: {line}"));
            line.clone_into(&mut self.said);
        }
    }
}

/// Returns the pause after this many refusals in a row before.
fn pause(refusals: u32) -> Duration {
    PAUSE
        .saturating_mul(1 << refusals.min(10))
        .min(LONGEST_PAUSE)
}

/// Describes a round in one line.
fn words(round: &Round) -> String {
    let d = &round.decision;
    let mut parts = Vec::new();
    if !round.submitted.is_empty() {
        parts.push(format!("submitted {}", round.submitted.join(", ")));
    }
    if !round.cancelled.is_empty() {
        parts.push(format!("cancelled {}", round.cancelled.join(", ")));
    }
    if let Some(why) = &round.refused {
        parts.push(format!("refused: {}", show::line(why)));
    }
    if let Some(s) = round.pause_s {
        // The remaining time is not part of the line, which would change with every round.
        parts.push(match &round.refused {
            Some(_) => format!("submits again in {}", duration(s as f64)),
            None => {
                "submits nothing for now after a refusal or an allocation without a worker".into()
            }
        });
    }
    if round.dry_run {
        parts.push(format!(
            "dry run: would submit {} and cancel {}",
            d.submit,
            d.cancel.len()
        ));
    }
    if parts.is_empty() {
        parts.push("nothing to do".into());
    }
    format!("{}: {}", parts.join("; "), d.reason)
}

/// Returns whether a worker runs in an allocation: its name is the prefix, the allocation's id and
/// the node.
fn is_worker(name: &str, prefix: &str, allocation: &Allocation) -> bool {
    let rest = name.strip_prefix(prefix);
    let rest = rest.and_then(|rest| rest.strip_prefix(&*allocation.id));
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('@'))
}

/// Returns the name of a pool's allocations, by which a restarted program finds them: it contains
/// pool and farm.
fn allocation_name(pool: &str, coordinators: &str) -> String {
    let first = coordinators.split(',').next().unwrap_or_default().trim();
    let host = first.split_once("://").map_or(first, |(_, host)| host);
    let plain = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    let host: String = host.trim_end_matches('/').chars().map(plain).collect();
    format!("picofarm-{pool}-{host}")
}

/// Returns the greeting of a worker of the pool.
fn hello(pool: &PoolArgs, settings: &Settings) -> WorkerHello {
    // This program stands in for the workers', which must be the same build.
    let anywhere = picofarm_files::Opener::anywhere();
    let executor = TaskExecutor::new(
        std::slice::from_ref(&settings.assets),
        Handle::current(),
        anywhere,
    );
    let lasts = pool.time_limit.saturating_sub(HAND_OVER + STARTS);
    WorkerHello {
        id: WorkerId::from_uuid(Uuid::new_v4()),
        incarnation: Incarnation::from_uuid(Uuid::new_v4()),
        name: pool.pool.clone(),
        version: env!("CARGO_PKG_VERSION").into(),
        protocol: PROTOCOL,
        held: Vec::new(),
        ended: String::new(),
        ends_in_ms: Some(u64::try_from(lasts.as_millis()).unwrap_or(u64::MAX)),
        abilities: Abilities {
            kinds: executor.kinds(),
            assets: executor.assets(),
            cores: u32::try_from(pool.cores).unwrap_or(u32::MAX),
            memory_mib: (pool.memory_gib * 1024.0) as u64,
            gpus: (0..pool.gpus).map(|n| format!("gpu {n}")).collect(),
            labels: pool.label.clone(),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_to_ten_minutes() {
        let pauses: Vec<u64> = (0..9).map(|n| pause(n).as_secs()).collect();
        assert_eq!(pauses, [5, 10, 20, 40, 80, 160, 320, 600, 600]);
        assert_eq!(pause(u32::MAX), LONGEST_PAUSE);
    }

    #[test]
    fn a_name_contains_pool_and_farm() {
        let name = |urls| allocation_name("gpu", urls);
        assert_eq!(
            name("https://farm-a.example.org:7420, https://b:7420"),
            "picofarm-gpu-farm-a-example-org-7420"
        );
        assert_ne!(name("http://a:7420"), name("http://a:7421"));
    }

    #[test]
    fn a_worker_belongs_to_the_allocation_that_its_name_ends_with() {
        let allocation = |id: &str| Allocation {
            id: id.into(),
            running_s: None,
            reason: String::new(),
        };
        assert!(is_worker("gpu-12@n1", "gpu-", &allocation("12")));
        assert!(is_worker("gpu-12", "gpu-", &allocation("12")));
        assert!(!is_worker("gpu-123@n1", "gpu-", &allocation("12")));
        assert!(!is_worker("cpu-12@n1", "gpu-", &allocation("12")));
        assert!(!is_worker("gpu-x-12@n1", "gpu-", &allocation("12")));
    }
}
