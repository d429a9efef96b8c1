//! `just lab queue`: measures the scheduler without the work. Simulated workers use the real
//! protocol over gRPC with a coordinator in a process of its own, and every task is durably
//! committed. Only rendering is left out.

mod limits;
pub mod pages;
mod raw;
mod server;
pub mod small;
mod stats;
mod worker;

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use picofarm_database::CatalogPlace;
use picofarm_proto::{messages::JobState, spec::JobSpec};
use serde::Serialize;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::args::Queue as QueueArgs;
use picofarm_cli::{
    client::Client,
    error::{CliError, Code, Result},
    output::{Output, bytes, table},
};

use server::Server;
use stats::{Latency, Stats};

/// Rows per transaction for which the raw limit is measured, in addition to the coordinator's own
/// number.
const RAW: [usize; 3] = [1, 100, 1000];

/// Results of the benchmark.
#[derive(Debug, Serialize)]
struct Report {
    catalog: String,
    lease_s: f64,
    submit: Vec<Submit>,
    throughput: Option<Throughput>,
    fleets: Vec<Fleet>,
}

/// Time to submit a job.
#[derive(Debug, Serialize)]
struct Submit {
    tasks: u64,
    seconds: f64,
    /// Peak resident memory of the coordinator afterwards.
    coordinator_peak_bytes: u64,
}

/// No-op tasks, end to end.
#[derive(Debug, Serialize)]
struct Throughput {
    workers: usize,
    tasks: u64,
    seconds: f64,
    tasks_per_second: f64,
    coordinator_cpu_s: f64,
    coordinator_peak_bytes: u64,
    /// Rows per second that one client writes into the same database, by rows per transaction,
    /// before and after.
    raw: Vec<raw::Raw>,
    /// Mean number of tasks in a commit of the coordinator.
    tasks_per_commit: f64,
    /// Ratio of `tasks_per_second` to the rate of a queue with a row per task and the same number
    /// of tasks per transaction, measured right after.
    of_queue: Option<f64>,
    /// Ratio of `tasks_per_second` to the rate of rows that are only appended.
    of_append: Option<f64>,
}

/// Workers with tasks of a fixed duration.
#[derive(Debug, Serialize)]
struct Fleet {
    workers: usize,
    task_s: f64,
    tasks: u64,
    wall_s: f64,
    /// Busy time over workers × wall time, from the first lease to the last commit minus the
    /// duration of one task (the workers finish the last round at different times).
    efficiency: f64,
    lease: Latency,
    heartbeat: Latency,
    reconnects: u64,
    refused: u64,
    revoked: u64,
    coordinator_cpu_s: f64,
    /// CPU seconds of the coordinator per second of wall time.
    coordinator_load: f64,
    coordinator_peak_bytes: u64,
}

/// Runs the whole benchmark.
///
/// # Errors
/// Fails if the coordinator does not start, or if it refuses workers.
pub async fn run(args: QueueArgs, output: Output, stop: &CancellationToken) -> Result<()> {
    let scratch = tempfile::tempdir()
        .map_err(|e| CliError::new(Code::Resource, format!("a scratch folder: {e}")))?;
    let place = match &args.catalog {
        Some(place) => place.clone(),
        None => CatalogPlace::Sqlite(scratch.path().join("catalog.sqlite")),
    };
    let mut report = Report {
        catalog: place.to_string(),
        lease_s: args.lease_s,
        submit: Vec::new(),
        throughput: None,
        fleets: Vec::new(),
    };
    let bench = Bench {
        place,
        args: &args,
        output,
        stop,
    };
    for tasks in &args.submit {
        report.submit.push(bench.submit(*tasks).await?);
    }
    if args.tasks > 0 {
        report.throughput = Some(bench.throughput().await?);
    }
    for workers in &args.fleet {
        report.fleets.push(bench.fleet(*workers).await?);
    }
    output.result(&report, || describe(&report));
    Ok(())
}

struct Bench<'a> {
    place: CatalogPlace,
    args: &'a QueueArgs,
    output: Output,
    stop: &'a CancellationToken,
}

