//! Workers as Slurm job arrays, on a real cluster on this machine: Slurm's interventions cost no
//! scene and cause no failure.

use picofarm_tests::{Farm, Job, Slurm, store, wait::until};

/// Returns a job with scenes that are long enough that a worker asked to end is not about to finish
/// one anyway.
fn job(farm: &Farm, count: u64) -> Job {
    let job = Job::slow(&farm.store(), count);
    Job {
        samples: 3 * job.samples,
        ..job
    }
}

/// Checks that this worker handed scenes back and that no failure was counted for them.
fn given_back(farm: &Farm, id: &str, worker: &str) {
    let released = farm.events_of(id, "released");
    assert!(
        released.iter().any(|e| e["worker"] == worker),
        "{worker} gave nothing back: {released:?}"
    );
    for kind in ["failed", "expired", "dead"] {
        let events = farm.events_of(id, kind);
        assert!(events.is_empty(), "leaving is no {kind}: {events:?}");
    }
}

#[test]
fn a_cancelled_element_hands_its_scenes_to_the_others() {
    let farm = Farm::start("slurm-cancel");
    let Some(slurm) = Slurm::start(&farm, 2) else {
        return;
    };
    let job = job(&farm, 3);
    let id = farm.submit(&job);
    let array = slurm.workers(&farm, "0-1");
    let [stays, leaves] = [format!("{array}_0"), format!("{array}_1")];
    for element in [&stays, &leaves] {
        slurm.until_said(element, "task starts", 1);
    }
    slurm.run("scancel", &[&leaves]);
    slurm.until_said(&leaves, "worker ends", 1);
    farm.until_done_once(&job, &id);
    given_back(&farm, &id, &format!("n2-{leaves}"));
    for committed in farm.events_of(&id, "committed") {
        assert_eq!(committed["worker"], format!("n1-{stays}"), "{committed}");
    }
}

#[test]
fn a_requeued_element_comes_back_as_another_incarnation_and_finishes() {
    let farm = Farm::start("slurm-requeue");
    let Some(slurm) = Slurm::start(&farm, 1) else {
        return;
    };
    let job = job(&farm, 2);
    let id = farm.submit(&job);
    let element = format!("{}_0", slurm.workers(&farm, "0"));
    slurm.until_said(&element, "task starts", 1);
    slurm.run("scontrol", &["requeue", &element]);
    slurm.until_said(&element, "worker ends", 1);
    slurm.start_again(&element);
    farm.until_done_once(&job, &id);
    given_back(&farm, &id, &format!("n1-{element}"));
    for committed in farm.events_of(&id, "committed") {
        assert_eq!(
            committed["worker"],
            format!("n1-{element}.r1"),
            "{committed}"
        );
    }
    assert_eq!(slurm.log(&element).matches("worker starts").count(), 2);
}

#[test]
fn a_worker_that_outlives_its_lost_node_cannot_spoil_what_the_requeued_one_did() {
    let farm = Farm::with_lease("slurm-lost", 2.0);
    let Some(slurm) = Slurm::start(&farm, 2) else {
        return;
    };
    let job = job(&farm, 1);
    let id = farm.submit(&job);
    let element = format!("{}_0", slurm.workers(&farm, "0"));
    slurm.until_said(&element, "task starts", 1);
    // A switch failed: both Slurm and the coordinator have lost the node, and nobody ends the
    // worker.
    slurm.lose_node("n1");
    slurm.signal("n1", "STOP");
    slurm.start_again(&element);
    farm.until_done_once(&job, &id);
    let committed = farm.events_of(&id, "committed");
    assert_eq!(committed[0]["worker"], format!("n2-{element}.r1"));
    let (hashes, times) = (store::hashes(&job.place()), store::times(&job.place()));

    slurm.signal("n1", "CONT");
    // Both write the same log: the second end of a task is the old worker's.
    until("the old worker's scene to be over", || {
        let log = slurm.log(&element);
        let ends = ["task done", "task adopted", "task stopped"];
        let over: usize = ends.iter().map(|end| log.matches(end).count()).sum();
        (over == 2).then_some(())
    });
    farm.committed_once(&id, 1);
    assert_eq!(store::hashes(&job.place()), hashes);
    assert_eq!(
        store::times(&job.place()),
        times,
        "an object was written again"
    );
}
