//! Two coordinators on one Postgres, six workers behind proxies, and a seeded hand that kills, freezes, cuts off and
//! delays any of them, the database and the store too. At the end every scene was committed once, and the store holds
//! the objects of an undisturbed run, bit for bit, and no others.
//!
//! The short form runs with all tests. The long one: `PICOFARM_CHAOS=300 tests/run -E 'binary(chaos)'` (rounds).

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

use picofarm_tests::{
    Cluster, Job, Process, Signal, farm::undisturbed, proxy::Mode, rng::Rng, s3, store,
};

/// Short, so that what is frozen for longer is soon lost.
const LEASE_S: f64 = 3.0;
const WORKERS: usize = 6;

/// Rounds of the short form.
const ROUNDS: u64 = 10;

fn rounds() -> u64 {
    std::env::var("PICOFARM_CHAOS").map_or(ROUNDS, |n| {
        n.parse().expect("PICOFARM_CHAOS is a number of rounds")
    })
}

fn millis(rng: &mut Rng, most: u64) -> Duration {
    Duration::from_millis(rng.number() % most)
}

/// The workers of a test, started again when they are killed.
struct Crew {
    workers: Vec<Process>,
    started: usize,
}

impl Crew {
    fn new(cluster: &Cluster) -> Self {
        let mut crew = Self {
            workers: Vec::new(),
            started: 0,
        };
        for _ in 0..WORKERS {
            let worker = crew.start(cluster);
            crew.workers.push(worker);
        }
        crew
    }

    fn start(&mut self, cluster: &Cluster) -> Process {
        self.started += 1;
        cluster.worker(&format!("worker-{}", self.started), self.started)
    }
}

/// One misfortune, and its end.
fn strike(cluster: &mut Cluster, crew: &mut Crew, server: Option<&mut s3::Server>, rng: &mut Rng) {
    let which = (rng.number() % cluster.houses.len() as u64) as usize;
    let who = (rng.number() % WORKERS as u64) as usize;
    let kinds = if server.is_some() { 9 } else { 8 };
    match rng.number() % kinds {
        0 => {
            let new = crew.start(cluster);
            std::mem::replace(&mut crew.workers[who], new).kill();
        }
        1 => {
            cluster.kill_house(which);
            sleep(millis(rng, 3_000));
            cluster.start_house(which);
        }
        2 => {
            crew.workers[who].signal(Signal::Stop);
            sleep(Duration::from_secs_f64(LEASE_S) + millis(rng, 2_000));
            crew.workers[who].signal(Signal::Continue);
        }
        // Long enough that the other coordinator takes over what this one had.
        3 => {
            cluster.house(which).signal(Signal::Stop);
            sleep(Duration::from_secs(4) + millis(rng, 4_000));
            cluster.house(which).signal(Signal::Continue);
        }
        4 => {
            let house = &cluster.houses[which];
            house.proxy.set(Mode::Hold);
            sleep(millis(rng, 6_000));
            house.proxy.set(Mode::Pass);
        }
        5 => cluster.houses[which].proxy.cut(),
        6 => {
            let house = &cluster.houses[which];
            house.proxy.set(Mode::Delay);
            sleep(millis(rng, 3_000));
            house.proxy.set(Mode::Pass);
        }
        7 => cluster.postgres.crash(),
        _ => {
            let server = server.expect("counted in only where there is one");
            server.kill();
            sleep(millis(rng, 2_000));
            server.up();
        }
    }
    sleep(millis(rng, 800));
}

fn done_once(cluster: &Cluster, id: &str, total: u64) {
    let status = cluster.until_ended(id);
    assert_eq!(status["state"], "done", "{status}");
    assert_eq!(status["tasks"]["done"], total, "{status}");
    let mut times = vec![0; total as usize];
    for event in cluster.events(id) {
        assert_ne!(event["kind"], "alarm", "{event}");
        if event["kind"] == "committed" || event["kind"] == "reused" {
            let (lo, hi) = (event["lo"].as_u64(), event["hi"].as_u64());
            for task in lo.expect("tasks are named")..hi.expect("tasks are named") {
                times[task as usize] += 1;
            }
        }
    }
    assert!(
        times.iter().all(|n| *n == 1),
        "committed once each: {times:?}"
    );
}