impl Bench<'_> {
    async fn server(&self) -> Result<Server> {
        Server::start(&self.place, self.args.lease_s).await
    }

    async fn submit(&self, tasks: u64) -> Result<Submit> {
        let server = self.server().await?;
        let mut client = server.client().await?;
        let start = Instant::now();
        let job = client.submit(spec(tasks), false).await?.job;
        let seconds = start.elapsed().as_secs_f64();
        // Otherwise it would share the workers of the next measurement.
        client.cancel(job).await?;
        let coordinator_peak_bytes = server.usage()?.peak_bytes;
        self.output
            .say(format!("submitted {tasks} tasks in {seconds:.3} s"));
        Ok(Submit {
            tasks,
            seconds,
            coordinator_peak_bytes,
        })
    }

    async fn throughput(&self) -> Result<Throughput> {
        let mut raw = raw::measure(&self.place, &RAW).await?;
        let server = self.server().await?;
        let mut client = server.client().await?;
        let fleet = Running::start(&server, self.args.workers, Duration::ZERO);
        fleet.connected(self.args.workers as u64, self.stop).await?;
        let before = server.usage()?;
        let commits = server.commits()?;
        let start = Instant::now();
        let job = client.submit(spec(self.args.tasks), false).await?.job;
        self.until_done(&mut client, job, &fleet).await?;
        let seconds = start.elapsed().as_secs_f64();
        let after = server.usage()?;
        let commits = (server.commits()? - commits).max(1);
        fleet.stop().await?;
        drop(server);
        let tasks_per_commit = self.args.tasks as f64 / commits as f64;
        let same = (tasks_per_commit.round() as usize).max(1);
        let like = raw::measure(&self.place, &[same]).await?;
        let share = |limit: f64, rate: f64| (limit > 0.0).then(|| rate / limit);
        let (queue, append) = (like[0].tasks_per_second, like[0].rows_per_second);
        raw.extend(like);
        raw.extend(raw::measure(&self.place, &RAW).await?);
        let tasks_per_second = self.args.tasks as f64 / seconds;
        self.output.say(format!("{tasks_per_second:.0} tasks/s"));
        Ok(Throughput {
            workers: self.args.workers,
            tasks: self.args.tasks,
            seconds,
            tasks_per_second,
            coordinator_cpu_s: after.cpu_s - before.cpu_s,
            coordinator_peak_bytes: after.peak_bytes,
            tasks_per_commit,
            of_queue: share(queue, tasks_per_second),
            of_append: share(append, tasks_per_second),
            raw,
        })
    }

    async fn fleet(&self, workers: usize) -> Result<Fleet> {
        let mut server = self.server().await?;
        let mut client = server.client().await?;
        let task = Duration::from_secs_f64(self.args.task_s);
        let fleet = Running::start(&server, workers, task);
        fleet.connected(workers as u64, self.stop).await?;
        let tasks = workers as u64 * self.args.rounds;
        let before = server.usage()?;
        let start = Instant::now();
        let job = client.submit(spec(tasks), false).await?.job;
        let mut cpu_s = 0.0;
        if self.args.restart {
            // All workers lose their coordinator in the middle of a task, and reconnect at once.
            tokio::time::sleep(task.mul_f64(1.5)).await;
            cpu_s -= before.cpu_s;
            cpu_s += server.kill_and_restart().await?.cpu_s;
            client = server.client().await?;
        } else {
            cpu_s -= before.cpu_s;
        }
        self.until_done(&mut client, job, &fleet).await?;
        let wall_s = start.elapsed().as_secs_f64();
        let usage = server.usage()?;
        cpu_s += usage.cpu_s;
        let stats = fleet.stop().await?;
        let (first, last) = stats.span();
        let busy = tasks as f64 * self.args.task_s;
        let efficiency = busy / (workers as f64 * (last - first).as_secs_f64());
        let percent = efficiency * 100.0;
        self.output
            .say(format!("{workers} workers: {wall_s:.1} s, {percent:.2} %"));
        Ok(Fleet {
            workers,
            task_s: self.args.task_s,
            tasks,
            wall_s,
            efficiency,
            lease: stats.lease(),
            heartbeat: stats.heartbeat(),
            reconnects: stats.reconnects(),
            refused: stats.refused(),
            revoked: stats.revoked(),
            coordinator_cpu_s: cpu_s,
            coordinator_load: cpu_s / wall_s,
            coordinator_peak_bytes: usage.peak_bytes,
        })
    }

    async fn until_done(
        &self,
        client: &mut Client,
        job: picofarm_proto::ids::JobId,
        fleet: &Running,
    ) -> Result<()> {
        loop {
            let status = client.status(job).await?;
            match status.state {
                JobState::Done => return Ok(()),
                JobState::Active => {}
                state => {
                    return Err(CliError::new(
                        Code::Failed,
                        format!("the bench's job ended {state:?}"),
                    ));
                }
            }
            fleet.check()?;
            tokio::select! {
                () = tokio::time::sleep(Duration::from_millis(20)) => {}
                () = self.stop.cancelled() => return Err(picofarm_cli::signals::interrupted("nothing is kept of a bench")),
            }
        }
    }
}

/// Running simulated workers.
struct Running {
    stats: Arc<Stats>,
    workers: JoinSet<()>,
    stop: CancellationToken,
}

