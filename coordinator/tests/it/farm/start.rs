//! Starts, stops and restarts a coordinator.

use picofarm_coordinator::{CoordinatorConfig, CoordinatorError, serve};
use picofarm_database::CatalogPlace;
use picofarm_proto::messages::JobState;
use tokio_util::sync::CancellationToken;
use tonic::Code;

use crate::farm::harness::{Farm, LEASE_MS, catalog_of, hello, spec};

#[tokio::test]
async fn a_restarted_coordinator_goes_on_where_it_was() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(6)).await.job_id;
    let mut worker = farm.worker().await;
    let first = worker.lease().await;
    assert!(worker.done(&first, first.lo).await.accepted);
    let held = worker.lease().await;
    // The coordinator is down for longer than a lease, and no worker is at fault.
    farm.stop().await;
    farm.pass(10 * i64::from(LEASE_MS));
    farm.restart().await;
    let status = farm.status(&job).await;
    assert_eq!(
        (status.tasks.done, status.tasks.leased),
        (1, held.hi - held.lo)
    );
    let mut again = worker.hello.clone();
    again.held = vec![held.lease];
    let mut worker = farm.connect(again).await.unwrap();
    for index in held.lo..held.hi {
        assert!(worker.done(&held, index).await.accepted);
    }
    let status = worker.work(&mut farm, &job).await;
    assert_eq!((status.state, status.tasks.done), (JobState::Done, 6));
    farm.restart().await;
    assert_eq!(farm.status(&job).await.tasks, status.tasks);
}

#[tokio::test]
async fn a_worker_of_another_version_is_refused() {
    let farm = Farm::start().await;
    let mut other = hello("new");
    other.version = "7.0.0".into();
    let error = farm.connect(other).await.err().unwrap();
    assert_eq!(error.code(), Code::FailedPrecondition);
    assert!(error.message().contains("worker is newer"), "{error}");
    let mut other = hello("strange");
    other.protocol += 1;
    let error = farm.connect(other).await.err().unwrap();
    assert_eq!(error.code(), Code::FailedPrecondition);
}

#[tokio::test]
async fn a_port_in_use_is_said_plainly() {
    let farm = Farm::start().await;
    let folder = tempfile::tempdir().unwrap();
    let config = CoordinatorConfig::new(
        CatalogPlace::from(folder.path().join("c.db")),
        farm.address(),
    );
    let error = serve(config, CancellationToken::new()).await.unwrap_err();
    assert!(matches!(error, CoordinatorError::AddressInUse { .. }));
    assert!(error.to_string().contains("port"), "{error}");
}

#[tokio::test]
async fn a_second_coordinator_on_a_catalog_is_refused() {
    let farm = Farm::start().await;
    let config = CoordinatorConfig::new(catalog_of(&farm), "127.0.0.1:0".parse().unwrap());
    let error = serve(config, CancellationToken::new()).await.unwrap_err();
    let text = error.to_string();
    assert!(text.contains("held by another coordinator"), "{text}");
    assert!(text.contains(&farm.address().to_string()), "{text}");
}
