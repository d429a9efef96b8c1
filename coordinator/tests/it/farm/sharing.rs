//! The order of work: consecutive stages, priorities, shares, limits, paused jobs, and help from
//! idle workers.

use picofarm_proto::{
    messages::{JobState, Lease, StageState},
    spec::JobSpec,
    wire::{self, session_response::Message as Heard},
};

use crate::farm::harness::{Farm, LEASE_MS, Worker, hello, rendering, spec};

/// Returns a job with its own data set.
fn named(name: &str, count: u64) -> JobSpec {
    let mut spec = spec(count);
    spec.name = name.into();
    rendering(&mut spec).output.dataset = name.into();
    spec
}

fn graph() -> JobSpec {
    serde_json::from_str(
        r#"{"name": "graph", "stage": [
            {"scenes": {"kind": "primitive", "count": 3}, "render": {"renderer": "r1"},
             "output": {"store": "file:///nowhere", "dataset": "clean"}},
            {"kind": "reprocess", "source": "render", "reprocess": {"version": "r1"},
             "output": {"store": "file:///nowhere", "dataset": "noisy"}}]}"#,
    )
    .unwrap()
}

async fn leases(worker: &mut Worker, n: u32) -> Vec<Lease> {
    let mut got = Vec::new();
    for _ in 0..n {
        got.push(worker.lease().await);
    }
    got
}

/// Returns the names of the jobs of these leases.
async fn jobs_of(farm: &mut Farm, leases: &[Lease]) -> Vec<String> {
    let mut names = Vec::new();
    for lease in leases {
        names.push(farm.status(&lease.job.to_string()).await.name);
    }
    names
}

#[tokio::test]
async fn a_stage_begins_when_what_it_needs_is_done_and_each_knows_its_own() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&graph()).await.job_id;
    let mut worker = farm.worker().await;
    let states = |status: &picofarm_proto::messages::JobStatus| -> Vec<_> {
        status.stages.iter().map(|s| s.state).collect()
    };
    let status = farm.status(&job).await;
    assert_eq!(states(&status), [StageState::Open, StageState::Blocked]);
    let explain = wire::ExplainJobRequest {
        job_id: job.clone(),
        task: None,
        stage: 0,
    };
    let why = farm.jobs.explain_job(explain).await.unwrap().into_inner();
    let blocked = why.reasons.iter().find(|r| r.code == "blocked").unwrap();
    assert!(
        blocked.words.contains("\"render\" (0 of 3 done)"),
        "{blocked:?}"
    );
    for done in 0..3 {
        let lease = worker.lease().await;
        assert_eq!((lease.ordinal, lease.stage.task.kind()), (0, "render"));
        assert_eq!((lease.lo, lease.hi), (done, done + 1));
        assert!(worker.done(&lease, done).await.accepted);
    }
    let lease = worker.lease().await;
    assert_eq!((lease.ordinal, lease.stage.task.kind()), (1, "reprocess"));
    let status = farm.status(&job).await;
    assert_eq!(states(&status), [StageState::Done, StageState::Open]);
    assert!(worker.done(&lease, lease.lo).await.accepted);
    let status = worker.work(&mut farm, &job).await;
    assert_eq!((status.state, status.tasks.done), (JobState::Done, 6));
}

#[tokio::test]
async fn the_higher_priority_goes_first_and_equals_share() {
    let mut farm = Farm::start().await;
    farm.submit(&named("a", 40)).await;
    farm.submit(&named("b", 40)).await;
    let mut worker = farm.worker().await;
    let got = leases(&mut worker, 6).await;
    let mut names = jobs_of(&mut farm, &got).await;
    names.sort();
    assert_eq!(names, ["a", "a", "a", "b", "b", "b"]);
    let mut urgent = named("urgent", 3);
    urgent.priority = 1;
    farm.submit(&urgent).await;
    let got = leases(&mut worker, 4).await;
    let names = jobs_of(&mut farm, &got).await;
    assert_eq!(names[..3], ["urgent", "urgent", "urgent"]);
    assert_ne!(names[3], "urgent");
}

