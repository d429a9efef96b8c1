//! The worker's session against a scripted coordinator over real gRPC.

use crate::common;

use std::time::Duration;

use common::{Conversation, FakeFarm, Gate, Worker, config, lease, output, spec, stage};
use picofarm_proto::{
    PROTOCOL,
    key::{stage_key, task_key},
    wire::{
        self, FailureKind, session_request::Message as Said, session_response::Message as Answer,
    },
};
use picofarm_tasks::{AgentError, TaskError};
use tonic::Status;

/// Reads done tasks `lo..hi` and acknowledges each.
async fn take_done(c: &mut Conversation, indices: impl IntoIterator<Item = u64>) {
    for index in indices {
        let done = c.done().await;
        assert_eq!(done.index, index);
        c.acknowledge(done.lease, index).await;
    }
}

#[tokio::test]
async fn a_lease_is_worked_off_in_order_without_the_tasks_to_skip_and_the_next_is_asked_for() {
    let mut farm = FakeFarm::start().await;
    let worker = Worker::start(farm.address, |task, control| {
        control.at(0.5);
        Ok(output(task))
    });
    let (mut c, hello) = farm.welcome(60_000).await;
    assert_eq!((hello.protocol, hello.cores), (PROTOCOL, 1));
    assert_eq!(hello.kinds["render"], "fake-1");
    assert_eq!(hello.assets, ["parametric-1"]);
    assert!(hello.held.is_empty());
    c.listen_until("credit", |c| c.credit == 1).await;

    let mut first = lease(1, 3, 7);
    first.skip = vec![3, 5];
    c.grant(first).await;
    let stage = stage_key(&stage(spec("/nowhere")));
    for index in [4, 6] {
        let done = c.done().await;
        assert_eq!(done.index, index);
        assert_eq!(done.task_key, task_key(&stage, index).to_string());
        assert_eq!(done.manifest_sha256, done.task_key);
        assert_eq!((done.bytes, done.adopted), (1000 + index, false));
        c.acknowledge(done.lease, index).await;
    }
    c.listen_until("the next credit", |c| c.credit == 2).await;
    worker.shutdown.cancel();
    assert_eq!(
        c.next().await,
        None,
        "a worker with nothing in hand just leaves"
    );
    let summary = worker.end().await.unwrap();
    assert_eq!(
        (summary.computed, summary.failed, summary.unacknowledged),
        (2, 0, 0)
    );
}

#[tokio::test]
async fn a_dropped_session_is_opened_again_by_the_same_incarnation_and_the_report_is_sent_again() {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let mut worker = Worker::start(farm.address, move |task, control| {
        if task.index == 1 {
            held.pass(control)?;
        }
        Ok(output(task))
    });
    let (mut c, hello) = farm.welcome(60_000).await;
    c.grant(lease(1, 0, 2)).await;
    let unanswered = c.done().await;
    assert_eq!(unanswered.index, 0);
    assert_eq!(worker.starts().await, 0);
    assert_eq!(worker.starts().await, 1);
    drop(c);

    let (mut c, again) = farm.welcome(60_000).await;
    assert_eq!(again.incarnation, hello.incarnation);
    assert_eq!(again.worker_id, hello.worker_id);
    assert_eq!(again.held, [lease(1, 0, 2).lease.into()]);
    let repeated = c.done().await;
    assert_eq!(repeated, unanswered);
    c.acknowledge(repeated.lease, 0).await;
    gate.open();
    take_done(&mut c, [1]).await;
    worker.shutdown.cancel();
    let summary = worker.end().await.unwrap();
    assert_eq!(
        (summary.computed, summary.reconnects, summary.unacknowledged),
        (2, 1, 0)
    );
}

