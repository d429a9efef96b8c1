//! `picofarm bench dataset`: the cost of operations on very many scenes: listing, verifying,
//! snapshots, collection.

mod simulate;

use std::{
    path::Path,
    time::{Duration, Instant},
};

use picofarm_dataset::{Dataset, VerifyOptions};
use picofarm_store::{VerifyMode, open_store};
use serde::Serialize;
use serde_json::json;
use tokio_util::sync::CancellationToken;

use self::simulate::{Simulated, empty};
use super::measure::cpu_time;
use picofarm_cli::{
    args::BenchDataset,
    dataset::failed,
    error::{CliError, Code, Result, io},
    output::{Meter, Output, bytes, duration, table},
    signals,
};

/// One measurement.
#[derive(Serialize)]
struct Row {
    scenes: u64,
    what: &'static str,
    seconds: f64,
    /// CPU time of this process, including the system's on its behalf. Other programs do not affect
    /// it.
    cpu_seconds: f64,
    cpu_us_per_scene: f64,
    /// Maximum resident memory of this process meanwhile; `None` if the system does not report it.
    peak_bytes: Option<u64>,
    /// Result of the operation.
    result: String,
}

pub async fn run(args: BenchDataset, output: Output, stop: &CancellationToken) -> Result<()> {
    let mut sizes = args.scenes.clone();
    sizes.sort_unstable();
    sizes.dedup();
    if sizes.first().is_none_or(|n| *n < 2) {
        return Err(CliError::input("--scenes: expected numbers of at least 2")
            .hint("for example --scenes 1000,10000"));
    }
    empty(&args.dir)?;
    let measured = measure(&args.dir, &sizes, output, stop).await;
    if !args.keep {
        output.say("removing the simulated data set");
        std::fs::remove_dir_all(&args.dir).map_err(|e| io(args.dir.display(), &e))?;
    }
    let rows = measured?;
    let facts = json!({"dir": args.dir, "kept": args.keep, "rows": rows});
    output.result(&facts, || text(&rows));
    Ok(())
}

async fn measure(
    dir: &Path,
    sizes: &[u64],
    output: Output,
    stop: &CancellationToken,
) -> Result<Vec<Row>> {
    let room = sizes.last().copied().unwrap_or_default();
    let mut simulated = Simulated::start(&dir.join("set"), room).await?;
    let mut rows = Vec::new();
    for size in sizes {
        simulated = grow(simulated, *size, output, stop).await?;
        rows.extend(look(&simulated, output).await?);
    }
    Ok(rows)
}

async fn grow(
    mut simulated: Simulated,
    size: u64,
    output: Output,
    stop: &CancellationToken,
) -> Result<Simulated> {
    let stop = stop.clone();
    tokio::task::spawn_blocking(move || {
        let mut meter = Meter::new(output);
        while simulated.scenes < size {
            if stop.is_cancelled() {
                meter.finish();
                return Err(signals::interrupted("nothing was kept"));
            }
            simulated.add()?;
            if simulated.scenes.is_multiple_of(500) {
                let text = format!("{} of {size} scenes made", simulated.scenes);
                meter.at(simulated.scenes as f64 / size as f64, text);
            }
        }
        meter.finish();
        Ok(simulated)
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("the benchmark broke: {e}")))?
}

