//! What a data set of 97,432 scenes costs the coordinator: submission, plan, list and status over gRPC, the size of
//! the database, and commits per second through the catalog. Prints a table; asserts nothing.

use std::{path::Path, sync::Arc, time::Instant};

use picofarm_catalog::{Catalog, Changes, EventQuery, Job, NewEvent, Output, Run, SqliteCatalog};
use picofarm_coordinator::{CoordinatorConfig, serve};
use picofarm_proto::{
    ids::{Epoch, JobId},
    model::{EventKind, JobSpec, JobState},
    wire::{self, jobs_client::JobsClient},
};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

const SCENES: u64 = 97_432;

fn spec(count: u64) -> JobSpec {
    serde_json::from_str(&format!(
        r#"{{"name": "bench", "scenes": {{"kind": "primitive", "count": {count}}},
            "render": {{"renderer": "r"}}, "output": {{"store": "s", "dataset": "d"}}}}"#
    ))
    .expect("a fixed text")
}

fn size(path: &Path) -> u64 {
    ["", "-wal"]
        .iter()
        .filter_map(|suffix| {
            let mut name = path.as_os_str().to_owned();
            name.push(suffix);
            std::fs::metadata(name).ok()
        })
        .map(|m| m.len())
        .sum()
}

fn row(what: &str, figure: impl std::fmt::Display) {
    println!("{what:<58} {figure:>16}");
}

fn ms(start: Instant) -> String {
    format!("{:.1} ms", start.elapsed().as_secs_f64() * 1e3)
}

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("catalog.db");
    over_grpc(&path).await?;
    through_catalog(&folder.path().join("commits.db")).await?;
    // The same questions of a job whose outputs exist.
    println!();
    over_grpc(&folder.path().join("commits.db")).await
}

async fn over_grpc(path: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let stop = CancellationToken::new();
    let start = Instant::now();
    let config = CoordinatorConfig::new(path.to_owned(), "127.0.0.1:0".parse()?);
    let running = serve(config, stop.clone()).await?;
    let mut jobs = JobsClient::connect(format!("http://{}", running.address)).await?;
    jobs.get_server_info(wire::GetServerInfoRequest {}).await?;
    row("start, connect", ms(start));
    let empty = size(path);
    let spec: wire::JobSpec = spec(SCENES).into();
    let start = Instant::now();
    let plan = wire::PlanJobRequest {
        spec: Some(spec.clone()),
    };
    let plan = jobs
        .plan_job(plan)
        .await?
        .into_inner()
        .plan
        .unwrap_or_default();
    row(
        &format!("plan {SCENES} tasks, {} exist", plan.reuse),
        ms(start),
    );
    let start = Instant::now();
    let submit = wire::SubmitJobRequest {
        spec: Some(spec),
        again: false,
    };
    let job = jobs.submit_job(submit).await?.into_inner();
    row("submit", ms(start));
    let start = Instant::now();
    jobs.list_jobs(wire::ListJobsRequest {}).await?;
    row("list", ms(start));
    let start = Instant::now();
    let get = wire::GetJobRequest { job_id: job.job_id };
    jobs.get_job(get).await?;
    row("status", ms(start));
    row(
        "database grew by (file and log)",
        format!("{:.1} KiB", (size(path) - empty) as f64 / 1024.0),
    );
    stop.cancel();
    running.wait().await?;
    row(
        "database after closing",
        format!("{:.1} KiB", size(path) as f64 / 1024.0),
    );
    Ok(())
}

/// 256 callers commit outputs at once, as a coordinator would whose every worker reports alone.
async fn through_catalog(path: &Path) -> Result<(), Box<dyn std::error::Error>> {
    const CALLERS: u64 = 256;
    let catalog = Arc::new(SqliteCatalog::open(path, "bench").await?);
    let spec = spec(SCENES + 1);
    let job = Job {
        id: JobId::from_uuid(Uuid::now_v7()),
        spec_hash: "bench".into(),
        spec: Arc::new(spec),
        state: JobState::Cancelled,
        submitted_ms: 0,
        ended_ms: Some(0),
    };
    let id = job.id;
    catalog
        .commit(Changes {
            jobs: vec![job],
            ..Changes::default()
        })
        .await?;
    let one = move |task: u64| Changes {
        outputs: vec![Output {
            job: id,
            task,
            manifest: [task as u8; 32],
            bytes: 20 << 20,
            seconds: 9.0,
            epoch: Epoch(1),
            adopted: false,
        }],
        events: vec![NewEvent {
            at_ms: 0,
            job: id,
            kind: EventKind::Committed,
            tasks: Some(Run {
                lo: task,
                hi: task + 1,
            }),
            worker: "worker-1".into(),
            seconds: 9.0,
            message: String::new(),
        }],
        ..Changes::default()
    };
    let start = Instant::now();
    for task in 0..64 {
        catalog.commit(one(task)).await?;
    }
    row(
        "commits/s, one caller",
        format!("{:.0}", 64.0 / start.elapsed().as_secs_f64()),
    );
    let start = Instant::now();
    let callers: Vec<_> = (0..CALLERS)
        .map(|caller| {
            let catalog = Arc::clone(&catalog);
            tokio::spawn(async move {
                let mut task = 64 + caller;
                while task < SCENES {
                    catalog.commit(one(task)).await?;
                    task += CALLERS;
                }
                Ok::<_, picofarm_catalog::CatalogError>(())
            })
        })
        .collect();
    for caller in callers {
        caller.await??;
    }
    row(
        &format!("commits/s, {CALLERS} callers (output + event each)"),
        format!(
            "{:.0}",
            (SCENES - 64) as f64 / start.elapsed().as_secs_f64()
        ),
    );
    let start = Instant::now();
    let query = EventQuery {
        job: id,
        after: 0,
        limit: 1_000,
        task: Some(SCENES - 1),
    };
    catalog.events(&query).await?;
    row("history of one task among all", ms(start));
    catalog.close().await;
    row(
        "database with all outputs and their history",
        format!("{:.1} MiB", size(path) as f64 / (1 << 20) as f64),
    );
    Ok(())
}
