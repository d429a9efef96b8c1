//! A full disk and a read-only store: the job waits, says why, loses nothing, and goes on when there is room.

use std::time::SystemTime;

use picofarm_tests::{Farm, Job, Process, mount::Tmpfs, store};

/// A farm with a worker and a finished job of two scenes in a small file system.
struct Half {
    worker: Process,
    job: Job,
    times: std::collections::BTreeMap<String, SystemTime>,
    disk: Tmpfs,
    farm: Farm,
}

impl Half {
    /// `None` where nothing can be mounted.
    fn done(name: &str) -> Option<Self> {
        let farm = Farm::start(name);
        let disk = Tmpfs::mount(&farm.store(), 64 << 10)?;
        let job = Job::quick(&farm.store(), 2);
        let worker = farm.worker("worker");
        let id = farm.submit(&job);
        farm.until_done_once(&job, &id);
        let times = store::times(&job.place());
        Some(Self {
            worker,
            job,
            times,
            disk,
            farm,
        })
    }

    /// Asks for five scenes, waits until the worker says `words`, mends the disk with `options`, and checks that
    /// the job completes with the first two scenes untouched and no failure counted.
    fn grow_through(mut self, words: &str, options: &str) {
        let (farm, job) = (
            &self.farm,
            Job {
                count: Some(5),
                ..self.job
            },
        );
        let id = farm.submit(&job);
        self.worker.until_says(words);
        let status = farm.status(&id);
        assert_eq!(status["state"], "active", "{status}");
        assert_eq!(status["tasks"]["dead"], 0, "{status}");

        self.disk.remount(options);
        farm.until_done_once(&job, &id);
        assert_eq!(farm.count(&id, "reused"), 2);
        assert!(
            farm.events_of(&id, "failed")
                .iter()
                .all(|e| { e["message"].as_str().is_some_and(|m| m.contains(words)) })
        );
        let times = store::times(&job.place());
        for scene in [0, 1] {
            for key in store::objects(&job.place(), scene) {
                assert_eq!(times[&key], self.times[&key], "{key} was written again");
            }
        }
    }
}

#[test]
fn a_full_disk_stops_no_process_and_loses_nothing() {
    let Some(half) = Half::done("disk-full") else {
        return;
    };
    let room = half.disk.used_kib() + 8;
    half.disk.remount(&format!("size={room}k"));
    half.grow_through("full", "size=64m");
}

#[test]
fn a_read_only_store_stops_no_process_and_loses_nothing() {
    let Some(half) = Half::done("read-only") else {
        return;
    };
    half.disk.remount("ro");
    half.grow_through("read-only", "rw");
}

#[test]
fn a_render_onto_a_full_disk_says_so_and_leaves_nothing() {
    let farm = Farm::start("render-full");
    let Some(disk) = Tmpfs::mount(&farm.store(), 64) else {
        return;
    };
    let generate = [
        "scene",
        "generate",
        "--kind",
        "primitive",
        "--resolution",
        "32",
        "--out",
        "room.glb",
    ];
    farm.run(&generate).ok();
    let out = farm.store().join("out").display().to_string();
    farm.run(&[
        "scene",
        "render",
        "room.glb",
        "--samples",
        "2",
        "--out",
        &out,
    ])
    .fails(7, &["full"]);
    assert!(disk.used_kib() < 16, "half a result was left behind");
}
