//! Logs of tasks: recorded for the holder of the live lease, within the task's allowance.

use picofarm_proto::{
    messages::{Lease, log},
    wire::{self, session_request::Message as Say},
};

use crate::farm::harness::{Farm, LEASE_MS, Worker, hello, spec};

impl Worker {
    /// Sends lines of a task, and waits until they have been handled.
    async fn log(&mut self, lease: &Lease, index: u64, texts: &[&str]) {
        let line = |text: &&str| wire::LogLine {
            ago_ms: 500,
            level: wire::LogLevel::Warn.into(),
            text: (*text).into(),
        };
        self.say(Say::Log(wire::TaskLog {
            lease: Some(lease.lease.into()),
            index,
            lines: texts.iter().map(line).collect(),
        }))
        .await;
        // The answer to a heartbeat without leases comes from the actor.
        self.beat(&[], None).await;
    }
}

/// Returns time, worker and text of each line.
async fn lines(farm: &mut Farm, job: &str, task: Option<u64>) -> Vec<(i64, String, String)> {
    let events = farm.events(job, task).await;
    let logs = events
        .into_iter()
        .filter(|e| e.kind() == wire::EventKind::Log);
    logs.map(|e| (e.at_ms, e.worker, e.message)).collect()
}

#[tokio::test]
async fn lines_are_kept_for_the_holder_of_the_live_lease_and_for_nobody_else() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut owner = farm.worker().await;
    let lease = owner.lease().await;
    owner.log(&lease, 0, &["the store\u{1b}[2J\nis full"]).await;
    let said = vec![(
        1_000_000 - 500,
        "ada".to_owned(),
        "warn: the store [2J is full".to_owned(),
    )];
    assert_eq!(lines(&mut farm, &job, Some(0)).await, said);

    let mut thief = farm.connect(hello("eve")).await.unwrap();
    thief.log(&lease, 0, &["not mine"]).await;
    owner.log(&lease, 7, &["no such task"]).await;
    let mut former = lease.clone();
    former.lease.epoch.0 -= 1;
    owner.log(&former, 0, &["an earlier epoch"]).await;
    assert!(owner.done(&lease, 0).await.accepted);
    owner.log(&lease, 0, &["done already"]).await;
    assert_eq!(lines(&mut farm, &job, None).await, said);
}

#[tokio::test]
async fn lines_after_expiry_are_dropped() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut slow = farm.worker().await;
    let lease = slow.lease().await;
    farm.pass(i64::from(LEASE_MS) + 1);
    slow.revoked().await;
    slow.log(&lease, 0, &["late"]).await;
    assert!(lines(&mut farm, &job, None).await.is_empty());
}

#[tokio::test]
async fn a_task_fills_the_history_no_further_than_its_allowance_whatever_its_worker_sends() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    for _ in 0..3 {
        worker.log(&lease, 0, &["x"; log::LINES]).await;
    }
    assert_eq!(lines(&mut farm, &job, None).await.len(), log::LINES);
    // Another attempt has the same allowance again.
    worker.fail(&lease, 0, wire::FailureKind::User).await;
    farm.pass(10_000);
    let lease = worker.lease().await;
    let long = "x".repeat(log::LINE_BYTES);
    for _ in 0..3 {
        worker.log(&lease, 0, &[&*long; 10]).await;
    }
    let kept = log::LINES + log::BYTES / log::LINE_BYTES;
    assert_eq!(lines(&mut farm, &job, None).await.len(), kept);
}