#[tokio::test]
async fn a_worker_computes_on_while_the_coordinator_is_away_and_hands_in_everything_on_its_return()
{
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let mut worker = Worker::start(farm.address, move |task, control| {
        held.pass(control)?;
        Ok(output(task))
    });
    let (c, hello) = farm.welcome(60_000).await;
    c.grant(lease(4, 0, 3)).await;
    assert_eq!(worker.starts().await, 0);
    let address = farm.stop().await;
    drop(c);
    gate.open();
    assert_eq!(worker.starts().await, 1);
    assert_eq!(worker.starts().await, 2);
    tokio::time::sleep(Duration::from_secs(2)).await;

    let mut farm = FakeFarm::start_at(address).await;
    let (mut c, again) = farm.welcome(60_000).await;
    assert_eq!(again.incarnation, hello.incarnation);
    assert_eq!(again.held, [lease(4, 0, 3).lease.into()]);
    take_done(&mut c, [0, 1, 2]).await;
    c.listen_until("credit", |c| c.credit > 0).await;
    worker.shutdown.cancel();
    assert_eq!(worker.end().await.unwrap().computed, 3);
}

#[tokio::test]
async fn a_worker_that_starts_before_its_coordinator_waits_for_it() {
    let farm = FakeFarm::start().await;
    let address = farm.stop().await;
    let worker = Worker::start(address, |task, _| Ok(output(task)));
    tokio::time::sleep(Duration::from_millis(500)).await;
    let mut farm = FakeFarm::start_at(address).await;
    let (mut c, _) = farm.welcome(60_000).await;
    c.grant(lease(1, 0, 1)).await;
    take_done(&mut c, [0]).await;
    worker.shutdown.cancel();
    assert_eq!(worker.end().await.unwrap().reconnects, 1);
}

