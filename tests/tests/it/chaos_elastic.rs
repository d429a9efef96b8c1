//! Chaos on a farm whose workers come and go. A seeded random sequence kills allocations,
//! coordinator and `autoalloc`, closes the queue, and ends allocations in order. At the end, every
//! scene was committed once, the store has exactly the objects of an undisturbed run, and no
//! allocation is left.
//!
//! The long form: `PICOFARM_CHAOS=100 tests/run -E 'test(/^chaos_elastic::/)'` (rounds).

use std::{
    thread::sleep,
    time::{Duration, Instant},
};

use picofarm_tests::{
    Batch, Farm, Job, Process, batch::POOL, farm::undisturbed, rng::Rng, store, wait::until,
};

/// Short, so that the tasks of killed workers soon go to others.
const LEASE_S: f64 = 3.0;
const ROUNDS: u64 = 6;

fn rounds() -> u64 {
    std::env::var("PICOFARM_CHAOS").map_or(ROUNDS, |n| {
        n.parse().expect("PICOFARM_CHAOS is a number of rounds")
    })
}

fn millis(rng: &mut Rng, most: u64) -> Duration {
    Duration::from_millis(rng.number() % most)
}

struct Site {
    pool: Option<Process>,
    batch: Batch,
    farm: Farm,
}

impl Site {
    fn new() -> Self {
        let farm = Farm::with_lease("chaos-elastic", LEASE_S);
        let batch = Batch::new(&farm, 8);
        let mut site = Self {
            pool: None,
            batch,
            farm,
        };
        site.start_pool();
        site
    }

    fn start_pool(&mut self) {
        let args = self.batch.args(&POOL);
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        self.pool = Some(self.farm.cli().start("autoalloc", &args));
    }

    /// Sends a signal to one of the running allocations.
    fn signal_one(&self, rng: &mut Rng, signal: &str) -> &'static str {
        let running = self.batch.running();
        if running.is_empty() {
            return "no allocation runs";
        }
        let which = rng.number() as usize % running.len();
        self.batch.signal(&running[which], signal);
        match signal {
            "KILL" => "an allocation is killed",
            _ => "an allocation is ended in order",
        }
    }

    /// Causes one failure and ends it. Returns what it was.
    fn strike(&mut self, rng: &mut Rng) -> &'static str {
        match rng.number() % 7 {
            0..=2 => self.signal_one(rng, "KILL"),
            3 => {
                self.farm.kill_coordinator();
                sleep(millis(rng, 3_000));
                self.farm.start_coordinator();
                "the coordinator is killed"
            }
            4 => {
                self.pool.take().expect("it runs").kill();
                sleep(millis(rng, 3_000));
                self.start_pool();
                "autoalloc is killed"
            }
            5 => {
                self.batch.write("closed", "");
                sleep(millis(rng, 3_000));
                self.batch.delete("closed");
                "the queue is closed"
            }
            _ => self.signal_one(rng, "TERM"),
        }
    }

    /// Waits until the job is done, and checks that each scene was committed once.
    fn done_once(&self, id: &str, total: u64) {
        let status = self.farm.until_ended(id);
        assert_eq!(status["state"], "done", "{status}");
        let mut times = vec![0; total as usize];
        for event in self.farm.events(id) {
            assert_ne!(event["kind"], "alarm", "{event}");
            if event["kind"] == "committed" || event["kind"] == "reused" {
                let (lo, hi) = (event["lo"].as_u64(), event["hi"].as_u64());
                for task in lo.expect("tasks are named")..hi.expect("tasks are named") {
                    times[task as usize] += 1;
                }
            }
        }
        assert!(times.iter().all(|n| *n == 1), "committed once: {times:?}");
    }
}

#[test]
fn whatever_allocations_meet_every_scene_is_committed_once_and_none_is_orphaned() {
    let mut rng = Rng::new(9);
    let mut site = Site::new();
    let mut job = Job::slow(&site.farm.store(), 0);
    let jobs = rounds().div_ceil(5);
    for n in 1..=jobs {
        job.count = Some(10 * n);
        let id = site.farm.submit(&job);
        for _ in 0..rounds().div_ceil(jobs) {
            let begun = Instant::now();
            let what = site.strike(&mut rng);
            eprintln!("{what}, {:.1} s", begun.elapsed().as_secs_f64());
            sleep(Duration::from_millis(500) + millis(&mut rng, 1_500));
        }
        site.done_once(&id, 10 * n);
    }
    until("the last allocation to end", || {
        site.batch.list().is_empty().then_some(())
    });
    until("the last process of an allocation to end", || {
        site.batch.orphans().is_empty().then_some(())
    });
    assert!(site.pool.as_mut().is_some_and(Process::runs));
    assert_eq!(
        store::hashes(&job.place()),
        undisturbed("chaos-elastic", &job)
    );
}