#[tokio::test]
async fn jobs_take_turns_on_a_worker_that_runs_one_task_at_a_time() {
    let mut farm = Farm::start().await;
    farm.submit(&named("long", 400)).await;
    let mut worker = farm.worker().await;
    let mut turns = Vec::new();
    for turn in 0..8 {
        if turn == 2 {
            farm.submit(&named("short", 100)).await;
        }
        let lease = worker.lease().await;
        turns.extend(jobs_of(&mut farm, std::slice::from_ref(&lease)).await);
        for task in lease.lo..lease.hi {
            assert!(worker.done(&lease, task).await.accepted);
        }
    }
    // A new job queues behind those that wait, so that many new ones keep no old one from its turn.
    let expected = [
        "long", "long", "long", "short", "long", "short", "long", "short",
    ];
    assert_eq!(turns, expected);
}

#[tokio::test]
async fn after_any_number_of_leases_the_shares_of_equal_jobs_differ_by_at_most_one() {
    let mut farm = Farm::start().await;
    for name in ["a", "b", "c"] {
        farm.submit(&named(name, 40)).await;
    }
    let mut worker = farm.worker().await;
    let mut shares = [0i32; 3];
    // One lease at a time, then two and three, so that the worker asks with and without leases.
    for at_once in [1, 1, 1, 1, 2, 3, 2, 1, 1, 1] {
        let held = leases(&mut worker, at_once).await;
        for name in jobs_of(&mut farm, &held).await {
            shares[usize::from(name.as_bytes()[0] - b'a')] += 1;
            // Of leases granted together the order is not known, so that each counts alone.
            if at_once == 1 {
                let (least, most) = (shares.iter().min(), shares.iter().max());
                assert!(most.unwrap() - least.unwrap() <= 1, "{shares:?}");
            }
        }
        for lease in &held {
            for task in lease.lo..lease.hi {
                assert!(worker.done(lease, task).await.accepted);
            }
        }
    }
    let (least, most) = (shares.iter().min(), shares.iter().max());
    assert!(most.unwrap() - least.unwrap() <= 1, "{shares:?}");
}

#[tokio::test]
async fn no_more_workers_than_a_job_allows() {
    let mut farm = Farm::start().await;
    let mut limited = named("limited", 40);
    limited.limits.max_workers = 1;
    let job = farm.submit(&limited).await.job_id;
    let mut first = farm.worker().await;
    let held = leases(&mut first, 2).await;
    let second = Worker::connect(farm.address(), hello("second"))
        .await
        .unwrap();
    second.credit(1).await;
    // The second worker gets nothing while the first one is connected.
    let mut second = second;
    assert!(second.beat(&[], None).await.is_empty());
    assert_eq!(farm.status(&job).await.tasks.leased, 2);
    for lease in &held {
        assert!(first.release(lease).await.accepted);
    }
    drop(first);
    assert!(matches!(second.hear().await.unwrap(), Heard::Lease(_)));
}

#[tokio::test]
async fn a_held_job_begins_nothing_and_what_runs_goes_on() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(10)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    let pause = wire::PauseJobRequest {
        job_id: job.clone(),
    };
    let held = farm.jobs.pause_job(pause).await.unwrap().into_inner();
    assert!(held.job.unwrap().paused);
    worker.credit(1).await;
    assert!(worker.done(&lease, lease.lo).await.accepted);
    assert!(worker.beat(&[], None).await.is_empty());
    let status = farm.status(&job).await;
    assert_eq!((status.tasks.done, status.tasks.leased), (1, 0));
    let resume = wire::ResumeJobRequest {
        job_id: job.clone(),
    };
    farm.jobs.resume_job(resume).await.unwrap();
    assert!(matches!(worker.hear().await.unwrap(), Heard::Lease(_)));
    let cancel = wire::CancelJobRequest {
        job_id: job.clone(),
    };
    farm.jobs.cancel_job(cancel).await.unwrap();
    let pause = wire::PauseJobRequest { job_id: job };
    let refused = farm.jobs.pause_job(pause).await.unwrap_err();
    assert!(refused.message().contains("has ended"), "{refused:?}");
}

#[tokio::test]
async fn what_is_not_done_by_the_deadline_is_cancelled() {
    let mut farm = Farm::start().await;
    let mut late = spec(3);
    // The clock of these tests begins 1,000 s after 1970.
    late.limits.deadline = "1970-01-01T00:20:00Z".into();
    let job = farm.submit(&late).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    assert!(worker.done(&lease, lease.lo).await.accepted);
    farm.pass(200_000);
    let status = farm.until(&job, |s| s.state != JobState::Active).await;
    assert_eq!((status.state, status.tasks.done), (JobState::Cancelled, 1));
    let events = farm.events(&job, None).await;
    let why = &events.last().unwrap().message;
    assert!(why.contains("1970-01-01T00:20:00Z"), "{why}");
}

