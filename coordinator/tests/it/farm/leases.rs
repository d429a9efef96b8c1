//! Fencing: a worker that lost a lease changes nothing, and a worker that still has one loses
//! nothing.

use picofarm_database::{CatalogPlace, testing::hold_writes};
use picofarm_proto::{
    ids::Incarnation,
    messages::JobState,
    wire::{self, session_response::Message as Heard},
};
use uuid::Uuid;

use crate::farm::harness::{Farm, LEASE_MS, catalog_of, hello, manifest, spec};

#[tokio::test]
async fn a_report_after_expiry_is_refused() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut slow = farm.worker().await;
    let lease = slow.lease().await;
    farm.pass(i64::from(LEASE_MS) + 1);
    assert_eq!(slow.revoked().await.lease, Some(lease.lease.into()));
    assert!(!slow.done(&lease, 0).await.accepted);
    farm.pass(10_000);
    let mut other = farm.connect(hello("bob")).await.unwrap();
    let second = other.lease().await;
    assert!(second.lease.epoch > lease.lease.epoch);
    assert!(!slow.done(&lease, 0).await.accepted);
    assert!(other.done(&second, 0).await.accepted);
    assert_eq!(farm.until_ended(&job).await.state, JobState::Done);
    // The job has ended: the output counts, and no further message is needed.
    let late = slow.done(&lease, 0).await;
    assert!(
        !late.accepted && late.reason.contains("ended"),
        "{}",
        late.reason
    );
}

#[tokio::test]
async fn a_heartbeat_keeps_a_lease() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    for _ in 0..3 {
        farm.pass(i64::from(LEASE_MS) - 1_000);
        assert_eq!(worker.beat(&[&lease], Some(0)).await.len(), 1);
        // The session answers before the actor has received the heartbeat. The actor answers calls
        // in order.
        farm.status(&job).await;
    }
    assert!(worker.done(&lease, 0).await.accepted);
    assert!(worker.beat(&[&lease], None).await.is_empty());
}

#[tokio::test]
async fn a_heartbeat_does_not_wait_for_the_catalog() {
    let mut farm = Farm::start().await;
    farm.submit(&spec(3)).await;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    let CatalogPlace::Sqlite(path) = catalog_of(&farm) else {
        panic!("this farm's catalog is a file");
    };
    let held = hold_writes(&path).await;
    // The actor now waits for this commit.
    worker.say_done(&lease, lease.lo, &manifest(lease.lo)).await;
    for _ in 0..5 {
        assert_eq!(worker.beat(&[&lease], None).await, [lease.lease.into()]);
    }
    drop(held);
    assert!(worker.acknowledged().await.accepted);
}

#[tokio::test]
async fn a_suspend_of_the_coordinator_ends_no_lease() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(2)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    // The coordinator sleeps for a night. The worker was awake or slept too.
    farm.suspend(500 * i64::from(LEASE_MS));
    assert_eq!(worker.beat(&[&lease], Some(lease.lo)).await.len(), 1);
    // The connection breaks, and the worker takes longer to reconnect than a worker with a dead
    // process may.
    farm.suspend(500 * i64::from(LEASE_MS));
    farm.until(&job, |status| status.tasks.leased > 0).await;
    let mut again = worker.hello.clone();
    again.held = vec![lease.lease];
    drop(worker);
    farm.until(&job, |status| status.workers == 0).await;
    farm.pass(i64::from(LEASE_MS) / 2);
    tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    let mut worker = farm.connect(again).await.unwrap();
    for index in lease.lo..lease.hi {
        assert!(worker.done(&lease, index).await.accepted);
    }
    let events = farm.events(&job, None).await;
    let expired = events.iter().any(|e| e.kind() == wire::EventKind::Expired);
    assert!(!expired, "{events:?}");
    // Extended leases last no longer than any lease.
    assert!(worker.beat(&[&lease], None).await.is_empty());
    if farm.status(&job).await.state == JobState::Active {
        let rest = worker.lease().await;
        farm.pass(i64::from(LEASE_MS) + 1);
        assert_eq!(worker.revoked().await.lease, Some(rest.lease.into()));
    }
}

#[tokio::test]
async fn another_worker_cannot_report_for_a_lease() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut owner = farm.worker().await;
    let lease = owner.lease().await;
    let mut thief = farm.connect(hello("eve")).await.unwrap();
    assert!(!thief.done(&lease, 0).await.accepted);
    assert_eq!(farm.status(&job).await.tasks.done, 0);
    assert!(owner.done(&lease, 0).await.accepted);
}

#[tokio::test]
async fn a_restarted_worker_is_not_its_predecessor() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut first = farm.worker().await;
    let lease = first.lease().await;
    let mut again = first.hello.clone();
    again.incarnation = Incarnation::from_uuid(Uuid::new_v4());
    again.held = vec![lease.lease];
    let mut second = farm.connect(again).await.unwrap();
    assert_eq!(second.revoked().await.lease, Some(lease.lease.into()));
    assert!(!second.done(&lease, 0).await.accepted);
    // The loss counts at once as a crash of the running task.
    let events = farm.events(&job, Some(0)).await;
    assert!(events.iter().any(|e| e.kind() == wire::EventKind::Failed));
    assert!(first.hear().await.is_err(), "the older session has ended");
}

