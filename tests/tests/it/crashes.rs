//! `kill -9` of any process, at any instant, any number of times: every scene is committed once,
//! and the store has the objects of an undisturbed run, bit for bit.

use std::{thread::sleep, time::Duration};

use picofarm_tests::{Farm, Job, Process, farm::undisturbed, rng::Rng, store};

/// Short enough that a killed worker's scene is soon assigned to another.
const LEASE_S: f64 = 2.0;
/// Number of kills in each test.
const ROUNDS: u64 = 4;

/// Waits for an instant to kill: while one of `workers` is in a scene, and then some milliseconds
/// later, so that kills hit rendering, encoding, publishing and the report. Returns `false` if the
/// job has ended, on a very fast machine.
fn instant(farm: &Farm, id: &str, workers: &[&str], rng: &mut Rng) -> bool {
    let busy = farm.until_busy(id, workers);
    sleep(Duration::from_millis(rng.number() % 900));
    busy
}

/// Checks that the job is done, each scene was committed once, no scene was fully computed twice,
/// and the objects are those of an undisturbed run.
fn as_if_nothing_had_happened(farm: &Farm, job: &Job, id: &str, name: &str) {
    farm.until_done_once(job, id);
    assert_eq!(farm.count(id, "dead"), 0);
    let ended = farm.logged("task done");
    let total = farm.count(id, "total");
    assert!(
        ended <= total,
        "{ended} renders of {total} scenes came to their end"
    );
    assert_eq!(store::hashes(&job.place()), undisturbed(name, job));
}

#[test]
fn a_worker_killed_in_mid_scene_again_and_again_changes_nothing() {
    let mut rng = Rng::new(1);
    let farm = Farm::with_lease("worker-killed", LEASE_S);
    let job = Job::slow(&farm.store(), 5);
    let id = farm.submit(&job);
    let mut struck = 0;
    for round in 0..ROUNDS {
        let name = format!("worker-{round}");
        let worker = farm.worker(&name);
        struck += u32::from(instant(&farm, &id, &[&name], &mut rng));
        worker.kill();
    }
    assert!(struck >= 2, "the job is too short for this machine");
    let _last = farm.worker("last");
    as_if_nothing_had_happened(&farm, &job, &id, "worker-killed");
}

#[test]
fn a_coordinator_killed_in_mid_job_again_and_again_changes_nothing() {
    let mut rng = Rng::new(2);
    let mut farm = Farm::with_lease("coordinator-killed", LEASE_S);
    let job = Job::slow(&farm.store(), 6);
    let id = farm.submit(&job);
    let mut worker = farm.worker("steady");
    let mut struck = 0;
    for _ in 0..ROUNDS {
        struck += u32::from(instant(&farm, &id, &["steady"], &mut rng));
        farm.kill_coordinator();
        sleep(Duration::from_millis(rng.number() % 1000));
        farm.start_coordinator();
    }
    assert!(struck >= 2, "the job is too short for this machine");
    farm.until_ended(&id);
    assert!(
        worker.runs(),
        "a worker outlives its coordinator: {}",
        worker.stderr()
    );
    as_if_nothing_had_happened(&farm, &job, &id, "coordinator-killed");
}

#[test]
fn everything_killed_at_once_again_and_again_changes_nothing() {
    let mut rng = Rng::new(3);
    let mut farm = Farm::with_lease("all-killed", LEASE_S);
    let job = Job::slow(&farm.store(), 5);
    let id = farm.submit(&job);
    let mut struck = 0;
    for round in 0..ROUNDS {
        let names = [format!("left-{round}"), format!("right-{round}")];
        let workers = names.each_ref().map(|name| farm.worker(name));
        struck += u32::from(instant(
            &farm,
            &id,
            &names.each_ref().map(|n| &**n),
            &mut rng,
        ));
        if rng.unit() < 0.5 {
            farm.kill_coordinator();
            workers.into_iter().for_each(Process::kill);
        } else {
            workers.into_iter().for_each(Process::kill);
            farm.kill_coordinator();
        }
        farm.start_coordinator();
    }
    assert!(struck >= 2, "the job is too short for this machine");
    let _last = farm.worker("last");
    as_if_nothing_had_happened(&farm, &job, &id, "all-killed");
}