#[tokio::test]
async fn only_a_worker_that_has_what_a_stage_needs_gets_it() {
    let mut farm = Farm::start().await;
    let mut big = spec(2);
    let needs = &mut big.stages[0].resources;
    (needs.cores, needs.memory_gib, needs.labels) = (4, 2.0, vec!["fast".into()]);
    let job = farm.submit(&big).await.job_id;
    let mut small = farm.worker().await;
    small.credit(1).await;
    assert!(small.beat(&[], None).await.is_empty());
    let events = farm.events(&job, None).await;
    assert!(
        events.iter().any(|e| e.message.contains("needs 4 cores")),
        "{events:?}"
    );
    let mut able = hello("able");
    able.abilities.cores = 4;
    able.abilities.memory_mib = 2048;
    able.abilities.labels = vec!["slow".into(), "fast".into()];
    let mut able = Worker::connect(farm.address(), able).await.unwrap();
    able.lease().await;
}

/// Returns a worker with leases of tasks 1..n of a job, after its task 0 took two seconds.
async fn busy(farm: &mut Farm) -> (Worker, Vec<Lease>) {
    let mut worker = farm.worker().await;
    let first = worker.lease().await;
    assert!(worker.done(&first, first.lo).await.accepted);
    let mut held: Vec<Lease> = Vec::new();
    while held.last().is_none_or(|l| l.hi < 20) {
        held.push(worker.lease().await);
    }
    (worker, held)
}

#[tokio::test]
async fn of_a_held_job_a_worker_keeps_the_task_in_hand_alone() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(20)).await.job_id;
    let (mut worker, held) = busy(&mut farm).await;
    assert!(held.len() > 1 && held[0].hi > held[0].lo + 1, "{held:?}");
    let leases: Vec<&Lease> = held.iter().collect();
    worker.beat(&leases, Some(held[0].lo)).await;
    worker.beat(&[], None).await;
    let pause = wire::PauseJobRequest {
        job_id: job.clone(),
    };
    farm.jobs.pause_job(pause).await.unwrap();
    let (mut trimmed, mut revoked) = (Vec::new(), Vec::new());
    for _ in &held {
        match worker.hear().await.unwrap() {
            Heard::Trim(trim) => trimmed.push((trim.lease, trim.hi)),
            Heard::Revoke(revoke) => revoked.push(revoke.lease),
            other => panic!("expected to lose what is not begun, heard {other:?}"),
        }
    }
    assert_eq!(trimmed, [(Some(held[0].lease.into()), held[0].lo + 1)]);
    assert_eq!(revoked.len(), held.len() - 1);
    for other in &held[1..] {
        assert!(revoked.contains(&Some(other.lease.into())), "{other:?}");
    }
    let tasks = farm.status(&job).await.tasks;
    assert_eq!((tasks.done, tasks.leased, tasks.pending), (1, 1, 18));
    assert!(worker.done(&held[0], held[0].lo).await.accepted);
    let resume = wire::ResumeJobRequest {
        job_id: job.clone(),
    };
    farm.jobs.resume_job(resume).await.unwrap();
    let status = worker.work(&mut farm, &job).await;
    assert_eq!((status.state, status.tasks.done), (JobState::Done, 20));
}

#[tokio::test]
async fn an_idle_worker_takes_half_of_what_a_busy_one_has_not_begun() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(20)).await.job_id;
    let (mut worker, held) = busy(&mut farm).await;
    let mut idle = Worker::connect(farm.address(), hello("idle"))
        .await
        .unwrap();
    let taken = idle.lease().await;
    let Heard::Trim(trim) = worker.hear().await.unwrap() else {
        panic!("expected to be trimmed");
    };
    assert_eq!(trim.lease, Some(held[0].lease.into()));
    assert_eq!(trim.hi, taken.lo);
    assert!(held[0].lo < taken.lo && taken.hi <= held[0].hi);
    // The worker may still finish lost tasks: the other worker finds the result, and each task
    // counts once.
    assert!(!worker.done(&held[0], taken.lo).await.accepted);
    assert!(worker.done(&held[0], held[0].lo).await.accepted);
    for task in taken.lo..taken.hi {
        assert!(idle.done(&taken, task).await.accepted);
    }
    let status = farm.status(&job).await;
    assert_eq!(status.tasks.done, 2 + (taken.hi - taken.lo));
}