#[tokio::test]
async fn a_revoked_lease_stops_its_running_task_and_starts_no_other_of_it() {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let mut worker = Worker::start(farm.address, move |task, control| {
        if task.index < 10 {
            gate.pass(control)?;
        }
        Ok(output(task))
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.listen_until("credit", |c| c.credit == 1).await;
    c.grant(lease(1, 0, 5)).await;
    assert_eq!(worker.starts().await, 0);
    c.say(Answer::Revoke(wire::Revoke {
        lease: Some(lease(1, 0, 5).lease.into()),
        reason: "job cancelled".into(),
    }))
    .await;
    c.listen_until("credit again", |c| c.credit == 2).await;
    c.grant(lease(2, 10, 11)).await;
    assert_eq!(worker.starts().await, 10);
    take_done(&mut c, [10]).await;
    worker.shutdown.cancel();
    assert_eq!(worker.end().await.unwrap().computed, 1);
}

#[tokio::test]
async fn heartbeats_tell_how_far_the_running_task_is() {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let worker = Worker::start(farm.address, move |task, control| {
        control.at(0.25);
        held.pass(control)?;
        Ok(output(task))
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.grant(lease(1, 0, 1)).await;
    c.listen_until("progress", |c| c.fractions.last() == Some(&0.25))
        .await;
    gate.open();
    take_done(&mut c, [0]).await;
    worker.shutdown.cancel();
    worker.end().await.unwrap();
}

#[tokio::test]
async fn shutdown_stops_a_long_task_and_gives_its_lease_back() {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let mut worker = Worker::start(farm.address, move |task, control| {
        control.at(0.01);
        gate.pass(control)?;
        Ok(output(task))
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.grant(lease(1, 0, 5)).await;
    assert_eq!(worker.starts().await, 0);
    tokio::time::sleep(Duration::from_millis(100)).await;
    worker.shutdown.cancel();
    let release = c.release().await;
    assert_eq!(release.lease, Some(lease(1, 0, 5).lease.into()));
    assert!(!release.reason.is_empty());
    c.acknowledge(release.lease, 0).await;
    let summary = worker.end().await.unwrap();
    assert_eq!(
        (summary.computed, summary.failed, summary.unacknowledged),
        (0, 0, 0)
    );
}

#[tokio::test]
async fn shutdown_takes_the_credit_back_and_hands_back_a_lease_that_was_under_way() {
    let mut farm = FakeFarm::start().await;
    let worker = Worker::start(farm.address, |task, _| Ok(output(task)));
    let (mut c, _) = farm.welcome(60_000).await;
    c.listen_until("credit", |c| c.credit == 1).await;
    c.renew = false;
    worker.shutdown.cancel();
    // Granted before the coordinator read the withdrawal.
    c.grant(lease(1, 0, 5)).await;
    let release = c.release().await;
    assert_eq!(release.lease, Some(lease(1, 0, 5).lease.into()));
    c.acknowledge(release.lease, 0).await;
    assert_eq!(worker.end().await.unwrap().computed, 0);
}

#[tokio::test]
async fn shutdown_lets_a_task_finish_that_is_nearly_done() {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let mut worker = Worker::start(farm.address, move |task, control| {
        control.at(0.99);
        held.pass(control)?;
        Ok(output(task))
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.grant(lease(1, 0, 5)).await;
    assert_eq!(worker.starts().await, 0);
    // The first heartbeat with progress shows that the task reports its progress.
    c.listen_until("progress", |c| c.fractions.last() == Some(&0.99))
        .await;
    worker.shutdown.cancel();
    tokio::time::sleep(Duration::from_millis(50)).await;
    gate.open();
    take_done(&mut c, [0]).await;
    let release = c.release().await;
    c.acknowledge(release.lease, 0).await;
    assert_eq!(worker.end().await.unwrap().computed, 1);
}

#[tokio::test]
async fn a_lease_revoked_after_it_ran_out_is_lost_but_its_running_task_is_still_handed_in() {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let mut worker = Worker::start(farm.address, move |task, control| {
        held.pass(control)?;
        Ok(output(task))
    });
    let (c, _) = farm.welcome(60_000).await;
    let mut short = lease(1, 0, 3);
    short.ttl_ms = 100;
    c.grant(short.clone()).await;
    assert_eq!(worker.starts().await, 0);
    drop(c);
    let (mut c, hello) = farm.welcome(60_000).await;
    assert_eq!(hello.held, [short.lease.into()]);
    tokio::time::sleep(Duration::from_millis(100)).await;
    c.say(Answer::Revoke(wire::Revoke {
        lease: Some(short.lease.into()),
        reason: "the lease ran out".into(),
    }))
    .await;
    c.listen_until("a heartbeat without it", |c| {
        c.beats > 0 && c.held.is_empty()
    })
    .await;
    gate.open();
    take_done(&mut c, [0]).await;
    assert!(
        worker.started.try_recv().is_err(),
        "lost: task 1 must not start"
    );
    worker.shutdown.cancel();
    assert_eq!(worker.end().await.unwrap().computed, 1);
}

#[tokio::test]
async fn a_worker_whose_id_another_process_took_over_ends_instead_of_fighting_for_it() {
    let mut farm = FakeFarm::start().await;
    let worker = Worker::start(farm.address, |task, _| Ok(output(task)));
    let (c, _) = farm.welcome(60_000).await;
    c.refuse(Status::aborted(
        "a newer session of this worker id took over",
    ))
    .await;
    match worker.end().await {
        Err(AgentError::Refused { reason, .. }) => {
            assert!(reason.contains("took over"), "{reason}")
        }
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_refused_worker_ends_with_the_coordinators_words() {
    let mut farm = FakeFarm::start().await;
    let worker = Worker::start(farm.address, |task, _| Ok(output(task)));
    let (c, _) = farm.meet().await;
    c.refuse(Status::failed_precondition(
        "protocol 1 is too old; this coordinator speaks 2",
    ))
    .await;
    match worker.end().await {
        Err(AgentError::Refused { reason, .. }) => assert!(reason.contains("too old"), "{reason}"),
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_panic_and_a_failure_are_reported_with_their_kinds_and_the_worker_lives_on() {
    let mut farm = FakeFarm::start().await;
    let worker = Worker::start(farm.address, |task, _| match task.index {
        0 => panic!("scene {} broke the renderer", task.index),
        1 => Err(TaskError::User("scenes.files[1]: is not there".into())),
        _ => Ok(output(task)),
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.grant(lease(1, 0, 3)).await;
    let crash = c.failed().await;
    assert_eq!((crash.index, crash.kind()), (0, FailureKind::Crash));
    assert!(
        crash.message.contains("scene 0 broke the renderer"),
        "{}",
        crash.message
    );
    c.acknowledge(crash.lease, 0).await;
    let user = c.failed().await;
    assert_eq!((user.index, user.kind()), (1, FailureKind::User));
    assert_eq!(user.message, "scenes.files[1]: is not there");
    c.acknowledge(user.lease, 1).await;
    take_done(&mut c, [2]).await;
    worker.shutdown.cancel();
    let summary = worker.end().await.unwrap();
    assert_eq!((summary.computed, summary.failed), (1, 2));
}

#[tokio::test]
async fn an_interruption_hands_the_lease_back_and_asks_for_more_only_after_a_wait() {
    let mut farm = FakeFarm::start().await;
    let mut worker = Worker::start(farm.address, |task, _| {
        if task.index == 0 {
            return Err(TaskError::Interrupted("the store is full".into()));
        }
        Ok(output(task))
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.listen_until("credit", |c| c.credit == 1).await;
    c.grant(lease(1, 0, 5)).await;
    assert_eq!(worker.starts().await, 0);
    let failed = c.failed().await;
    assert_eq!(failed.kind(), FailureKind::Interrupted);
    c.acknowledge(failed.lease, 0).await;
    let release = c.release().await;
    assert_eq!(release.reason, "the store is full");
    assert_eq!(c.credit, 1, "nothing is asked for before the wait is over");
    c.acknowledge(release.lease, 0).await;
    c.listen_until("credit after the wait", |c| c.credit == 2)
        .await;
    c.grant(lease(2, 1, 2)).await;
    take_done(&mut c, [1]).await;
    worker.shutdown.cancel();
    worker.end().await.unwrap();
}

#[tokio::test]
async fn a_lease_that_nobody_renews_is_fenced_and_its_further_tasks_are_not_started() {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let mut worker = Worker::start(farm.address, move |task, control| {
        if task.index == 0 {
            held.pass(control)?;
        }
        Ok(output(task))
    });
    // The session stays open, so only the missing renewals can fence.
    let (mut c, _) = farm.welcome(60_000).await;
    c.renew = false;
    let mut short = lease(1, 0, 3);
    short.ttl_ms = 600;
    c.grant(short.clone()).await;
    assert_eq!(worker.starts().await, 0);
    tokio::time::sleep(Duration::from_millis(600)).await;
    gate.open();
    take_done(&mut c, [0]).await;
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert!(
        worker.started.try_recv().is_err(),
        "fenced: task 1 must not start"
    );
    // A renewal lifts the fence.
    c.renew = true;
    take_done(&mut c, [1, 2]).await;
    worker.shutdown.cancel();
    worker.end().await.unwrap();
}

#[tokio::test]
async fn a_lease_that_the_renewal_leaves_out_is_lost_but_its_running_task_is_still_handed_in() {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let mut worker = Worker::start(farm.address, move |task, control| {
        control.at(0.5);
        held.pass(control)?;
        Ok(output(task))
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.grant(lease(1, 0, 3)).await;
    assert_eq!(worker.starts().await, 0);
    c.listen_until("progress", |c| !c.fractions.is_empty())
        .await;
    c.released.push(lease(1, 0, 3).lease.into());
    c.listen_until("a heartbeat without it", |c| c.held.is_empty())
        .await;
    gate.open();
    let done = c.done().await;
    assert_eq!(done.index, 0);
    c.say(Answer::Acknowledge(wire::Acknowledge {
        lease: done.lease,
        index: 0,
        accepted: false,
        reason: "the lease is over".into(),
    }))
    .await;
    c.listen_until("credit", |c| c.credit == 2).await;
    assert!(
        worker.started.try_recv().is_err(),
        "lost: task 1 must not start"
    );
    worker.shutdown.cancel();
    worker.end().await.unwrap();
}

#[tokio::test]
async fn the_next_lease_is_asked_for_ahead_of_short_tasks_but_not_of_long_ones() {
    let mut farm = FakeFarm::start().await;
    let (gate, second) = (Gate::new(), Gate::new());
    let gates = [(1, gate.clone()), (8, second.clone())];
    let mut worker = Worker::start(farm.address, move |task, control| {
        for (index, gate) in &gates {
            if task.index == *index {
                gate.pass(control)?;
            }
        }
        Ok(output(task))
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.listen_until("credit", |c| c.credit == 1).await;
    c.grant(lease(1, 1, 3)).await;
    assert_eq!(worker.starts().await, 1);
    let beats = c.beats;
    c.listen_until("some heartbeats", |c| c.beats > beats + 3)
        .await;
    assert_eq!(c.credit, 1, "nobody knows yet how long task 1 takes");
    gate.open();
    take_done(&mut c, [1, 2]).await;
    c.listen_until("the next credit", |c| c.credit == 2).await;
    c.grant(lease(2, 5, 9)).await;
    take_done(&mut c, [5, 6, 7]).await;
    c.listen_until("credit while task 8 runs", |c| c.credit == 3)
        .await;
    second.open();
    take_done(&mut c, [8]).await;
    worker.shutdown.cancel();
    worker.end().await.unwrap();
}

#[tokio::test]
async fn an_unusable_setting_is_named() {
    for (url, threads, field) in [
        ("farm.example:7717", 1, "coordinator"),
        ("http://", 1, "coordinator"),
        ("http://127.0.0.1:1", 0, "threads"),
    ] {
        let mut config = common::config("127.0.0.1:1".parse().unwrap());
        config.coordinator = url.into();
        config.threads = threads;
        let ended = picofarm_tasks::run(config, Default::default()).await;
        match ended {
            Err(AgentError::Config { field: named, .. }) => assert_eq!(named, field),
            Err(AgentError::Access(error)) => {
                assert!(
                    field == "coordinator" && error.to_string().contains(url),
                    "{error}"
                );
            }
            other => panic!("{url}: {other:?}"),
        }
    }
}

#[tokio::test]
async fn a_worker_without_work_ends_when_it_was_told_to_and_not_while_it_has_some() {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let config = picofarm_tasks::AgentConfig {
        exit_idle: Some(Duration::from_millis(300)),
        ..common::config(farm.address)
    };
    let worker = Worker::start_with(config, move |task, control| {
        held.pass(control)?;
        Ok(output(task))
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.listen_until("credit", |c| c.credit == 1).await;
    c.grant(lease(1, 0, 1)).await;
    tokio::time::sleep(Duration::from_millis(600)).await;
    gate.open();
    let done = c.done().await;
    c.acknowledge(done.lease, 0).await;
    let summary = worker.end().await.unwrap();
    assert_eq!((summary.computed, summary.unacknowledged), (1, 0));
}

#[tokio::test]
async fn a_worker_answers_an_examination_while_its_task_runs_and_opens_no_place_outside_its_prefixes()
 {
    let mut farm = FakeFarm::start().await;
    let gate = Gate::new();
    let held = gate.clone();
    let mut config = config(farm.address);
    config.store_prefixes = vec!["/nowhere".into()];
    let mut worker = Worker::start_with(config, move |task, control| {
        held.pass(control)?;
        Ok(output(task))
    });
    let (mut c, _) = farm.welcome(60_000).await;
    c.grant(lease(1, 0, 1)).await;
    worker.starts().await;
    for (id, store, expected) in [
        (
            7,
            "/nowhere/store",
            "ok store \"/nowhere/store\", scenes \"\"",
        ),
        (8, "/etc", "ok store \"\", scenes \"\""),
    ] {
        c.say(Answer::Examine(wire::Examine {
            id,
            store: store.into(),
            scenes: String::new(),
        }))
        .await;
        let answer = match c.next().await {
            Some(Said::Examined(answer)) => answer,
            other => panic!("expected an examination, got {other:?}"),
        };
        assert_eq!((answer.id, answer.clock_ms > 0), (id, true));
        let first = &answer.checks[0];
        assert_eq!(first.verdict(), wire::Verdict::Ok);
        assert_eq!(format!("ok {}", first.detail), expected);
        let refused = answer.checks.get(1);
        assert_eq!(refused.is_some(), store == "/etc", "{refused:?}");
        if let Some(refused) = refused {
            assert_eq!(
                (&*refused.what, refused.verdict()),
                ("store", wire::Verdict::Bad)
            );
            assert!(refused.detail.contains("store prefixes"), "{refused:?}");
        }
    }
    gate.open();
    let done = c.done().await;
    c.acknowledge(done.lease, done.index).await;
    worker.shutdown.cancel();
    worker.end().await.unwrap();
}