/// Measures all operations on the data set in its current state.
async fn look(simulated: &Simulated, output: Output) -> Result<Vec<Row>> {
    let scenes = simulated.scenes;
    let mut rows = Vec::new();
    let (store, prefix) = open_store(&simulated.folder.display().to_string()).map_err(failed)?;
    let dataset = Dataset::open(store, prefix).await.map_err(failed)?;
    let mut note = |what, watch: Watch, result: String| {
        let (seconds, cpu_seconds, peak_bytes) = watch.stop();
        output.say(format!("{scenes} scenes: {what} in {}", duration(seconds)));
        let cpu_us_per_scene = cpu_seconds * 1e6 / scenes as f64;
        rows.push(Row {
            scenes,
            what,
            seconds,
            cpu_seconds,
            cpu_us_per_scene,
            peak_bytes,
            result,
        });
    };

    let watch = Watch::start();
    let found = dataset.scenes_present().await.map_err(failed)?;
    note("list", watch, format!("{} scenes", found.len()));

    let watch = Watch::start();
    let info = dataset.info().await.map_err(failed)?;
    note(
        "info",
        watch,
        format!("{} scenes, {}", info.scenes, bytes(info.bytes)),
    );

    let watch = Watch::start();
    let report = dataset.verify(VerifyMode::Fast).await.map_err(failed)?;
    sound(&report.problems)?;
    note(
        "verify --fast",
        watch,
        format!("{} objects, whole", report.objects),
    );

    let watch = Watch::start();
    let snapshot = dataset.present(&|_, _| {}).await.map_err(failed)?;
    let snapshot = snapshot.named(format!("at-{scenes}"), "");
    let size = dataset.create_snapshot(&snapshot).await.map_err(failed)?;
    let size = size.unwrap_or_default();
    note(
        "snapshot create",
        watch,
        format!("{} bytes, {:.1} a scene", size, size as f64 / scenes as f64),
    );

    let watch = Watch::start();
    let snapshot = dataset.snapshot(&snapshot.name).await.map_err(failed)?;
    let options = VerifyOptions {
        snapshot: Some(&snapshot),
        ..VerifyOptions::new(VerifyMode::Fast)
    };
    let report = dataset.verify_with(&options).await.map_err(failed)?;
    sound(&report.problems)?;
    note(
        "snapshot verify --fast",
        watch,
        format!("{} scenes, whole", report.scenes),
    );
    // The snapshot names the scene that will be orphaned.
    let place = dataset.snapshot_place(&snapshot.name);
    std::fs::remove_file(&place).map_err(|e| io(&place, &e))?;

    let away = simulated.orphan()?;
    let watch = Watch::start();
    let found = picofarm_results::collect_garbage(&dataset, Duration::ZERO, false).await;
    let (found, kept) = (found.map_err(failed)?, simulated.adopt(&away));
    note(
        "gc --dry-run",
        watch,
        format!("{} objects of one unfinished scene", found.orphans.len()),
    );
    kept?;
    Ok(rows)
}

fn sound(problems: &[picofarm_store::Problem]) -> Result<()> {
    match problems.first() {
        None => Ok(()),
        Some(problem) => Err(CliError::new(
            Code::Failed,
            format!("the simulated data set is broken: {problem}"),
        )),
    }
}

fn text(rows: &[Row]) -> String {
    let head = [
        "scenes",
        "what",
        "time",
        "CPU",
        "CPU us a scene",
        "peak memory",
        "result",
    ];
    let mut all = vec![head.map(str::to_owned).to_vec()];
    all.extend(rows.iter().map(|row| {
        vec![
            row.scenes.to_string(),
            row.what.to_owned(),
            duration(row.seconds),
            duration(row.cpu_seconds),
            format!("{:.0}", row.cpu_us_per_scene),
            row.peak_bytes.map_or("unknown".into(), bytes),
            row.result.clone(),
        ]
    }));
    table(&all)
}

/// Time, CPU time, and the maximum resident memory since the start.
struct Watch(Instant, Duration);

impl Watch {
    fn start() -> Self {
        // Resets the kernel's peak. If the file does not exist, no peak is reported either.
        let _ = std::fs::write("/proc/self/clear_refs", "5");
        Self(Instant::now(), cpu_time())
    }

    fn stop(self) -> (f64, f64, Option<u64>) {
        let seconds = self.0.elapsed().as_secs_f64();
        let cpu = cpu_time().saturating_sub(self.1);
        let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
        let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
        let kib = line.and_then(|l| l.trim().trim_end_matches("kB").trim().parse::<u64>().ok());
        (seconds, cpu.as_secs_f64(), kib.map(|k| k * 1024))
    }
}