#[tokio::test]
async fn a_task_that_takes_far_too_long_runs_a_second_time_and_the_first_result_counts() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(2)).await.job_id;
    let mut slow = farm.worker().await;
    let first = slow.lease().await;
    assert!(slow.done(&first, first.lo).await.accepted);
    let last = slow.lease().await;
    slow.beat(&[&last], Some(last.lo)).await;
    slow.beat(&[], None).await;
    let mut idle = Worker::connect(farm.address(), hello("idle"))
        .await
        .unwrap();
    idle.credit(1).await;
    assert!(idle.beat(&[], None).await.is_empty(), "it is not slow yet");
    farm.pass(15_000);
    let Heard::Lease(double) = idle.hear().await.unwrap() else {
        panic!("expected the task a second time");
    };
    let double: Lease = double.try_into().unwrap();
    assert_eq!((double.lo, double.hi), (last.lo, last.hi));
    assert_eq!(
        idle.beat(&[&double], Some(double.lo)).await,
        [double.lease.into()]
    );
    assert!(idle.done(&double, double.lo).await.accepted);
    assert_eq!(slow.revoked().await.lease, Some(last.lease.into()));
    let status = farm.until(&job, |s| s.state != JobState::Active).await;
    assert_eq!((status.state, status.tasks.done), (JobState::Done, 2));
    // The first run may still end: it is equal, and too late for an ended job.
    slow.done(&last, last.lo).await;
    assert_eq!(farm.status(&job).await.tasks.done, 2);
}

#[tokio::test]
async fn a_double_ends_with_the_task_and_costs_it_nothing() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(2)).await.job_id;
    let mut slow = farm.worker().await;
    let first = slow.lease().await;
    assert!(slow.done(&first, first.lo).await.accepted);
    let last = slow.lease().await;
    slow.beat(&[&last], Some(last.lo)).await;
    slow.beat(&[], None).await;
    farm.pass(15_000);
    let mut clumsy = Worker::connect(farm.address(), hello("clumsy"))
        .await
        .unwrap();
    let double = clumsy.lease().await;
    clumsy
        .fail(&double, double.lo, wire::FailureKind::User)
        .await;
    farm.pass(1_000);
    let mut idle = Worker::connect(farm.address(), hello("idle"))
        .await
        .unwrap();
    let double = idle.lease().await;
    assert!(slow.done(&last, last.lo).await.accepted);
    assert_eq!(idle.revoked().await.lease, Some(double.lease.into()));
    let status = farm.status(&job).await;
    assert_eq!((status.state, status.tasks.done), (JobState::Done, 2));
    let failed = farm.events(&job, None).await;
    assert!(failed.iter().all(|e| e.kind() != wire::EventKind::Failed));
}

#[tokio::test]
async fn a_worker_at_which_one_task_after_another_fails_is_passed_over_while_others_are_there() {
    let mut farm = Farm::start().await;
    farm.submit(&spec(20)).await;
    let mut broken = farm.worker().await;
    for _ in 0..3 {
        let lease = broken.lease().await;
        broken.fail(&lease, lease.lo, wire::FailureKind::User).await;
    }
    // A single worker continues more slowly, because the job may be at fault.
    broken.credit(1).await;
    assert!(broken.beat(&[], None).await.is_empty());
    farm.pass(10_001);
    let Heard::Lease(lease) = broken.hear().await.unwrap() else {
        panic!("expected a lease");
    };
    let lease: Lease = lease.try_into().unwrap();
    broken.fail(&lease, lease.lo, wire::FailureKind::User).await;
    let mut sound = Worker::connect(farm.address(), hello("sound"))
        .await
        .unwrap();
    sound.lease().await;
    broken.credit(1).await;
    assert!(broken.beat(&[], None).await.is_empty());
    drop(sound);
    farm.pass(i64::from(LEASE_MS) + 1);
    assert!(matches!(broken.hear().await.unwrap(), Heard::Lease(_)));
}

