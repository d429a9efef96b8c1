//! Chaos test with one coordinator on SQLite and three workers. The catalog and the store are on
//! small disks of their own. A seeded random sequence fills either disk, makes the store read-only,
//! moves the catalog away, submits scenes with text that the catalog cannot store, sends invalid
//! messages, and kills and freezes processes. At the end, every scene was committed once, the bad
//! jobs have failed with their reason, and the store has exactly the objects of an undisturbed run,
//! bit for bit.
//!
//! The short form runs with all tests. The long one:
//! `PICOFARM_CHAOS=100 tests/run -E 'test(/^chaos_disks::/)'` (rounds).

use std::{fs, path::PathBuf, thread::sleep, time::Duration};

use picofarm_tests::{
    Farm, Job, Process, Scratch, Signal, farm::undisturbed, mount::Tmpfs, poison, rng::Rng, store,
    wait::until,
};

/// Short, so that processes frozen for longer soon count as lost.
const LEASE_S: f64 = 3.0;
const WORKERS: usize = 3;
/// Number of rounds of the short form: each kind of failure once.
const ROUNDS: u64 = KINDS;
const KINDS: u64 = 9;
/// Number of rounds per job.
const ROUNDS_A_JOB: u64 = 5;
/// Normal size of each disk, in MiB.
const DISK_MIB: u64 = 64;

fn rounds() -> u64 {
    std::env::var("PICOFARM_CHAOS").map_or(ROUNDS, |n| {
        n.parse().expect("PICOFARM_CHAOS is a number of rounds")
    })
}

/// A farm on two small disks.
struct Site {
    workers: Vec<Process>,
    started: usize,
    /// Jobs that must fail.
    poisoned: Vec<String>,
    catalog: Tmpfs,
    store: Tmpfs,
    // The disks are unmounted before its folder is deleted.
    farm: Farm,
}

impl Site {
    /// Returns `None` if nothing can be mounted.
    fn start() -> Option<Self> {
        let scratch = Scratch::new("chaos-disks");
        let catalog = Tmpfs::mount(&scratch.join("catalog"), DISK_MIB << 10)?;
        let store = Tmpfs::mount(&scratch.join("store"), DISK_MIB << 10)?;
        let mut site = Self {
            workers: Vec::new(),
            started: 0,
            poisoned: Vec::new(),
            catalog,
            store,
            farm: Farm::on(scratch, "catalog/catalog.sqlite", LEASE_S),
        };
        for _ in 0..WORKERS {
            let worker = site.worker();
            site.workers.push(worker);
        }
        Some(site)
    }

    fn worker(&mut self) -> Process {
        self.started += 1;
        self.farm.worker(&format!("worker-{}", self.started))
    }

    fn submit(&self, job: &Job) -> String {
        let file = self.farm.scratch.join(&format!("{}.toml", job.name));
        job.write(&file);
        let answer = self
            .farm
            .patiently(&["job", "submit", &file.display().to_string()]);
        answer["job"]
            .as_str()
            .expect("a submission answers with a job")
            .to_owned()
    }

    fn poison(&mut self) {
        let folder = self.farm.scratch.path();
        let job = poison::job(&self.farm.store(), folder, self.poisoned.len() as u64);
        let id = self.submit(&job);
        self.poisoned.push(id);
    }

    /// Moves the catalog's file away for a while. A coordinator may end because of this, with a
    /// reason, and is then restarted.
    fn without_catalog(&mut self, how_long: Duration) {
        let path = |name: &str| -> PathBuf { self.farm.scratch.join("catalog").join(name) };
        let (here, away) = (path("catalog.sqlite"), path("elsewhere.sqlite"));
        fs::rename(&here, &away).expect("the catalog is there");
        sleep(how_long);
        assert!(
            !here.exists(),
            "a coordinator made a new catalog where its own was"
        );
        fs::rename(&away, &here).expect("the catalog is there");
        // A coordinator that has noticed ends within a moment, if it ends at all.
        sleep(Duration::from_secs(1));
        if !self.farm.coordinator().runs() {
            let says = self.farm.coordinator().stderr();
            assert!(
                says.contains("catalog"),
                "it ended without its reason: {says}"
            );
            self.farm.start_coordinator();
        }
    }

    /// Causes one failure and ends it.
    fn strike(&mut self, kind: u64, rng: &mut Rng) {
        let who = (rng.number() % WORKERS as u64) as usize;
        let mut millis = |most: u64| Duration::from_millis(rng.number() % most);
        match kind {
            0 => {
                let new = self.worker();
                std::mem::replace(&mut self.workers[who], new).kill();
            }
            1 => {
                self.farm.kill_coordinator();
                sleep(millis(2_000));
                self.farm.start_coordinator();
            }
            2 => {
                self.workers[who].signal(Signal::Stop);
                sleep(Duration::from_secs_f64(LEASE_S) + millis(2_000));
                self.workers[who].signal(Signal::Continue);
            }
            3 => {
                self.catalog.fill(4);
                sleep(Duration::from_secs(1) + millis(3_000));
                self.catalog.widen(DISK_MIB);
            }
            4 => {
                self.store.fill(8);
                sleep(Duration::from_secs(1) + millis(3_000));
                self.store.widen(DISK_MIB);
            }
            5 => {
                self.store.forbid_writes();
                sleep(Duration::from_secs(1) + millis(3_000));
                self.store.remount("rw");
            }
            6 => {
                let how_long = Duration::from_secs(1) + millis(3_000);
                self.without_catalog(how_long);
            }
            7 => self.poison(),
            _ => poison::lie(self.farm.url()),
        }
        sleep(millis(800));
    }

    fn ended(&self, id: &str) -> serde_json::Value {
        until(&format!("the end of job {id}"), || {
            let status = self.farm.patiently(&["job", "status", id]);
            (status["state"] != "active").then_some(status)
        })
    }
}

#[test]
fn full_disks_a_lost_catalog_and_poison_change_nothing_for_honest_jobs() {
    let Some(mut site) = Site::start() else {
        return;
    };
    let mut rng = Rng::new(16);
    let jobs = rounds().div_ceil(ROUNDS_A_JOB);
    let mut job = Job::slow(&site.farm.store(), 0);
    for n in 1..=jobs {
        job.count = Some(6 * n);
        let id = site.submit(&job);
        for round in (n - 1) * ROUNDS_A_JOB..(n * ROUNDS_A_JOB).min(rounds()) {
            // Each kind in turn, so that the short form covers them all.
            site.strike(round % KINDS, &mut rng);
        }
        let status = site.ended(&id);
        assert_eq!(status["state"], "done", "{status}");
        site.farm.until_done_once(&job, &id);
        assert_eq!(status["tasks"]["dead"], 0, "{status}");
    }
    for id in &site.poisoned {
        let status = site.ended(id);
        assert_eq!(status["state"], "failed", "{status}");
        poison::assert_told(&site.farm.events(id));
    }
    site.workers.clear();
    let store = store::hashes(&job.place());
    assert_eq!(store, undisturbed("chaos-disks", &job));
}