#[test]
fn whatever_fails_every_scene_is_committed_once_and_the_store_is_as_if_nothing_had() {
    let Some(mut cluster) = Cluster::start("chaos", 2, LEASE_S) else {
        return;
    };
    let mut rng = Rng::new(5);
    let mut crew = Crew::new(&cluster);
    // The work lasts as long as the misfortunes: a job a few rounds, all into one data set that grows.
    let jobs = rounds().div_ceil(5);
    let mut job = Job::slow(&cluster.scratch.join("store"), 0);
    for n in 1..=jobs {
        job.count = Some(12 * n);
        let id = cluster.submit(&job);
        for _ in 0..rounds().div_ceil(jobs) {
            strike(&mut cluster, &mut crew, None, &mut rng);
        }
        done_once(&cluster, &id, 12 * n);
    }
    drop(crew);
    assert_eq!(store::hashes(&job.place()), undisturbed("chaos", &job));
}

#[test]
fn with_objects_on_s3_too() {
    let Some(mut server) = s3::Server::start("chaos-s3") else {
        return;
    };
    let Some(mut cluster) = Cluster::reaching("chaos-s3", 2, LEASE_S, |cli| server.with(cli))
    else {
        return;
    };
    let mut rng = Rng::new(6);
    let mut crew = Crew::new(&cluster);
    let bucket = server.bucket();
    let job = Job {
        store: format!("s3://{bucket}/farm").into(),
        ..Job::slow(&cluster.scratch.join("unused"), 12)
    };
    let id = cluster.submit(&job);
    for _ in 0..rounds().div_ceil(2) {
        strike(&mut cluster, &mut crew, Some(&mut server), &mut rng);
    }
    done_once(&cluster, &id, 12);
    drop(crew);
    let there = server.hashes(&bucket, &format!("farm/{}", job.dataset));
    assert_eq!(there, undisturbed("chaos-s3", &job));
}

/// How long something took, for people: `--nocapture` shows it. On a busy machine it means little.
fn told(what: &str, since: Instant) {
    eprintln!("{what}: {:.2} s", since.elapsed().as_secs_f64());
}

#[test]
fn workers_of_a_killed_coordinator_go_on_under_the_other_and_no_task_restarts() {
    let Some(mut cluster) = Cluster::start("failover", 2, 60.0) else {
        return;
    };
    let job = Job::slow(&cluster.scratch.join("store"), 8);
    let id = cluster.submit(&job);
    let mut workers: Vec<_> = (0..2)
        .map(|i| cluster.worker(&format!("w{i}"), 0))
        .collect();
    for worker in &mut workers {
        worker.until_says("task starts");
    }
    cluster.kill_house(0);
    let killed = Instant::now();
    for worker in &mut workers {
        worker.until_says("reconnected");
    }
    told("all workers at the other coordinator", killed);
    done_once(&cluster, &id, 8);
    let started: usize = workers
        .iter()
        .map(|w| w.stderr().matches("task starts").count())
        .sum();
    assert_eq!(started, 8, "no task was started twice");
    let kinds = cluster.events(&id);
    let lost = |kind: &str| kinds.iter().filter(|e| e["kind"] == kind).count();
    assert_eq!((lost("expired"), lost("failed")), (0, 0));
}

#[test]
fn the_lease_of_a_killed_worker_is_soon_anothers_although_it_had_long_to_live() {
    let Some(cluster) = Cluster::start("lost-worker", 1, 600.0) else {
        return;
    };
    let job = Job::slow(&cluster.scratch.join("store"), 1);
    let id = cluster.submit(&job);
    let mut worker = cluster.worker("victim", 0);
    worker.until_says("task starts");
    let mut heir = cluster.worker("heir", 0);
    worker.kill();
    let killed = Instant::now();
    heir.until_says("task starts");
    told("the task of a killed worker at another", killed);
    // A lease lives for ten minutes here, longer than the patience of any test.
    done_once(&cluster, &id, 1);
    assert!(heir.stderr().contains("task done"), "{}", heir.stderr());
}

#[test]
fn a_frozen_workers_late_report_is_refused_and_its_objects_are_those_of_the_other() {
    let Some(cluster) = Cluster::start("zombie", 2, LEASE_S) else {
        return;
    };
    let job = Job::slow(&cluster.scratch.join("store"), 1);
    let id = cluster.submit(&job);
    let mut zombie = cluster.worker("zombie", 0);
    zombie.until_says("task starts");
    zombie.signal(Signal::Stop);
    let _heir = cluster.worker("heir", 1);
    done_once(&cluster, &id, 1);
    zombie.signal(Signal::Continue);
    zombie.until_says("not accepted");
    done_once(&cluster, &id, 1);
    assert_eq!(store::hashes(&job.place()), undisturbed("zombie", &job));
}
