//! A recorded result counts for another job only if the store contains it.

use std::sync::atomic::Ordering;

use picofarm_proto::{messages::JobState, spec::JobSpec, wire};

use crate::farm::harness::{Farm, Worker, manifest, rendering, spec};

/// Completes a job of `count` scenes. Returns it and its worker.
async fn done(farm: &mut Farm, count: u64) -> (String, Worker) {
    let job = farm.submit(&spec(count)).await.job_id;
    let mut worker = farm.worker().await;
    worker.work(farm, &job).await;
    (job, worker)
}

/// Returns the same settings under another name.
fn renamed(count: u64) -> JobSpec {
    let mut other = spec(count);
    other.name = "another name".into();
    other
}

fn bytes(index: u64) -> [u8; 32] {
    let mut bytes = [0; 32];
    hex::decode_to_slice(manifest(index), &mut bytes).unwrap();
    bytes
}

#[tokio::test]
async fn a_done_job_whose_results_are_gone_runs_again_without_being_asked() {
    for mut farm in Farm::start_on_each().await {
        let (job, mut worker) = done(&mut farm, 8).await;
        assert!(farm.submit(&spec(8)).await.existed, "all is there");
        for task in [2, 3, 6] {
            farm.stored.put(task, None);
        }
        let plan = farm.plan(&spec(8)).await;
        assert_eq!((plan.reuse, plan.run), (5, 3));
        let words =
            "3 of 8 scenes recorded as done are gone from file:///nowhere: they will run again";
        assert!(
            plan.stages[0].reasons.iter().any(|r| r == words),
            "{plan:?}"
        );
        let again = farm.submit(&spec(8)).await;
        assert!(!again.existed);
        assert_ne!(again.job_id, job);
        let status = farm.status(&again.job_id).await;
        assert_eq!((status.tasks.reused, status.tasks.pending), (5, 3));
        // Scenes not yet made stay missing for all jobs, and a twin waits for the job that makes
        // them.
        assert!(farm.submit(&spec(8)).await.existed);
        farm.stored.instead.lock().unwrap().clear();
        let status = worker.work(&mut farm, &again.job_id).await;
        assert_eq!((status.state, status.tasks.done), (JobState::Done, 8));
        assert!(farm.submit(&spec(8)).await.existed);
        farm.stop().await;
    }
}

#[tokio::test]
async fn a_deleted_store_leaves_nothing_done() {
    for mut farm in Farm::start_on_each().await {
        let (_, mut worker) = done(&mut farm, 5).await;
        for task in 0..5 {
            farm.stored.put(task, None);
        }
        let grown = farm.plan(&spec(9)).await;
        assert_eq!((grown.reuse, grown.run), (0, 9));
        let again = farm.submit(&spec(5)).await;
        assert_eq!((again.existed, again.plan.unwrap().run), (false, 5));
        let status = worker.work(&mut farm, &again.job_id).await;
        assert_eq!((status.tasks.done, status.tasks.reused), (5, 0));
        farm.stop().await;
    }
}

#[tokio::test]
async fn of_many_results_a_sample_is_looked_at_and_all_once_one_of_them_is_gone() {
    let mut farm = Farm::start().await;
    farm.stored.close("it is on another machine");
    let (_, _worker) = done(&mut farm, 1_500).await;
    *farm.stored.closed.lock().unwrap() = None;
    farm.plan(&spec(1_500)).await;
    let stored = farm.stored.clone();
    let first = stored.asked.swap(0, Ordering::SeqCst);
    assert_eq!(first, 1_500, "what nobody has seen is all looked at");
    farm.plan(&spec(1_500)).await;
    let sampled = stored.asked.swap(0, Ordering::SeqCst);
    assert!((1..200).contains(&sampled), "{sampled}");
    for task in 0..1_400 {
        stored.put(task, None);
    }
    let plan = farm.plan(&spec(1_500)).await;
    assert_eq!((plan.reuse, plan.run), (100, 1_400));
    assert_eq!(stored.asked.load(Ordering::SeqCst), 1_500);
}

