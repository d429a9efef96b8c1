//! Workers that leave in order, and workers that return after their lease has expired.

use picofarm_tests::{Farm, Job, Signal, store, wait::until};
use serde_json::Value;

#[test]
fn a_worker_told_to_end_hands_its_scene_to_another_at_once() {
    // The lease lasts minutes, so only handing it back lets another worker have the scene during
    // this test.
    let farm = Farm::start("handed-back");
    let job = Job::slow(&farm.store(), 1);
    let job = Job {
        samples: 3 * job.samples,
        ..job
    };
    let id = farm.submit(&job);
    let mut leaver = farm.worker("leaver");
    leaver.until_says("task starts");
    let _heir = farm.worker("heir");
    until("both workers", || {
        (farm.status(&id)["workers"] == 2).then_some(())
    });
    leaver.signal(Signal::Terminate);
    leaver.end().ok();
    farm.until_done_once(&job, &id);
    let kinds: Vec<Value> = farm
        .events(&id)
        .into_iter()
        .map(|e| e["kind"].clone())
        .collect();
    for kind in ["failed", "expired", "dead"] {
        assert!(
            !kinds.contains(&kind.into()),
            "leaving is no {kind}: {kinds:?}"
        );
    }
    let committed = &farm.events_of(&id, "committed")[0];
    assert_eq!(committed["worker"], "heir", "{committed}");
}

#[test]
fn a_worker_that_wakes_up_after_its_lease_doubles_and_overwrites_nothing() {
    let farm = Farm::with_lease("zombie", 2.0);
    let job = Job::slow(&farm.store(), 1);
    let job = Job {
        samples: 3 * job.samples,
        ..job
    };
    let id = farm.submit(&job);
    let mut zombie = farm.worker("zombie");
    assert!(farm.until_busy(&id, &["zombie"]));
    zombie.signal(Signal::Stop);
    until("the lease to expire", || {
        (!farm.events_of(&id, "expired").is_empty()).then_some(())
    });
    let mut heir = farm.worker("heir");
    farm.until_done_once(&job, &id);
    let (hashes, times) = (store::hashes(&job.place()), store::times(&job.place()));
    let history = farm.events(&id);

    heir.signal(Signal::Terminate);
    heir.end().ok();
    zombie.signal(Signal::Continue);
    // It works on its old scene to the end, because it cannot know. Then it must take new work,
    // which shows that it has finished the old scene.
    let after = Job {
        name: "after".into(),
        dataset: "after".into(),
        ..Job::quick(&farm.store(), 1)
    };
    let after_id = farm.submit(&after);
    farm.until_done_once(&after, &after_id);
    assert_eq!(
        farm.events_of(&after_id, "committed")[0]["worker"],
        "zombie"
    );

    assert_eq!(store::hashes(&job.place()), hashes);
    assert_eq!(
        store::times(&job.place()),
        times,
        "an object was written again"
    );
    farm.committed_once(&id, 1);
    assert_eq!(farm.events(&id), history, "a zombie's words change nothing");
    zombie.signal(Signal::Terminate);
    zombie.end().ok();
}
