//! A caller that sends far more than a coordinator has memory for.

use std::time::Duration;

use picofarm_proto::wire::{self, jobs_client::JobsClient};

/// Connections of one flood.
const CONNECTIONS: usize = 4;
/// Requests under way on each.
const REQUESTS: usize = 8;
/// Size of each request's spec, bytes. Its small values take several times as much memory once they are read.
const BYTES: usize = 8 << 20;
/// A flood ends after this time, whatever has been answered by then.
const ENOUGH: Duration = Duration::from_secs(4);

/// Sends specs of many small values over several connections at once. Whether the coordinator refuses them or closes the connections
/// is its affair.
///
/// # Panics
/// When no runtime can be had.
pub fn specs(url: &str) {
    let spec = format!("{{\"name\":[{}0]}}", "0,".repeat(BYTES / 2));
    let runtime = tokio::runtime::Runtime::new().expect("threads can be had");
    runtime.block_on(async {
        let mut under_way = Vec::new();
        for _ in 0..CONNECTIONS {
            let Ok(client) = JobsClient::connect(url.to_owned()).await else {
                continue;
            };
            for _ in 0..REQUESTS {
                let request = wire::PlanJobRequest {
                    spec: Some(wire::JobSpec { json: spec.clone() }),
                };
                let mut client = client.clone();
                under_way.push(tokio::spawn(async move {
                    // An answer is as good as a refusal.
                    let _ = client.plan_job(request).await;
                }));
            }
        }
        let all = futures::future::join_all(under_way);
        // Those that are not answered by then are dropped with the runtime.
        let _ = tokio::time::timeout(ENOUGH, all).await;
    });
    runtime.shutdown_background();
}
