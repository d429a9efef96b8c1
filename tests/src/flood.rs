//! A client that sends far more than a coordinator has memory for.

use std::time::Duration;

use picofarm_proto::wire::{self, jobs_client::JobsClient};

/// Number of connections of a flood.
const CONNECTIONS: usize = 4;
/// Number of concurrent requests per connection.
const REQUESTS: usize = 8;
/// Size of each request's spec, in bytes. Its small values take several times as much memory after
/// parsing.
const BYTES: usize = 8 << 20;
/// Maximum duration of a flood, whatever has been answered by then.
const ENOUGH: Duration = Duration::from_secs(4);

/// Sends specs of many small values over several connections at once. The coordinator may refuse
/// them or close the connections.
///
/// # Panics
/// If no runtime can be created.
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
                    // An answer and a refusal are equally acceptable.
                    let _ = client.plan_job(request).await;
                }));
            }
        }
        let all = futures::future::join_all(under_way);
        // Pending requests are dropped with the runtime.
        let _ = tokio::time::timeout(ENOUGH, all).await;
    });
    runtime.shutdown_background();
}
