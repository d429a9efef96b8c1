//! Chaos test with two coordinators on one Postgres and six workers behind proxies. A seeded random
//! sequence kills, freezes, disconnects and delays any of them, the database and the store. It also
//! fills the store's disk or makes it read-only, submits scenes with text that the catalog cannot
//! store, and sends invalid messages. At the end, every scene was committed once, the bad jobs have
//! failed with their reason, and the store has exactly the objects of an undisturbed run, bit for
//! bit.
//!
//! The short form runs with all tests. The long one:
//! `PICOFARM_CHAOS=300 tests/run -E 'test(/^chaos::/)'` (rounds).

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

use picofarm_tests::{
    Cli, Cluster, Job, Process, Scratch, Signal, farm::undisturbed, flood, mount::Tmpfs, poison,
    proxy::Mode, rng::Rng, s3, store,
};

/// Short, so that processes frozen for longer soon count as lost.
const LEASE_S: f64 = 3.0;
const WORKERS: usize = 6;

/// Number of rounds of the short form.
const ROUNDS: u64 = 5;
/// Normal size of the store's disk, in MiB.
const DISK_MIB: u64 = 256;

fn rounds() -> u64 {
    std::env::var("PICOFARM_CHAOS").map_or(ROUNDS, |n| {
        n.parse().expect("PICOFARM_CHAOS is a number of rounds")
    })
}

fn millis(rng: &mut Rng, most: u64) -> Duration {
    Duration::from_millis(rng.number() % most)
}

/// The workers of a test, restarted when they are killed.
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

/// Location of the objects.
enum Store {
    Disk(Tmpfs),
    S3(s3::Server),
}

impl Store {
    /// Hides the store: the workers see an empty folder, as if it were not mounted. (A service
    /// becomes unreachable.)
    fn vanish(&mut self, rng: &mut Rng) {
        match self {
            Self::S3(_) => self.strike(rng),
            Self::Disk(disk) => {
                let cover = disk.cover();
                sleep(Duration::from_secs(1) + millis(rng, 3_000));
                drop(cover);
            }
        }
    }

    /// Causes one failure and ends it.
    fn strike(&mut self, rng: &mut Rng) {
        match self {
            Self::S3(server) => {
                server.kill();
                sleep(millis(rng, 2_000));
                server.up();
            }
            Self::Disk(disk) if rng.number().is_multiple_of(2) => {
                disk.fill(8);
                sleep(Duration::from_secs(1) + millis(rng, 3_000));
                disk.widen(DISK_MIB);
            }
            Self::Disk(disk) => {
                disk.forbid_writes();
                sleep(Duration::from_secs(1) + millis(rng, 3_000));
                disk.remount("rw");
            }
        }
    }
}

/// A working cluster, and the failures so far.
struct Site {
    crew: Crew,
    /// Jobs that must fail.
    poisoned: Vec<String>,
    store: Store,
    // A disk is unmounted before its folder is deleted.
    cluster: Cluster,
}

impl Site {
    fn new(cluster: Cluster, store: Store) -> Self {
        Self {
            crew: Crew::new(&cluster),
            poisoned: Vec::new(),
            store,
            cluster,
        }
    }

    /// Causes one failure and ends it.
    fn strike(&mut self, rng: &mut Rng) {
        let cluster = &mut self.cluster;
        let which = (rng.number() % cluster.coordinators.len() as u64) as usize;
        let who = (rng.number() % WORKERS as u64) as usize;
        match rng.number() % 15 {
            0 => {
                let new = self.crew.start(cluster);
                std::mem::replace(&mut self.crew.workers[who], new).kill();
            }
            1 => {
                cluster.kill_coordinator(which);
                sleep(millis(rng, 3_000));
                cluster.start_coordinator(which);
            }
            2 => {
                self.crew.workers[who].signal(Signal::Stop);
                sleep(Duration::from_secs_f64(LEASE_S) + millis(rng, 2_000));
                self.crew.workers[who].signal(Signal::Continue);
            }
            // Long enough that the other coordinator takes over this one's work.
            3 => {
                cluster.coordinator(which).signal(Signal::Stop);
                sleep(Duration::from_secs(4) + millis(rng, 4_000));
                cluster.coordinator(which).signal(Signal::Continue);
            }
            4 => {
                let coordinator = &cluster.coordinators[which];
                coordinator.proxy.set(Mode::Hold);
                sleep(millis(rng, 6_000));
                coordinator.proxy.set(Mode::Pass);
            }
            5 => cluster.coordinators[which].proxy.cut(),
            6 => {
                let coordinator = &cluster.coordinators[which];
                coordinator.proxy.set(Mode::Delay);
                sleep(millis(rng, 3_000));
                coordinator.proxy.set(Mode::Pass);
            }
            7 => cluster.crash_database(),
            8 => {
                // In a folder other than the normal job's data set, so that leftovers are not
                // counted as its objects.
                let place = cluster.scratch.join("elsewhere");
                let number = self.poisoned.len() as u64;
                let job = poison::job(&place, cluster.scratch.path(), number);
                self.poisoned.push(cluster.submit(&job));
            }
            9 => poison::lie(&cluster.coordinators[which].proxy.url()),
            // The store's mount is missing for a while, on every worker's machine.
            10 => self.store.vanish(rng),
            11 => {
                flood::specs(&cluster.coordinators[which].proxy.url());
                assert!(cluster.coordinator(which).runs(), "it survives the flood");
            }
            12 => race_tokens(&cluster.scratch, rng),
            // An allocation with a time limit: the worker ends in order before it is killed.
            13 => {
                let name = format!("short-{}", self.crew.started);
                let seconds = 2 + rng.number() % 6;
                let end_at = format!("{seconds}s");
                let short = cluster.worker_with(&name, which, &["--end-at", &end_at]);
                short.end().ok();
            }
            _ => self.store.strike(rng),
        }
        sleep(millis(rng, 800));
    }