impl Running {
    fn start(server: &Server, workers: usize, task: Duration) -> Self {
        let stats = Arc::new(Stats::default());
        let stop = CancellationToken::new();
        let mut set = JoinSet::new();
        for i in 0..workers {
            let simulated = worker::Simulated::new(i, server.url().to_owned(), task, stats.clone());
            let stop = stop.clone();
            set.spawn(async move { simulated.live(stop).await });
        }
        Self {
            stats,
            workers: set,
            stop,
        }
    }

    async fn connected(&self, workers: u64, stop: &CancellationToken) -> Result<()> {
        while self.stats.connected() < workers {
            self.check()?;
            tokio::select! {
                () = tokio::time::sleep(Duration::from_millis(10)) => {}
                () = stop.cancelled() => return Err(picofarm_cli::signals::interrupted("nothing is kept of a bench")),
            }
        }
        Ok(())
    }

    fn check(&self) -> Result<()> {
        match self.stats.trouble() {
            Some(what) => Err(CliError::new(Code::Failed, what)),
            None => Ok(()),
        }
    }

    async fn stop(mut self) -> Result<Arc<Stats>> {
        self.stop.cancel();
        while let Some(ended) = self.workers.join_next().await {
            ended.map_err(|e| {
                CliError::new(Code::Failed, format!("a simulated worker broke: {e}"))
            })?;
        }
        self.check()?;
        Ok(self.stats)
    }
}

/// Returns a job that no real worker renders, with a data set of its own.
fn spec(tasks: u64) -> JobSpec {
    let dataset = format!("bench-{}", uuid::Uuid::new_v4().simple());
    let spec = serde_json::json!({
        "name": "bench", "scenes": {"kind": "primitive", "count": tasks},
        "render": {"renderer": worker::RENDERER}, "output": {"store": "/nowhere", "dataset": dataset},
    });
    serde_json::from_value(spec).expect("a job of all fields that have no default")
}

fn describe(report: &Report) -> String {
    let mut text = format!("catalog {}\n", report.catalog);
    let row = |cells: &[String]| cells.to_vec();
    if !report.submit.is_empty() {
        let mut rows = vec![row(&[
            "submit, tasks".into(),
            "s".into(),
            "coordinator's peak".into(),
        ])];
        for s in &report.submit {
            rows.push(row(&[
                s.tasks.to_string(),
                format!("{:.3}", s.seconds),
                bytes(s.coordinator_peak_bytes),
            ]));
        }
        text += &format!("\n{}", table(&rows));
    }
    if let Some(t) = &report.throughput {
        let mut rows = vec![row(&[
            "no-op tasks".into(),
            format!("{} with {} workers", t.tasks, t.workers),
        ])];
        rows.push(row(&[
            "tasks/s, durable".into(),
            format!("{:.0}", t.tasks_per_second),
        ]));
        for raw in &t.raw {
            rows.push(row(&[
                format!("raw: claim and complete/s, {} a transaction", raw.batch),
                format!("{:.0}", raw.tasks_per_second),
            ]));
            rows.push(row(&[
                format!("raw: rows appended/s, {} a transaction", raw.batch),
                format!("{:.0}", raw.rows_per_second),
            ]));
        }
        let shares = [
            ("claim and complete", t.of_queue),
            ("appending", t.of_append),
        ];
        for (what, share) in shares {
            if let Some(share) = share {
                rows.push(row(&[
                    format!("of raw {what} at {:.0} a transaction", t.tasks_per_commit),
                    format!("{share:.2}"),
                ]));
            }
        }
        rows.push(row(&[
            "coordinator's CPU, a task".into(),
            format!("{:.1} µs", t.coordinator_cpu_s / t.tasks as f64 * 1e6),
        ]));
        rows.push(row(&[
            "coordinator's peak".into(),
            bytes(t.coordinator_peak_bytes),
        ]));
        text += &format!("\n{}", table(&rows));
    }
    if !report.fleets.is_empty() {
        let head = [
            "workers",
            "tasks",
            "wall s",
            "efficiency",
            "lease p50/p99 ms",
            "heartbeat p50/p99 ms",
            "reconnects",
            "refused",
            "revoked",
            "coordinator's load",
            "peak",
        ];
        let mut rows = vec![head.map(String::from).to_vec()];
        for f in &report.fleets {
            rows.push(row(&[
                f.workers.to_string(),
                format!("{} × {} s", f.tasks, f.task_s),
                format!("{:.1}", f.wall_s),
                format!("{:.2} %", f.efficiency * 100.0),
                format!("{:.1} / {:.1}", f.lease.p50_ms, f.lease.p99_ms),
                format!("{:.1} / {:.1}", f.heartbeat.p50_ms, f.heartbeat.p99_ms),
                f.reconnects.to_string(),
                f.refused.to_string(),
                f.revoked.to_string(),
                format!("{:.3} cores", f.coordinator_load),
                bytes(f.coordinator_peak_bytes),
            ]));
        }
        text += &format!("\n{}", table(&rows));
    }
    text
}