#[tokio::test]
async fn a_reconnecting_worker_keeps_its_lease() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(2)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    let mut again = worker.hello.clone();
    drop(worker);
    again.held = vec![lease.lease];
    let mut worker = farm.connect(again).await.unwrap();
    assert!(worker.done(&lease, lease.lo).await.accepted);
    assert_eq!(farm.status(&job).await.tasks.done, 1);
}

#[tokio::test]
async fn a_grant_that_never_arrived_is_free() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut worker = farm.worker().await;
    worker.lease().await;
    let again = worker.hello.clone();
    drop(worker);
    let mut worker = farm.connect(again).await.unwrap();
    let lease = worker.lease().await;
    assert!(worker.done(&lease, 0).await.accepted);
    let events = farm.events(&job, None).await;
    assert!(!events.iter().any(|e| e.kind() == wire::EventKind::Failed));
}

#[tokio::test]
async fn a_repeated_report_is_accepted_and_counted_once() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(2)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    for _ in 0..3 {
        assert!(worker.done(&lease, lease.lo).await.accepted);
    }
    assert_eq!(farm.status(&job).await.tasks.done, 1);
    let events = farm.events(&job, None).await;
    let committed = |e: &&wire::Event| e.kind() == wire::EventKind::Committed;
    assert_eq!(events.iter().filter(committed).count(), 1);
}

#[tokio::test]
async fn two_different_results_of_a_task_are_an_alarm() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(2)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    assert!(worker.done(&lease, lease.lo).await.accepted);
    // The store cannot decide which result is right.
    farm.stored.close("it is on another machine");
    let answer = worker.report(&lease, lease.lo, &manifest(99)).await;
    assert!(!answer.accepted);
    assert!(answer.reason.contains("different"), "{}", answer.reason);
    let events = farm.events(&job, Some(lease.lo)).await;
    assert!(events.iter().any(|e| e.kind() == wire::EventKind::Alarm));
}

#[tokio::test]
async fn a_released_lease_goes_to_another_worker_for_free() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut leaving = farm.worker().await;
    let lease = leaving.lease().await;
    assert!(leaving.release(&lease).await.accepted);
    let mut other = farm.connect(hello("bob")).await.unwrap();
    let lease = other.lease().await;
    assert!(other.done(&lease, 0).await.accepted);
    assert_eq!(farm.status(&job).await.tasks.dead, 0);
}

#[tokio::test]
async fn a_poison_task_is_cornered_and_everything_else_is_done() {
    const POISON: u64 = 5;
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(40)).await.job_id;
    let mut kills = 0;
    let status = loop {
        let status = farm.status(&job).await;
        if status.state != JobState::Active {
            break status;
        }
        // Each process dies of the poison task, and the next is another incarnation of the same
        // worker.
        let mut worker = farm.worker().await;
        'process: loop {
            let status = farm.status(&job).await;
            if status.tasks.pending == 0 {
                break;
            }
            let lease = worker.lease().await;
            for index in lease.lo..lease.hi {
                if index == POISON {
                    kills += 1;
                    break 'process;
                }
                assert!(worker.done(&lease, index).await.accepted);
            }
            farm.pass(10_000);
        }
        drop(worker);
        farm.pass(i64::from(LEASE_MS) + 1);
        farm.until(&job, |s| s.tasks.leased == 0).await;
        farm.pass(10_000);
    };
    assert_eq!(status.state, JobState::Failed);
    assert_eq!((status.tasks.done, status.tasks.dead), (39, 1));
    assert_eq!(kills, 3);
    let retried = farm
        .jobs
        .retry_job(wire::RetryJobRequest {
            job_id: job.clone(),
        })
        .await
        .unwrap();
    assert_eq!(retried.into_inner().retried, 1);
    let mut worker = farm.worker().await;
    assert_eq!(worker.work(&mut farm, &job).await.state, JobState::Done);
}

#[tokio::test]
async fn a_lost_worker_is_charged_to_the_task_it_had_in_hand() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(20)).await.job_id;
    let mut worker = farm.worker().await;
    let first = worker.lease().await;
    assert!(worker.done(&first, first.lo).await.accepted);
    let lease = worker.lease().await;
    let in_hand = lease.hi - 1;
    assert!(in_hand > lease.lo);
    worker.beat(&[&lease], Some(in_hand)).await;
    worker.beat(&[], None).await;
    let running = farm.status(&job).await.running;
    assert_eq!((running.len(), running[0].index), (1, in_hand));
    drop(worker);
    farm.pass(i64::from(LEASE_MS) + 1);
    farm.until(&job, |s| s.tasks.leased == 0).await;
    let failed: Vec<_> = farm
        .events(&job, None)
        .await
        .iter()
        .filter(|e| e.kind() == wire::EventKind::Failed)
        .map(|e| e.task)
        .collect();
    assert_eq!(failed, [Some(in_hand)]);
}

#[tokio::test]
async fn a_worker_gets_at_most_as_many_leases_as_credits() {
    let mut farm = Farm::start().await;
    farm.submit(&spec(10)).await;
    let mut worker = farm.worker().await;
    worker.credit(2).await;
    for _ in 0..2 {
        assert!(matches!(worker.hear().await.unwrap(), Heard::Lease(_)));
    }
    assert!(worker.beat(&[], None).await.is_empty());
}
