//! Invalid messages, and messages that a database rejects, affect only their own task or job: no
//! session ends, and no other task or job waits.

use picofarm_database::testing;
use picofarm_proto::{
    key::task_key,
    messages::{JobState, Lease},
    spec::JobSpec,
    wire::{self, session_request::Message as Say},
};
use tonic::Code;

use crate::farm::harness::{Farm, catalog_of, hello, manifest, rendering, spec};

/// Returns a job with one attempt for each task.
fn strict(name: &str, count: u64) -> JobSpec {
    let mut job = spec(count);
    job.name = name.into();
    job.limits.max_failures = 1;
    rendering(&mut job).output.dataset = name.into();
    job
}

fn report(lease: &Lease, index: u64) -> wire::TaskDone {
    wire::TaskDone {
        lease: Some(lease.lease.into()),
        index,
        task_key: task_key(&lease.key, index).to_string(),
        manifest_sha256: manifest(index),
        bytes: 100,
        seconds: 2.0,
        adopted: false,
        traceparent: String::new(),
        shared: 0,
    }
}

fn failure(lease: &Lease, index: u64, message: &str) -> Say {
    Say::Failed(wire::TaskFailed {
        lease: Some(lease.lease.into()),
        index,
        kind: wire::FailureKind::User.into(),
        message: message.into(),
        damaged: false,
        milliseconds: 0,
        shared: 0,
    })
}

async fn last_error(farm: &mut Farm, job: &str, task: u64) -> String {
    let request = wire::ExplainJobRequest {
        job_id: job.into(),
        task: Some(task),
        stage: 0,
    };
    let answer = farm.jobs.explain_job(request).await.unwrap().into_inner();
    answer.task.unwrap().last_error
}

#[tokio::test]
async fn an_error_message_with_control_characters_is_recorded_printable_and_nobody_else_waits() {
    for mut farm in Farm::start_on_each().await {
        let mut worker = farm.worker().await;
        let job = farm.submit(&strict("mine", 1)).await.job_id;
        let lease = worker.lease().await;
        let poison = format!("no mesh \0 \u{1b}[2J\n{}", "x".repeat(100_000));
        worker.say(failure(&lease, lease.lo, &poison)).await;
        assert!(worker.acknowledged().await.accepted);
        let said = last_error(&mut farm, &job, 0).await;
        assert!(said.starts_with("no mesh    [2J x"), "{said:?}");
        assert!(said.len() <= 4096, "{}", said.len());
        assert_eq!(farm.until_ended(&job).await.state, JobState::Failed);
        // The same session continues to work.
        let other = farm.submit(&strict("other", 3)).await.job_id;
        let done = worker.work(&mut farm, &other).await;
        assert_eq!((done.state, done.tasks.done), (JobState::Done, 3));
    }
}

#[tokio::test]
async fn a_report_that_says_what_cannot_be_counts_as_its_tasks_failure_and_is_not_sent_again() {
    for mut farm in Farm::start_on_each().await {
        let mut worker = farm.worker().await;
        type Spoil = fn(&mut wire::TaskDone);
        let spoil: [(&str, Spoil); 6] = [
            ("done.bytes", |r| r.bytes = u64::MAX),
            ("done.bytes", |r| r.bytes = 1 << 63),
            ("done.seconds", |r| r.seconds = -1e300),
            ("done.seconds", |r| r.seconds = f64::NAN),
            ("done.manifest_sha256", |r| r.manifest_sha256 = "x\0".into()),
            ("done.task_key", |r| r.task_key = "é".repeat(64)),
        ];
        for (n, (field, spoil)) in spoil.into_iter().enumerate() {
            let job = farm.submit(&strict(&format!("bad-{n}"), 1)).await.job_id;
            let lease = worker.lease().await;
            let mut bad = report(&lease, lease.lo);
            spoil(&mut bad);
            worker.say(Say::Done(bad)).await;
            let answer = worker.acknowledged().await;
            assert!(
                !answer.accepted && answer.reason.contains(field),
                "{answer:?}"
            );
            assert_eq!(farm.until_ended(&job).await.state, JobState::Failed);
            let said = last_error(&mut farm, &job, 0).await;
            assert!(said.contains(field), "{said}");
        }
        let job = farm.submit(&strict("good", 3)).await.job_id;
        assert_eq!(worker.work(&mut farm, &job).await.state, JobState::Done);
    }
}

