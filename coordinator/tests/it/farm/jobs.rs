//! Jobs from their owner's point of view.

use picofarm_proto::{messages::JobState, wire};
use tonic::Code;

use crate::farm::harness::{Farm, hello, rendering, spec};

#[tokio::test]
async fn a_whole_job_completes() {
    let mut farm = Farm::start().await;
    let submitted = farm.submit(&spec(40)).await;
    assert!(!submitted.existed);
    assert_eq!(submitted.plan.unwrap().run, 40);
    let job = submitted.job_id;
    let mut worker = farm.worker().await;
    let status = worker.work(&mut farm, &job).await;
    assert_eq!(status.state, JobState::Done);
    assert_eq!((status.tasks.done, status.tasks.reused), (40, 0));
    assert_eq!(status.mean_task_seconds, Some(2.0));
    let events = farm.events(&job, None).await;
    let of = |kind: wire::EventKind| events.iter().filter(|e| e.kind() == kind).count();
    assert_eq!(of(wire::EventKind::Committed), 40);
    assert_eq!(of(wire::EventKind::Submitted), 1);
    assert_eq!(of(wire::EventKind::Ended), 1);
    // With 2 s a task, leases grow beyond one task.
    assert!(of(wire::EventKind::Leased) < 20);
    let one = farm.events(&job, Some(7)).await;
    let kinds: Vec<_> = one.iter().map(|e| e.kind()).collect();
    assert_eq!(kinds, [wire::EventKind::Leased, wire::EventKind::Committed]);
}

#[tokio::test]
async fn a_larger_job_reuses_the_outputs_of_a_smaller_one() {
    let mut farm = Farm::start().await;
    let small = farm.submit(&spec(8)).await.job_id;
    let mut worker = farm.worker().await;
    worker.work(&mut farm, &small).await;
    let plan = farm
        .jobs
        .plan_job(wire::PlanJobRequest {
            spec: Some(spec(16).into()),
        })
        .await
        .unwrap()
        .into_inner()
        .plan
        .unwrap();
    assert_eq!((plan.reuse, plan.run), (8, 8));
    assert_eq!(plan.stages[0].reasons.len(), 2);
    let large = farm.submit(&spec(16)).await.job_id;
    let status = farm.status(&large).await;
    assert_eq!((status.tasks.reused, status.tasks.pending), (8, 8));
    let status = worker.work(&mut farm, &large).await;
    assert_eq!((status.tasks.done, status.tasks.reused), (16, 8));
    // All results exist now, so that nothing runs.
    let mut other = spec(16);
    other.name = "another name".into();
    let third = farm.submit(&other).await.job_id;
    let status = farm.status(&third).await;
    assert_eq!((status.state, status.tasks.reused), (JobState::Done, 16));
}

#[tokio::test]
async fn a_job_that_would_mix_settings_in_one_data_set_is_refused() {
    let mut farm = Farm::start().await;
    let first = farm.submit(&spec(2)).await.job_id;
    let mut other = spec(2);
    rendering(&mut other).render.bins += 1;
    let request = wire::SubmitJobRequest {
        spec: Some(other.clone().into()),
        again: false,
    };
    let refused = farm.jobs.submit_job(request).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    for part in ["output.dataset", &first, "render.bins"] {
        assert!(refused.message().contains(part), "{}", refused.message());
    }
    // Another data set gives a different job.
    rendering(&mut other).output.dataset = "elsewhere".into();
    assert!(!farm.submit(&other).await.existed);
}

#[tokio::test]
async fn an_output_is_not_made_again_for_another_job_that_waits_for_it() {
    let mut farm = Farm::start().await;
    let small = farm.submit(&spec(3)).await.job_id;
    let large = farm.submit(&spec(5)).await.job_id;
    let mut worker = farm.worker().await;
    let first = worker.work(&mut farm, &small).await;
    let second = worker.work(&mut farm, &large).await;
    assert_eq!(
        (first.state, second.state),
        (JobState::Done, JobState::Done)
    );
    // The jobs take turns, so that each makes some of the three outputs that both want.
    assert_eq!((first.tasks.done, second.tasks.done), (3, 5));
    assert_eq!(first.tasks.reused + second.tasks.reused, 3);
    assert!(first.tasks.reused > 0 && second.tasks.reused > 0);
    let mut made = Vec::new();
    for job in [&small, &large] {
        let events = farm.events(job, None).await;
        let runs = events
            .iter()
            .filter(|e| e.kind() == wire::EventKind::Committed);
        made.extend(runs.flat_map(|e| e.lo()..e.hi()));
    }
    made.sort_unstable();
    assert_eq!(made, [0, 1, 2, 3, 4]);
}

