//! Names and help texts are stable for dashboards, and the numbers match the events.

use picofarm_catalog::{NewEvent, Output};
use picofarm_proto::ids::{Epoch, JobId, LeaseRef, RangeId, StageRef};
use uuid::Uuid;

use super::*;
use crate::{auth::METHODS, memory::MemoryUse};

fn metrics() -> Metrics {
    Metrics::new(METHODS.iter().map(|(method, _)| *method))
}

#[test]
fn names_and_help_texts_are_as_documented() {
    let page = metrics().page(
        Some(Gauges::default()),
        ConnectionCounts::default(),
        MemoryUse::default(),
        true,
    );
    let lines: Vec<&str> = page.lines().filter(|line| line.starts_with('#')).collect();
    insta::assert_snapshot!(lines.join("\n"));
}

#[test]
fn every_line_is_a_sample_of_the_family_before_it() {
    let page = metrics().page(
        Some(Gauges::default()),
        ConnectionCounts::default(),
        MemoryUse::default(),
        false,
    );
    let mut family = String::new();
    for line in page.lines() {
        if let Some(rest) = line.strip_prefix("# TYPE ") {
            rest.split(' ').next().unwrap().clone_into(&mut family);
        } else if !line.starts_with('#') {
            let (name, value) = line.rsplit_once(' ').unwrap();
            let name = name.split('{').next().unwrap();
            let suffix = name
                .strip_prefix(&family)
                .unwrap_or_else(|| panic!("{line}: not of {family}"));
            assert!(
                ["", "_bucket", "_sum", "_count"].contains(&suffix),
                "{line}"
            );
            value.parse::<f64>().unwrap();
        }
    }
    assert!(page.contains("\npicofarm_ready 0\n"));
}

#[test]
fn without_the_catalog_the_counters_are_told_and_the_gauges_are_not() {
    let page = metrics().page(
        None,
        ConnectionCounts::default(),
        MemoryUse::default(),
        false,
    );
    assert!(!page.contains("picofarm_tasks_pending"));
    assert!(page.contains("picofarm_leases_granted_total 0"));
}

#[test]
fn a_histogram_counts_up_to_each_bound() {
    let metrics = metrics();
    for messages in [1, 2, 3, 5000] {
        metrics.handled(messages);
    }
    let page = metrics.page(
        None,
        ConnectionCounts::default(),
        MemoryUse::default(),
        true,
    );
    for line in [
        "picofarm_batch_messages_bucket{le=\"1\"} 1",
        "picofarm_batch_messages_bucket{le=\"2\"} 2",
        "picofarm_batch_messages_bucket{le=\"5\"} 3",
        "picofarm_batch_messages_bucket{le=\"1000\"} 3",
        "picofarm_batch_messages_bucket{le=\"+Inf\"} 4",
        "picofarm_batch_messages_sum 5006",
        "picofarm_batch_messages_count 4",
    ] {
        assert!(page.lines().any(|l| l == line), "{line} in {page}");
    }
}

#[test]
fn calls_are_counted_by_method_and_unknown_paths_share_a_line() {
    let metrics = metrics();
    metrics.called("/picofarm.v1.Jobs/GetJob", Duration::from_millis(3));
    for path in ["/", "/picofarm.v1.Jobs/Nonsense"] {
        metrics.called(path, Duration::from_millis(3));
    }
    let page = metrics.page(
        None,
        ConnectionCounts::default(),
        MemoryUse::default(),
        true,
    );
    for (method, count) in [("Jobs/GetJob", 1), ("other", 2), ("Farm/Session", 0)] {
        let line = format!("picofarm_grpc_request_seconds_count{{method=\"{method}\"}} {count}");
        assert!(page.contains(&line), "{line} in {page}");
    }
}

#[test]
fn what_fails_without_a_report_was_lost_with_its_worker() {
    let job = JobId::from_uuid(Uuid::from_u128(1));
    let event = |kind| NewEvent::new(job, 0, kind, String::new());
    let output = |adopted| Output {
        stage: StageRef { job, stage: 0 },
        task: 0,
        manifest: [0; 32],
        bytes: 1,
        seconds: 2.0,
        epoch: Epoch(1),
        adopted,
        checked: false,
    };
    let changes = Changes {
        events: [
            EventKind::Leased,
            EventKind::Failed,
            EventKind::Expired,
            EventKind::Dead,
            EventKind::Released,
        ]
        .map(event)
        .to_vec(),
        outputs: vec![output(false), output(true), output(false)],
        ..Changes::default()
    };
    let lease = LeaseRef {
        range: RangeId::from_uuid(Uuid::from_u128(2)),
        epoch: Epoch(1),
    };
    let acknowledge = |accepted| {
        let reason = String::new();
        (
            1,
            ToWorker::Acknowledge {
                lease,
                index: 0,
                accepted,
                reason,
            },
        )
    };
    let mut tally = Tally::default();
    tally.failed(FailureKind::User);
    tally.failed(FailureKind::Interrupted);
    tally.note(&changes, &[acknowledge(true), acknowledge(false)]);
    let metrics = metrics();
    metrics.add(&tally);
    let page = metrics.page(
        None,
        ConnectionCounts::default(),
        MemoryUse::default(),
        true,
    );
    for line in [
        "picofarm_leases_granted_total 1",
        "picofarm_leases_expired_total 1",
        "picofarm_tasks_committed_total{adopted=\"false\"} 2",
        "picofarm_tasks_committed_total{adopted=\"true\"} 1",
        "picofarm_task_failures_total{kind=\"user\"} 1",
        "picofarm_task_failures_total{kind=\"crash\"} 1",
        "picofarm_task_failures_total{kind=\"interrupted\"} 1",
        "picofarm_tasks_dead_total 1",
        "picofarm_reports_refused_total 1",
        "picofarm_task_seconds_sum 4",
    ] {
        assert!(page.lines().any(|l| l == line), "{line} in {page}");
    }
}