#[tokio::test]
async fn names_that_no_catalog_should_hold_are_refused_by_their_field() {
    let mut farm = Farm::start().await;
    for name in ["a\0b", "a\u{1b}[31m", &"n".repeat(201)] {
        let refused = farm.connect(hello(name)).await.err().unwrap();
        assert_eq!(refused.code(), Code::InvalidArgument, "{refused:?}");
        assert!(refused.message().contains("hello.name"), "{refused:?}");
    }
    let long = |n| "x".repeat(n);
    type Spoil = fn(&mut JobSpec, String);
    let spoil: [(&str, Spoil, String); 4] = [
        ("name", |job, text| job.name = text, long(100_000)),
        (
            "output.dataset",
            |job, text| rendering(job).output.dataset = text,
            long(6_000),
        ),
        (
            "output.store",
            |job, text| rendering(job).output.store = text,
            format!("/{}", long(9_000)),
        ),
        (
            "output.store",
            |job, text| rendering(job).output.store = text,
            "/a\0b".into(),
        ),
    ];
    for (field, spoil, text) in spoil {
        let mut job = spec(1);
        spoil(&mut job, text);
        let request = wire::SubmitJobRequest {
            spec: Some(job.into()),
            again: false,
        };
        let refused = farm.jobs.submit_job(request).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument, "{refused:?}");
        assert!(refused.message().starts_with(field), "{refused:?}");
        assert!(refused.message().len() < 300, "{refused:?}");
    }
}

#[tokio::test]
async fn what_the_database_refuses_costs_its_task_and_all_else_is_durable() {
    for mut farm in Farm::start_on_each().await {
        let theirs = farm.submit(&strict("theirs", 4)).await.job_id;
        let mut honest = farm.worker().await;
        let held = honest.lease().await;
        let mine = farm.submit(&strict("mine", 8)).await.job_id;
        let mut worker = farm.connect(hello("bob")).await.unwrap();
        testing::refuse_poison(&catalog_of(&farm)).await;

        // The whole job at once, with three rejected rows: a result, and an error message (which is
        // also a history line).
        let mut reports = 0;
        let (mut refused, mut seen) = (Vec::new(), 0);
        while seen < 8 {
            let lease = worker.lease().await;
            if lease.job.to_string() != mine {
                let released = worker.release(&lease).await;
                assert!(released.accepted);
                continue;
            }
            for index in lease.lo..lease.hi {
                match index {
                    2 => worker.say(failure(&lease, 2, "poison")).await,
                    5 => {
                        let bad = wire::TaskDone {
                            bytes: 666,
                            ..report(&lease, 5)
                        };
                        worker.say(Say::Done(bad)).await;
                    }
                    _ => worker.say(Say::Done(report(&lease, index))).await,
                }
                reports += 1;
            }
            while seen < reports {
                let answer = worker.acknowledged().await;
                seen += 1;
                if !answer.accepted {
                    refused.push((answer.index, answer.reason));
                }
            }
        }
        assert_eq!(refused.len(), 1, "{refused:?}");
        assert_eq!(refused[0].0, 5);
        assert!(refused[0].1.contains("cannot be recorded"), "{refused:?}");
        let ended = farm.until_ended(&mine).await;
        assert_eq!(ended.state, JobState::Failed);
        assert_eq!((ended.tasks.done, ended.tasks.dead), (6, 2), "{ended:?}");
        for (task, why) in [
            (2, "error message could not be recorded"),
            (5, "cannot be recorded"),
        ] {
            let said = last_error(&mut farm, &mine, task).await;
            assert!(said.contains(why), "{said}");
        }
        // The other worker's session and lease are unchanged.
        for index in held.lo..held.hi {
            assert!(honest.done(&held, index).await.accepted);
        }
        let done = honest.work(&mut farm, &theirs).await;
        assert_eq!((done.state, done.tasks.done), (JobState::Done, 4));
        // Given-up tasks run again on request, and give the same results.
        farm.restart().await;
        let status = farm.status(&mine).await;
        assert_eq!((status.tasks.done, status.tasks.dead), (6, 2));
        let retry = wire::RetryJobRequest {
            job_id: mine.clone(),
        };
        let retried = farm.jobs.retry_job(retry).await.unwrap().into_inner();
        assert_eq!(retried.retried, 2);
        let mut worker = farm.worker().await;
        assert_eq!(worker.work(&mut farm, &mine).await.state, JobState::Done);
    }
}

#[tokio::test]
async fn a_job_and_a_worker_that_the_database_refuses_trouble_nobody_else() {
    for mut farm in Farm::start_on_each().await {
        let mut worker = farm.worker().await;
        testing::refuse_poison(&catalog_of(&farm)).await;
        let mut job = spec(1);
        rendering(&mut job).output.store = "/poison".into();
        let request = wire::SubmitJobRequest {
            spec: Some(job.into()),
            again: false,
        };
        let refused = farm.jobs.submit_job(request).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument, "{refused:?}");
        assert!(refused.message().contains("cannot hold"), "{refused:?}");
        let named = farm.connect(hello("poison")).await.unwrap();
        let job = farm.submit(&spec(2)).await.job_id;
        assert_eq!(worker.work(&mut farm, &job).await.state, JobState::Done);
        drop(named);
    }
}
