//! The memory that callers can make a coordinator use.

use std::time::Duration;

use picofarm_coordinator::MemoryBounds;
use picofarm_proto::wire::{self, jobs_client::JobsClient};
use tokio::task::JoinSet;
use tonic::{Code, Status, transport::Channel};

use crate::connections::{PATIENCE, Server, start, works};

const MIB: u64 = 1 << 20;

/// Returns a text of many short strings. It is no spec, but the charge comes before that check.
fn dense(strings: usize) -> wire::PlanJobRequest {
    let json = format!("[{}\"a\"]", "\"a\",".repeat(strings));
    wire::PlanJobRequest {
        spec: Some(wire::JobSpec { json }),
    }
}

async fn connect(server: &Server) -> Channel {
    let url = format!("http://{}", server.running.address);
    Channel::from_shared(url).unwrap().connect().await.unwrap()
}

async fn plan(channel: Channel, request: wire::PlanJobRequest) -> Status {
    let mut jobs = JobsClient::new(channel).max_encoding_message_size(64 << 20);
    jobs.plan_job(request).await.unwrap_err()
}

async fn metric(server: &Server, name: &str) -> u64 {
    let page = server.page("/metrics").await;
    let mut lines = page.lines();
    let value = lines.find_map(|line| line.strip_prefix(&format!("picofarm_{name} ")));
    value.expect("it is told").parse().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn large_specs_of_many_connections_are_admitted_by_what_they_cost() {
    let folder = tempfile::tempdir().unwrap();
    let bounds = MemoryBounds { process: 128 * MIB };
    let server = start(folder.path(), |config| config.memory = bounds).await;
    let mut calls = JoinSet::new();
    for _ in 0..4 {
        let channel = connect(&server).await;
        for _ in 0..6 {
            // 2 MiB on the wire, 32 in memory.
            calls.spawn(plan(channel.clone(), dense(1 << 19)));
        }
    }
    while let Some(refused) = calls.join_next().await {
        let refused = refused.unwrap();
        let code = refused.code();
        let known = [Code::InvalidArgument, Code::ResourceExhausted].contains(&code);
        assert!(known, "{refused:?}");
    }
    let most = metric(&server, "request_memory_most_bytes").await;
    assert!((32 * MIB..=96 * MIB).contains(&most), "{most}");
    // A request that could never be read is refused at once with a remedy.
    let refused = plan(connect(&server).await, dense(3 << 20)).await;
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused:?}");
    assert!(refused.message().contains("--memory-mib"), "{refused:?}");
    let given_back = async {
        while metric(&server, "request_memory_bytes").await > 0 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(PATIENCE, given_back)
        .await
        .expect("what is answered is given back");
    works(connect(&server).await).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lists_that_are_read_at_once_wait_for_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let bounds = MemoryBounds { process: 128 * MIB };
    let server = start(folder.path(), |config| config.memory = bounds).await;
    let channel = connect(&server).await;
    let mut calls = JoinSet::new();
    for _ in 0..60 {
        let mut jobs = JobsClient::new(channel.clone());
        calls.spawn(async move { jobs.list_events(wire::ListEventsRequest::default()).await });
    }
    while let Some(answer) = calls.join_next().await {
        answer.unwrap().unwrap();
    }
    let most = metric(&server, "request_memory_most_bytes").await;
    assert!((8 * MIB..=36 * MIB).contains(&most), "{most}");
}