#[tokio::test]
async fn a_crash_that_was_a_broken_connection_is_taken_back() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let who = hello("away");
    let mut worker = Worker::connect(farm.address(), who.clone()).await.unwrap();
    worker.lease().await;
    drop(worker);
    farm.pass(i64::from(LEASE_MS) + 1);
    farm.until(&job, |s| s.tasks.leased == 0).await;
    let crashes = async |farm: &mut Farm| {
        let explain = wire::ExplainJobRequest {
            job_id: job.clone(),
            task: Some(0),
            stage: 0,
        };
        let why = farm.jobs.explain_job(explain).await.unwrap().into_inner();
        why.task.unwrap().crashes
    };
    assert_eq!(crashes(&mut farm).await, 1);
    // Another process of the same worker changes nothing, because the first one died.
    let mut other = who.clone();
    other.incarnation = hello("x").incarnation;
    drop(Worker::connect(farm.address(), other).await.unwrap());
    assert_eq!(crashes(&mut farm).await, 1);
    drop(farm);

    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(1)).await.job_id;
    let mut worker = Worker::connect(farm.address(), who.clone()).await.unwrap();
    worker.lease().await;
    drop(worker);
    farm.pass(i64::from(LEASE_MS) + 1);
    farm.until(&job, |s| s.tasks.leased == 0).await;
    let _back = Worker::connect(farm.address(), who).await.unwrap();
    let explain = wire::ExplainJobRequest {
        job_id: job,
        task: Some(0),
        stage: 0,
    };
    let why = farm.jobs.explain_job(explain).await.unwrap().into_inner();
    assert_eq!(why.task.unwrap().crashes, 0);
}

#[tokio::test]
async fn a_drained_worker_hears_it_and_gets_nothing_more() {
    let mut farm = Farm::start().await;
    farm.submit(&spec(10)).await;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    let drain = wire::DrainWorkerRequest {
        worker: worker.hello.name.clone(),
    };
    let said = farm.jobs.drain_worker(drain).await.unwrap().into_inner();
    assert_eq!(said.workers, 1);
    assert!(matches!(worker.hear().await.unwrap(), Heard::Drain(_)));
    worker.credit(1).await;
    assert!(worker.done(&lease, lease.lo).await.accepted);
    assert!(worker.beat(&[], None).await.is_empty());
    let drain = wire::DrainWorkerRequest {
        worker: "nobody".into(),
    };
    let unknown = farm.jobs.drain_worker(drain).await.unwrap_err();
    assert_eq!(unknown.code(), tonic::Code::NotFound);
}

#[tokio::test]
async fn a_deadline_in_the_past_is_refused_by_plan_and_submission() {
    let mut farm = Farm::start().await;
    let mut late = spec(3);
    // The clock of these tests begins 1,000 s after 1970.
    late.limits.deadline = "1970-01-01T00:10:00Z".into();
    let submit = wire::SubmitJobRequest {
        spec: Some(late.clone().into()),
        again: false,
    };
    let refused = farm.jobs.submit_job(submit).await.unwrap_err();
    let plan = wire::PlanJobRequest {
        spec: Some(late.into()),
    };
    for status in [refused, farm.jobs.plan_job(plan).await.unwrap_err()] {
        assert_eq!(status.code(), tonic::Code::InvalidArgument, "{status:?}");
        let said = status.message();
        assert!(
            said.contains("limits.deadline") && said.contains("is in the past"),
            "{said}"
        );
    }
}

#[tokio::test]
async fn a_plan_warns_of_what_no_connected_worker_has_and_estimates_from_earlier_tasks() {
    let mut farm = Farm::start().await;
    let mut big = spec(2);
    big.stages[0].resources.cores = 1000;
    let plan = farm.plan(&big).await;
    assert!(
        plan.warnings[0].contains("no worker is connected"),
        "{plan:?}"
    );
    let job = farm.submit(&spec(2)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    for task in lease.lo..lease.hi {
        assert!(worker.done(&lease, task).await.accepted);
    }
    let plan = farm.plan(&big).await;
    assert!(plan.warnings[0].contains("1000 cores"), "{plan:?}");
    let plan = farm.plan(&named("more", 200)).await;
    assert!(plan.warnings.is_empty(), "{plan:?}");
    let stage = &plan.stages[0];
    assert_eq!(stage.workers, 1);
    assert!(stage.measured && stage.task_seconds.is_some(), "{stage:?}");
    drop((worker, job));
}