    /// Checks that the bad jobs have failed, with their reason.
    fn assert_poison_told(&self) {
        for id in &self.poisoned {
            let status = self.cluster.until_ended(id);
            assert_eq!(status["state"], "failed", "{status}");
            poison::assert_told(&self.cluster.events(id));
        }
    }
}

/// Creates and revokes tokens concurrently. Each call must have its effect.
fn race_tokens(scratch: &Scratch, rng: &mut Rng) {
    let cli = Cli::new(scratch.path());
    let number = rng.number();
    let file = ["--tokens", "raced.toml"];
    let create = |name: &str| {
        let args = ["token", "create", "--name", name, "--role", "view"];
        cli.start(name, &[&args[..], &file].concat())
    };
    let revoke = |name: &str| cli.start(name, &[&["token", "revoke", name][..], &file].concat());
    let names: Vec<String> = (0..4).map(|i| format!("t{number}-{i}")).collect();
    for name in &names[..2] {
        create(name).end().ok();
    }
    let racing: Vec<_> = names
        .iter()
        .enumerate()
        .map(|(i, name)| if i < 2 { revoke(name) } else { create(name) })
        .collect();
    for process in racing {
        process.end().ok();
    }
    let listed = cli.run(&["token", "list", "--tokens", "raced.toml"]).ok();
    for (i, name) in names.iter().enumerate() {
        let there = listed.stdout.contains(name.as_str());
        assert_eq!(there, i >= 2, "{name}: {}", listed.stdout);
    }
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
    if let Some(cluster) = Cluster::start("chaos", 2, LEASE_S) {
        endure(cluster, "chaos", 5);
    }
}

#[test]
fn with_one_coordinator_on_sqlite_too() {
    endure(
        Cluster::on_sqlite("chaos-sqlite", LEASE_S),
        "chaos-sqlite",
        7,
    );
}

/// Runs the failures on a cluster with its objects on a disk, and compares the store with that of
/// an undisturbed run.
fn endure(cluster: Cluster, name: &str, seed: u64) {
    let Some(disk) = Tmpfs::mount(&cluster.scratch.join("store"), DISK_MIB << 10) else {
        return;
    };
    let mut rng = Rng::new(seed);
    let mut site = Site::new(cluster, Store::Disk(disk));
    // The work must last as long as the failures: each job lasts a few rounds, and all write to one
    // growing data set.
    let jobs = rounds().div_ceil(5);
    let mut job = Job::slow(&site.cluster.scratch.join("store"), 0);
    for n in 1..=jobs {
        job.count = Some(12 * n);
        let id = site.cluster.submit(&job);
        for _ in 0..rounds().div_ceil(jobs) {
            site.strike(&mut rng);
        }
        done_once(&site.cluster, &id, 12 * n);
    }
    site.assert_poison_told();
    site.crew.workers.clear();
    assert_eq!(store::hashes(&job.place()), undisturbed(name, &job));
}

#[test]
fn with_objects_on_s3_too() {
    let Some(server) = s3::Server::start("chaos-s3") else {
        return;
    };
    let Some(cluster) = Cluster::reaching("chaos-s3", 2, LEASE_S, |cli| server.with(cli)) else {
        return;
    };
    let mut rng = Rng::new(6);
    let bucket = server.bucket();
    let mut site = Site::new(cluster, Store::S3(server));
    let job = Job {
        store: format!("s3://{bucket}/farm").into(),
        ..Job::slow(&site.cluster.scratch.join("unused"), 12)
    };
    let id = site.cluster.submit(&job);
    for _ in 0..rounds().div_ceil(2) {
        site.strike(&mut rng);
    }
    done_once(&site.cluster, &id, 12);
    site.assert_poison_told();
    site.crew.workers.clear();
    let Store::S3(server) = &site.store else {
        unreachable!("it is where it was put");
    };
    let there = server.hashes(&bucket, &format!("farm/{}", job.dataset));
    assert_eq!(there, undisturbed("chaos-s3", &job));
}

/// Prints how long an operation took, for `--nocapture`. On a busy machine the time means little.
fn took(what: &str, since: Instant) {
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
    cluster.kill_coordinator(0);
    let killed = Instant::now();
    for worker in &mut workers {
        worker.until_says("reconnected");
    }
    took("all workers at the other coordinator", killed);
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
fn the_lease_of_a_killed_worker_soon_belongs_to_another_although_it_had_long_to_live() {
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
    took("the task of a killed worker at another", killed);
    // A lease lasts ten minutes here, longer than the timeout of any test.
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
    // Only after rendering has started: before, it would look into the store when it wakes, and
    // find the other's result.
    zombie.until_says("scene made");
    zombie.signal(Signal::Stop);
    let _heir = cluster.worker("heir", 1);
    done_once(&cluster, &id, 1);
    zombie.signal(Signal::Continue);
    zombie.until_says("not accepted");
    done_once(&cluster, &id, 1);
    assert_eq!(store::hashes(&job.place()), undisturbed("zombie", &job));
}