#[tokio::test]
async fn the_same_spec_is_the_same_job_until_it_is_submitted_again() {
    let mut farm = Farm::start().await;
    let first = farm.submit(&spec(2)).await;
    let second = farm.submit_again(&spec(2), true).await;
    assert!(second.existed);
    assert_eq!(first.job_id, second.job_id);
    let request = wire::CancelJobRequest {
        job_id: first.job_id.clone(),
    };
    farm.jobs.cancel_job(request).await.unwrap();
    let third = farm.submit(&spec(2)).await;
    assert!(third.existed);
    assert_eq!(third.job_id, first.job_id);
    let fourth = farm.submit_again(&spec(2), true).await;
    assert!(!fourth.existed);
    assert_ne!(fourth.job_id, first.job_id);
    let mut worker = farm.worker().await;
    worker.work(&mut farm, &fourth.job_id).await;
    assert!(farm.submit_again(&spec(2), true).await.existed);
}

#[tokio::test]
async fn cancelling_revokes_leases_and_refuses_late_reports() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(4)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    let request = wire::CancelJobRequest {
        job_id: job.clone(),
    };
    farm.jobs.cancel_job(request).await.unwrap();
    let revoke = worker.revoked().await;
    assert_eq!(revoke.lease, Some(lease.lease.into()));
    assert!(!worker.done(&lease, lease.lo).await.accepted);
    let status = farm.status(&job).await;
    assert_eq!(status.state, JobState::Cancelled);
    assert_eq!(status.tasks.done, 0);
    let retry = farm.jobs.retry_job(wire::RetryJobRequest { job_id: job });
    assert_eq!(retry.await.unwrap_err().code(), Code::FailedPrecondition);
}

#[tokio::test]
async fn a_failing_task_is_tried_again_then_dead_then_retried() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(3)).await.job_id;
    let mut worker = farm.worker().await;
    let mut tries = 0;
    loop {
        let status = farm.status(&job).await;
        if status.state != JobState::Active {
            assert_eq!(status.state, JobState::Failed);
            assert_eq!((status.tasks.done, status.tasks.dead), (2, 1));
            break;
        }
        let lease = worker.lease().await;
        for index in lease.lo..lease.hi {
            if index == 1 {
                tries += 1;
                worker.fail(&lease, 1, wire::FailureKind::User).await;
            } else {
                assert!(worker.done(&lease, index).await.accepted);
            }
        }
        farm.pass(10_000);
        farm.until(&job, |s| s.tasks.leased == 0).await;
    }
    assert_eq!(tries, 3);
    let request = wire::RetryJobRequest {
        job_id: job.clone(),
    };
    let retried = farm.jobs.retry_job(request).await.unwrap().into_inner();
    assert_eq!(retried.retried, 1);
    assert_eq!(worker.work(&mut farm, &job).await.state, JobState::Done);
}

#[tokio::test]
async fn a_failed_task_waits_before_it_is_tried_again() {
    let mut farm = Farm::start().await;
    farm.submit(&spec(1)).await;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    worker.fail(&lease, 0, wire::FailureKind::User).await;
    worker.credit(1).await;
    // A heartbeat is answered before any lease is granted, and the task still waits.
    assert!(worker.beat(&[], None).await.is_empty());
    farm.pass(1_000);
    let again = match worker.hear().await.unwrap() {
        wire::session_response::Message::Lease(lease) => lease,
        other => panic!("{other:?}"),
    };
    assert_eq!((again.lo, again.hi), (0, 1));
}

#[tokio::test]
async fn watching_ends_with_the_job() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(3)).await.job_id;
    let request = wire::WatchJobRequest {
        job_id: job.clone(),
    };
    let mut watch = farm.jobs.watch_job(request).await.unwrap().into_inner();
    let first = watch.message().await.unwrap().unwrap().job.unwrap();
    assert_eq!(first.tasks.unwrap().pending, 3);
    let mut worker = farm.worker().await;
    worker.work(&mut farm, &job).await;
    let mut last = first;
    while let Some(report) = watch.message().await.unwrap() {
        last = report.job.unwrap();
    }
    assert_eq!(last.state(), wire::JobState::Done);
}

#[tokio::test]
async fn a_job_for_another_renderer_says_why_it_waits() {
    let mut farm = Farm::start().await;
    let mut other = hello("old");
    other.abilities.kinds.insert("render".into(), "r0".into());
    let worker = farm.connect(other).await.unwrap();
    worker.credit(1).await;
    let job = farm.submit(&spec(2)).await.job_id;
    let events = loop {
        let events = farm.events(&job, None).await;
        if events.len() > 1 {
            break events;
        }
    };
    assert_eq!(events[1].kind(), wire::EventKind::Waiting);
    assert!(events[1].message.contains("renderer"), "{events:?}");
    assert_eq!(farm.status(&job).await.tasks.leased, 0);
}

#[tokio::test]
async fn what_a_client_must_resolve_is_refused_by_name() {
    let mut farm = Farm::start().await;
    let mut unresolved = spec(2);
    rendering(&mut unresolved).render.renderer.clear();
    let request = wire::SubmitJobRequest {
        spec: Some(unresolved.into()),
        again: false,
    };
    let error = farm.jobs.submit_job(request).await.unwrap_err();
    assert_eq!(error.code(), Code::InvalidArgument);
    assert!(error.message().contains("render.renderer"), "{error}");
}