#[tokio::test]
async fn a_result_that_a_worker_made_up_does_not_count_for_the_next_job() {
    for mut farm in Farm::start_on_each().await {
        let job = farm.submit(&spec(2)).await.job_id;
        let mut liar = farm.worker().await;
        for _ in 0..2 {
            let lease = liar.lease().await;
            assert!(
                liar.report(&lease, lease.lo, &"f".repeat(64))
                    .await
                    .accepted
            );
        }
        farm.until_ended(&job).await;
        // The store is empty, because nothing was ever rendered.
        for task in 0..2 {
            farm.stored.put(task, None);
        }
        let next = farm.submit(&renamed(2)).await;
        assert_eq!(next.plan.unwrap().run, 2);
        farm.stored.instead.lock().unwrap().clear();
        let status = liar.work(&mut farm, &next.job_id).await;
        assert_eq!((status.tasks.done, status.tasks.reused), (2, 0));
        farm.stop().await;
    }
}

#[tokio::test]
async fn what_nobody_could_look_at_is_looked_for_by_a_worker() {
    for mut farm in Farm::start_on_each().await {
        farm.stored.close("it is on another machine");
        let (_, mut worker) = done(&mut farm, 3).await;
        let plan = farm.plan(&renamed(3)).await;
        assert_eq!((plan.reuse, plan.run), (0, 3));
        let reasons = plan.stages[0].reasons.join("\n");
        assert!(
            reasons.contains("because it is on another machine"),
            "{reasons}"
        );
        let next = farm.submit(&renamed(3)).await.job_id;
        let status = farm.status(&next).await;
        assert_eq!((status.tasks.pending, status.tasks.leased), (3, 0));
        let status = worker.work(&mut farm, &next).await;
        assert_eq!((status.state, status.tasks.done), (JobState::Done, 3));
        farm.stop().await;
    }
}

#[tokio::test]
async fn between_two_manifests_the_store_decides_and_not_who_came_first() {
    for mut farm in Farm::start_on_each().await {
        let job = farm.submit(&spec(1)).await.job_id;
        let mut liar = farm.worker().await;
        farm.stored.close("it is far away");
        let lease = liar.lease().await;
        assert!(liar.report(&lease, 0, &"f".repeat(64)).await.accepted);
        farm.until_ended(&job).await;
        let next = farm.submit(&renamed(1)).await.job_id;
        *farm.stored.closed.lock().unwrap() = None;
        farm.stored.put(0, Some(bytes(7)));
        // An honest worker reports its published result.
        let lease = liar.lease().await;
        assert!(liar.report(&lease, 0, &manifest(7)).await.accepted);
        let status = farm.until_ended(&next).await;
        assert_eq!((status.state, status.tasks.reused), (JobState::Done, 0));
        let events = farm.events(&next, None).await;
        let alarm = events.iter().find(|e| e.kind() == wire::EventKind::Alarm);
        assert!(alarm.unwrap().message.contains("ffff"), "{events:?}");
        // In the reverse case the store contains the recorded result, which stands.
        let mut third = renamed(1);
        third.stages[0].force = true;
        let third = farm.submit(&third).await.job_id;
        let lease = liar.lease().await;
        assert!(!liar.report(&lease, 0, &"e".repeat(64)).await.accepted);
        assert_eq!(farm.until_ended(&third).await.state, JobState::Done);
        farm.stop().await;
    }
}

#[tokio::test]
async fn a_store_that_hangs_holds_up_nobody_else() {
    let mut farm = Farm::start().await;
    let (_, mut worker) = done(&mut farm, 3).await;
    farm.stored.hangs.store(true, Ordering::SeqCst);
    let mut other = farm.jobs.clone();
    let held = tokio::spawn(async move {
        let request = wire::PlanJobRequest {
            spec: Some(renamed(3).into()),
        };
        other
            .plan_job(request)
            .await
            .unwrap()
            .into_inner()
            .plan
            .unwrap()
    });
    // Meanwhile a job in another place is submitted, run and watched.
    let mut elsewhere = spec(4);
    rendering(&mut elsewhere).output.dataset = "elsewhere".into();
    let job = farm.submit(&elsewhere).await.job_id;
    let status = worker.work(&mut farm, &job).await;
    assert_eq!(status.state, JobState::Done);
    assert!(!held.is_finished());
    let plan = held.await.unwrap();
    let reasons = plan.stages[0].reasons.join("\n");
    assert!(reasons.contains("did not answer within"), "{reasons}");
}
