//! What jobs consume, the bound on a user's cores, and jobs that wait for others.

use picofarm_proto::{
    messages::{JobState, WorkerHello},
    spec::JobSpec,
    wire::{self, session_response::Message as Heard},
};
use tonic::Code;

use crate::farm::harness::{Farm, hello, rendering, spec};

/// Returns a job with its own data set.
fn named(name: &str, count: u64) -> JobSpec {
    let mut spec = spec(count);
    spec.name = name.into();
    rendering(&mut spec).output.dataset = name.into();
    spec
}

async fn usage(farm: &mut Farm, by: &str) -> Vec<wire::UsageRow> {
    let request = wire::GetUsageRequest {
        by: by.into(),
        ..wire::GetUsageRequest::default()
    };
    let answer = farm.jobs.get_usage(request).await.unwrap();
    answer.into_inner().rows
}

async fn reasons(farm: &mut Farm, job: &str) -> Vec<wire::Reason> {
    let request = wire::ExplainJobRequest {
        job_id: job.into(),
        task: None,
        stage: 0,
    };
    let answer = farm.jobs.explain_job(request).await.unwrap();
    answer.into_inner().reasons
}

#[tokio::test]
async fn a_result_that_two_jobs_share_counts_once_for_the_job_that_made_it() {
    for mut farm in Farm::start_on_each().await {
        let mut first = spec(3);
        first.project = "light".into();
        let small = farm.submit(&first).await.job_id;
        let cores = |cores| {
            let mut hello = hello("w");
            hello.abilities.cores = cores;
            hello
        };
        let mut worker = farm.connect(cores(4)).await.unwrap();
        let lease = worker.lease().await;
        worker.fail(&lease, lease.lo, wire::FailureKind::User).await;
        farm.pass(10_000);
        worker.work(&mut farm, &small).await;
        // The larger job reuses three results and makes two.
        let large = farm.submit(&spec(5)).await.job_id;
        let status = worker.work(&mut farm, &large).await;
        assert_eq!((status.tasks.done, status.tasks.reused), (5, 3));
        let row = |name: &str, tasks: u64, failures: u64, seconds: u64| wire::UsageRow {
            name: name.into(),
            tasks,
            failures,
            // A task takes 2 s, a failure 3 s, on 4 cores.
            core_ms: 4_000 * seconds,
            bytes: 100 * tasks,
        };
        let by_project = usage(&mut farm, "project").await;
        assert_eq!(by_project, [row("", 2, 0, 4), row("light", 3, 1, 9)]);
        let by_day = usage(&mut farm, "day").await;
        assert_eq!(by_day, [row("0", 5, 1, 13)]);
        assert_eq!(usage(&mut farm, "user").await[0].tasks, 5);
    }
}

#[tokio::test]
async fn a_task_counts_for_its_part_of_the_workers_cores() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut eight = hello("w");
    eight.abilities.cores = 8;
    let mut worker = farm.connect(eight).await.unwrap();
    let lease = worker.lease().await;
    worker.share = 4;
    assert!(worker.done(&lease, 0).await.accepted);
    farm.until_ended(&job).await;
    assert_eq!(usage(&mut farm, "user").await[0].core_ms, 2 * 2_000);
}

fn of_cores(name: &str, cores: u32) -> WorkerHello {
    let mut hello = hello(name);
    hello.abilities.cores = cores;
    hello
}

#[tokio::test]
async fn a_user_gets_no_lease_beyond_the_quota_of_cores_and_is_told_so() {
    let mut farm = Farm::start().await;
    farm.config.quotas.cores_per_user = Some(5);
    farm.restart().await;
    let job = farm.submit(&spec(9)).await.job_id;
    let mut small = farm.connect(of_cores("small", 3)).await.unwrap();
    let lease = small.lease().await;
    let mut large = farm.connect(of_cores("large", 4)).await.unwrap();
    large.credit(1).await;
    let why = reasons(&mut farm, &job).await;
    assert_eq!(why[0].code, "quota", "{why:?}");
    for part in ["8 tasks wait", "3 of at most 5 cores", "has 4 cores"] {
        assert!(why[0].words.contains(part), "{why:?}");
    }
    // The worker with leases of the user gets more; another small one fits, too.
    let second = small.lease().await;
    let mut tiny = farm.connect(of_cores("tiny", 2)).await.unwrap();
    let third = tiny.lease().await;
    for lease in [&lease, &second] {
        for index in lease.lo..lease.hi {
            assert!(small.done(lease, index).await.accepted);
        }
    }
    for index in third.lo..third.hi {
        assert!(tiny.done(&third, index).await.accepted);
    }
    // Nothing of the quota is used now, and the large worker still asks.
    match large.hear().await.unwrap() {
        Heard::Lease(_) => {}
        other => panic!("expected a lease, heard {other:?}"),
    }
    let status = farm.status(&job).await;
    assert_eq!(status.state, JobState::Active);
}

