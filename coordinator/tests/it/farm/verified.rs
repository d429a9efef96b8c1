//! Results are checked against their store before they count, and workers that report missing
//! results are not trusted.

use std::sync::atomic::Ordering;

use picofarm_proto::{messages::JobState, spec::JobSpec, wire};

use crate::farm::harness::{Farm, hello, manifest, spec};

/// Returns the same settings under another name.
fn renamed(count: u64) -> JobSpec {
    let mut other = spec(count);
    other.name = "another name".into();
    other
}

async fn alarms(farm: &mut Farm, job: &str) -> Vec<String> {
    let events = farm.events(job, None).await;
    let alarms = events
        .into_iter()
        .filter(|e| e.kind() == wire::EventKind::Alarm);
    alarms.map(|e| e.message).collect()
}

#[tokio::test]
async fn a_worker_that_reports_what_is_not_there_is_refused_and_gets_no_more_tasks() {
    for mut farm in Farm::start_on_each().await {
        let job = farm.submit(&spec(2)).await.job_id;
        let mut liar = farm.worker().await;
        for task in 0..2 {
            farm.stored.put(task, None);
        }
        let lease = liar.lease().await;
        let answer = liar.report(&lease, lease.lo, &"f".repeat(64)).await;
        assert!(!answer.accepted);
        assert!(answer.reason.contains("holds no such result"), "{answer:?}");
        let status = farm.until(&job, |s| s.tasks.leased == 0).await;
        assert_eq!((status.state, status.tasks.pending), (JobState::Active, 2));
        assert_eq!(alarms(&mut farm, &job).await.len(), 1);
        liar.credit(1).await;
        farm.stored.instead.lock().unwrap().clear();
        let mut honest = farm.connect(hello("bea")).await.unwrap();
        let status = honest.work(&mut farm, &job).await;
        assert_eq!((status.state, status.tasks.done), (JobState::Done, 2));
        assert_eq!(status.unverified, 0);
        let events = farm.events(&job, None).await;
        let committed = events
            .iter()
            .filter(|e| e.kind() == wire::EventKind::Committed);
        assert!(committed.clone().count() == 2 && committed.clone().all(|e| e.worker == "bea"));
        farm.stop().await;
    }
}

#[tokio::test]
async fn a_coordinator_that_finds_nothing_of_two_workers_sees_another_disk() {
    for mut farm in Farm::start_on_each().await {
        let job = farm.submit(&spec(2)).await.job_id;
        for task in 0..2 {
            farm.stored.put(task, None);
        }
        let mut first = farm.worker().await;
        let mut second = farm.connect(hello("bea")).await.unwrap();
        let lease = first.lease().await;
        assert!(!first.done(&lease, lease.lo).await.accepted);
        let status = second.work(&mut farm, &job).await;
        assert_eq!((status.state, status.unverified), (JobState::Done, 2));
        // The first worker is trusted again.
        let mut elsewhere = spec(1);
        elsewhere.name = "elsewhere".into();
        crate::farm::harness::rendering(&mut elsewhere)
            .output
            .dataset = "elsewhere".into();
        let next = farm.submit(&elsewhere).await.job_id;
        assert_eq!(first.work(&mut farm, &next).await.state, JobState::Done);
        let again = farm.submit(&spec(2)).await;
        assert!(again.existed);
        let plan = again.plan.unwrap();
        assert_eq!((plan.reuse, plan.run), (2, 0));
        assert!(
            plan.stages[0]
                .reasons
                .join(" ")
                .contains("may see another disk"),
            "{plan:?}"
        );
        farm.stop().await;
    }
}

#[tokio::test]
async fn a_folder_that_was_deleted_is_told_from_one_that_was_never_here() {
    for mut farm in Farm::start_on_each().await {
        let job = farm.submit(&spec(3)).await.job_id;
        let mut worker = farm.worker().await;
        worker.work(&mut farm, &job).await;
        farm.stored.absent.store(true, Ordering::SeqCst);
        let plan = farm.plan(&spec(3)).await;
        assert_eq!((plan.reuse, plan.run), (0, 3));
        let again = farm.submit(&spec(3)).await;
        assert!(!again.existed);
        assert_eq!(again.plan.unwrap(), plan, "plan and submit agree");
        let status = worker.work(&mut farm, &again.job_id).await;
        assert_eq!((status.state, status.unverified), (JobState::Done, 3));
        // These results were never checked here.
        let plan = farm.plan(&spec(3)).await;
        assert_eq!((plan.reuse, plan.run), (3, 0));
        let reasons = plan.stages[0].reasons.join(" ");
        assert!(
            reasons.contains("3 of 3 scenes recorded as done could not be verified"),
            "{reasons}"
        );
        let again = farm.submit(&spec(3)).await;
        assert!(again.existed);
        assert_eq!(again.plan.unwrap(), plan, "plan and submit agree");
        farm.stop().await;
    }
}

#[tokio::test]
async fn without_a_look_into_the_store_what_two_workers_agree_on_counts() {
    for mut farm in Farm::start_on_each().await {
        farm.stored.close("it is on another machine");
        let job = farm.submit(&spec(1)).await.job_id;
        let mut liar = farm.worker().await;
        let lease = liar.lease().await;
        assert!(liar.report(&lease, 0, &"f".repeat(64)).await.accepted);
        let status = farm.until_ended(&job).await;
        assert_eq!(status.unverified, 1);
        let next = farm.submit(&renamed(1)).await.job_id;
        let mut second = farm.connect(hello("bea")).await.unwrap();
        let lease = second.lease().await;
        let answer = second.report(&lease, 0, &manifest(0)).await;
        assert!(
            !answer.accepted && answer.reason.contains("two different results"),
            "{answer:?}"
        );
        assert_eq!(farm.status(&next).await.state, JobState::Active);
        farm.pass(20_000);
        let mut third = farm.connect(hello("cem")).await.unwrap();
        let lease = third.lease().await;
        assert!(third.report(&lease, 0, &manifest(0)).await.accepted);
        assert_eq!(farm.until_ended(&next).await.state, JobState::Done);
        let alarms = alarms(&mut farm, &next).await;
        assert!(
            alarms.last().unwrap().contains("reported by worker ada"),
            "{alarms:?}"
        );
        farm.stop().await;
    }
}
