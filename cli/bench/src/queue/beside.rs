//! Measures heartbeats while large jobs are planned, because submissions of other users must not
//! endanger leases.

use std::time::{Duration, Instant};

use picofarm_proto::model::JobSpec;
use serde::Serialize;
use tokio::task::JoinSet;

use super::{Bench, Running, server::Server, stats::Latency, worker};
use picofarm_cli::{
    client::Client,
    error::{CliError, Code, Result},
    output::table,
};

/// Duration of a lease, in seconds. Workers send six heartbeats in it.
const LEASE_S: f64 = 6.0;
/// Duration of the measurement of heartbeats without other load.
const ALONE: Duration = Duration::from_secs(5);

/// Results of the measurement.
#[derive(Debug, Serialize)]
pub struct Beside {
    workers: usize,
    plans: usize,
    plan_bytes: usize,
    /// Seconds until the last plan was answered.
    plans_s: f64,
    alone: Latency,
    beside: Latency,
    reconnects: u64,
}

impl Bench<'_> {
    pub(super) async fn beside(&self) -> Result<Beside> {
        let server = Server::start(&self.place, LEASE_S).await?;
        let (plans, workers) = (self.args.plans, self.args.workers);
        let fleet = Running::start(&server, workers, Duration::ZERO);
        fleet.connected(workers as u64, self.stop).await?;
        let specs: Vec<JobSpec> = (0..plans).map(|i| large(i, self.args.plan_mb)).collect();
        let plan_bytes = serde_json::to_string(&specs[0]).map_or(0, |text| text.len());
        let mut clients = Vec::with_capacity(plans);
        for _ in 0..plans {
            clients.push(server.client().await?);
        }
        fleet.stats.heartbeats_since();
        tokio::time::sleep(ALONE).await;
        let alone = fleet.stats.heartbeats_since();
        let begun = Instant::now();
        let mut asked = JoinSet::new();
        for (mut client, spec) in clients.into_iter().zip(specs) {
            asked.spawn(async move { Client::plan(&mut client, spec).await });
        }
        while let Some(answer) = asked.join_next().await {
            answer.map_err(|e| CliError::new(Code::Failed, format!("a plan broke: {e}")))??;
        }
        let plans_s = begun.elapsed().as_secs_f64();
        let beside = fleet.stats.heartbeats_since();
        let stats = fleet.stop().await?;
        self.output.say(format!(
            "beside {plans} plans, heartbeats took at most {:.1} ms",
            beside.most_ms
        ));
        Ok(Beside {
            workers,
            plans,
            plan_bytes,
            plans_s,
            alone,
            beside,
            reconnects: stats.reconnects(),
        })
    }
}

impl Beside {
    pub(super) fn describe(&self) -> String {
        let row = |what: &str, l: &Latency| {
            let times = [l.p50_ms, l.p99_ms, l.most_ms];
            let mut cells = vec![what.to_owned()];
            cells.extend(times.map(|ms| format!("{ms:.1}")));
            cells
        };
        let megabytes = self.plan_bytes as f64 / 1e6;
        let beside = format!(
            "beside {} plans of {megabytes:.0} MB, {:.1} s",
            self.plans, self.plans_s
        );
        table(&[
            ["heartbeats", "p50 ms", "p99 ms", "most ms"]
                .map(String::from)
                .to_vec(),
            row("alone", &self.alone),
            row(&beside, &self.beside),
        ])
    }
}

/// Returns a job with enough files that its spec has this size.
fn large(number: usize, megabytes: u64) -> JobSpec {
    // Size of one file as JSON.
    const EACH: u64 = 160;
    let file = |i: u64| {
        serde_json::json!({
            "path": format!("/nowhere/{number}/{i:060}.glb"),
            "sha256": format!("{i:064x}"),
        })
    };
    let files: Vec<_> = (0..megabytes * 1_000_000 / EACH).map(file).collect();
    let dataset = format!("bench-{}", uuid::Uuid::new_v4().simple());
    let spec = serde_json::json!({
        "name": format!("large {number}"),
        "scenes": {"kind": "files", "files": files},
        "render": {"renderer": worker::RENDERER},
        "output": {"store": "/nowhere", "dataset": dataset},
    });
    serde_json::from_value(spec).expect("a job of all fields that have no default")
}
