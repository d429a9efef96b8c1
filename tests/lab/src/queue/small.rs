//! `just lab small`: measures the cost of real tasks that take next to no time. A coordinator and
//! its workers, as `picofarm up` starts them, render scenes of one pixel into a folder.

use std::{
    io::{BufRead, BufReader},
    path::Path,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use picofarm_cli::{
    client::Client,
    error::{CliError, Code, Result},
    output::{Output, table},
    signals::interrupted,
};
use picofarm_proto::{messages::JobState, spec::JobSpec};
use picofarm_tasks::renderer_version;
use serde::Serialize;
use tokio_util::sync::CancellationToken;

use super::server::usage;
use crate::args::Small;

/// Results of the benchmark.
#[derive(Debug, Serialize)]
struct Report {
    workers: usize,
    tasks: u64,
    seconds: f64,
    renders_per_second: f64,
    /// CPU time of all workers for a task.
    workers_cpu_ms: f64,
    /// CPU time of the coordinator for a task.
    coordinator_cpu_ms: f64,
}

/// The process of `up`, ended on drop.
struct Up(Child);

impl Drop for Up {
    fn drop(&mut self) {
        // Its workers end with it.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Runs the benchmark.
///
/// # Errors
/// Fails if the coordinator does not start, or if a task fails.
pub async fn run(args: Small, output: Output, stop: &CancellationToken) -> Result<()> {
    let failed =
        |what: &str, e: std::io::Error| CliError::new(Code::Resource, format!("{what}: {e}"));
    let scratch = match &args.dir {
        Some(dir) => tempfile::tempdir_in(dir),
        None => tempfile::tempdir(),
    };
    let scratch = scratch.map_err(|e| failed("a scratch folder", e))?;
    let program = std::env::current_exe().map_err(|e| failed("the program", e))?;
    let (workers, dir) = (args.workers.to_string(), scratch.path().join("farm"));
    let up = Command::new(program)
        .args(["up", "--json", "--no-web", "--log", "warn"])
        .args(["--listen", "127.0.0.1:0", "--workers", &workers, "--dir"])
        .arg(&dir)
        .stdout(Stdio::piped())
        .spawn();
    let mut up = Up(up.map_err(|e| failed("starting a farm", e))?);
    let out = up.0.stdout.take().expect("stdout is piped");
    let mut line = String::new();
    let read = BufReader::new(out).read_line(&mut line);
    read.map_err(|e| failed("starting a farm", e))?;
    let said: serde_json::Value = serde_json::from_str(&line).unwrap_or_default();
    let url = said["coordinator"].as_str().ok_or_else(|| {
        CliError::new(
            Code::Resource,
            "the farm did not start; its own words stand above",
        )
    })?;
    let mut client = Client::connect(url, &picofarm_tasks::Access::default()).await?;
    let processes = children(up.0.id())?;
    // A first job creates what a data set needs once, and shows how long a task takes.
    ran(
        &mut client,
        job(&dir, "first", args.workers as u64 * 8),
        stop,
    )
    .await?;
    let coordinator = usage(up.0.id())?.cpu_s;
    let before = cpu(&processes)?;
    let start = Instant::now();
    ran(&mut client, job(&dir, "small", args.tasks), stop).await?;
    let seconds = start.elapsed().as_secs_f64();
    let each = |cpu_s: f64| cpu_s / args.tasks as f64 * 1e3;
    let report = Report {
        workers: args.workers,
        tasks: args.tasks,
        seconds,
        renders_per_second: args.tasks as f64 / seconds,
        workers_cpu_ms: each(cpu(&processes)? - before),
        coordinator_cpu_ms: each(usage(up.0.id())?.cpu_s - coordinator),
    };
    output.result(&report, || describe(&report));
    Ok(())
}

/// Submits a job and waits for its end.
async fn ran(client: &mut Client, spec: JobSpec, stop: &CancellationToken) -> Result<()> {
    let job = client.submit(spec, false).await?.job;
    loop {
        match client.status(job).await?.state {
            JobState::Done => return Ok(()),
            JobState::Active => {}
            state => {
                let what = format!("the bench's job ended {state:?}");
                return Err(CliError::new(Code::Failed, what));
            }
        }
        tokio::select! {
            () = tokio::time::sleep(Duration::from_millis(100)) => {}
            () = stop.cancelled() => return Err(interrupted("nothing is kept of a bench")),
        }
    }
}

/// Returns a job of renders of one pixel in primitive rooms with one spot.
fn job(dir: &Path, name: &str, tasks: u64) -> JobSpec {
    let spec = serde_json::json!({
        "name": name,
        "scenes": {"kind": "primitive", "count": tasks, "spots": 1},
        "render": {
            "renderer": renderer_version(), "resolution": 1, "samples": 2,
            "bins": 64, "bin_width_m": 0.25,
        },
        "output": {"store": dir.join("store"), "dataset": name},
    });
    serde_json::from_value(spec).expect("a job of all fields that have no default")
}

/// Returns the child processes of a process.
fn children(id: u32) -> Result<Vec<u32>> {
    let failed = |e: std::io::Error| {
        let what = format!("/proc/{id}/task: {e}; this bench needs Linux");
        CliError::new(Code::Resource, what)
    };
    let mut found = Vec::new();
    for thread in std::fs::read_dir(format!("/proc/{id}/task")).map_err(failed)? {
        let children = thread.map_err(failed)?.path().join("children");
        let text = std::fs::read_to_string(children).map_err(failed)?;
        found.extend(
            text.split_whitespace()
                .filter_map(|id| id.parse::<u32>().ok()),
        );
    }
    Ok(found)
}

/// Returns the CPU seconds of processes so far.
fn cpu(processes: &[u32]) -> Result<f64> {
    processes.iter().map(|id| Ok(usage(*id)?.cpu_s)).sum()
}

fn describe(report: &Report) -> String {
    let row = |name: &str, value: String| vec![name.to_owned(), value];
    table(&[
        row(
            "renders of one pixel",
            format!("{} with {} workers", report.tasks, report.workers),
        ),
        row("renders/s", format!("{:.0}", report.renders_per_second)),
        row(
            "workers' CPU, a task",
            format!("{:.2} ms", report.workers_cpu_ms),
        ),
        row(
            "coordinator's CPU, a task",
            format!("{:.3} ms", report.coordinator_cpu_ms),
        ),
    ])
}