#[tokio::test]
async fn a_user_gets_no_lease_and_no_job_beyond_the_quota_of_bytes() {
    for mut farm in Farm::start_on_each().await {
        farm.config.quotas.bytes_per_user = Some(200);
        farm.restart().await;
        let job = farm.submit(&spec(9)).await.job_id;
        let mut worker = farm.worker().await;
        // A task publishes 100 bytes.
        let mut published = 0;
        while published < 200 {
            let lease = worker.lease().await;
            for index in lease.lo..lease.hi {
                assert!(worker.done(&lease, index).await.accepted);
                published += 100;
            }
        }
        worker.credit(1).await;
        let why = reasons(&mut farm, &job).await;
        assert_eq!(why[0].code, "quota_bytes", "{why:?}");
        let bound = format!("published {published} B of at most 200 B");
        for part in ["wait for the quota", &bound, "--max-bytes-per-user"] {
            assert!(why[0].words.contains(part), "{why:?}");
        }
        let request = wire::SubmitJobRequest {
            spec: Some(named("second", 1).into()),
            again: false,
        };
        let refused = farm.jobs.submit_job(request).await.unwrap_err();
        assert_eq!(refused.code(), Code::ResourceExhausted);
        assert!(refused.message().contains(&bound), "{refused:?}");
        assert!(farm.submit(&spec(9)).await.existed);
        // The sum outlives the process, and a higher bound lets the job end.
        farm.restart().await;
        let worker = farm.worker().await;
        worker.credit(1).await;
        let why = reasons(&mut farm, &job).await;
        assert_eq!(why[0].code, "quota_bytes", "{why:?}");
        farm.config.quotas.bytes_per_user = Some(1_000);
        farm.restart().await;
        let mut worker = farm.worker().await;
        let status = worker.work(&mut farm, &job).await;
        assert_eq!(status.state, JobState::Done);
    }
}

#[tokio::test]
async fn a_job_after_another_begins_when_that_one_is_done() {
    for mut farm in Farm::start_on_each().await {
        let first = farm.submit(&named("first", 1)).await.job_id;
        let mut spec = named("second", 1);
        spec.priority = 9;
        spec.after = vec![first.clone(), first.clone()];
        let second = farm.submit(&spec).await.job_id;
        let mut worker = farm.worker().await;
        let lease = worker.lease().await;
        assert_eq!(lease.job.to_string(), first);
        worker.credit(1).await;
        let why = reasons(&mut farm, &second).await;
        assert_eq!(why[0].code, "after", "{why:?}");
        assert!(why[0].words.contains(&first), "{why:?}");
        let status = farm.status(&second).await;
        assert!(!status.paused && status.spec.after == [first.clone(), first.clone()]);
        assert!(worker.done(&lease, 0).await.accepted);
        // The coordinator asks the catalog again after a moment.
        farm.pass(1_000);
        let lease = match worker.hear().await.unwrap() {
            Heard::Lease(lease) => lease,
            other => panic!("expected a lease, heard {other:?}"),
        };
        assert_eq!(lease.job_id, second);
    }
}

#[tokio::test]
async fn an_unknown_job_in_after_is_refused_by_name() {
    let mut farm = Farm::start().await;
    for (text, says) in [
        (
            "0197f4a0-0000-7000-8000-000000000000",
            "there is no job 0197f4a0",
        ),
        ("12", "is not the id of a job"),
    ] {
        let mut spec = spec(1);
        spec.after = vec![text.into()];
        let request = wire::SubmitJobRequest {
            spec: Some(spec.into()),
            again: false,
        };
        let refused = farm.jobs.submit_job(request).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument);
        let said = refused.message();
        assert!(said.starts_with("after") && said.contains(says), "{said}");
    }
}
