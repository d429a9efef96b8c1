//! A full disk and a read-only store: the job waits, reports why, loses nothing, and continues when
//! there is room.

use std::{path::Path, time::SystemTime};

use picofarm_tests::{Cli, Farm, Job, Process, Scratch, mount::Tmpfs, store, wait::until};

/// A farm with a worker and a finished job of two scenes in a small file system.
struct Half {
    worker: Process,
    job: Job,
    times: std::collections::BTreeMap<String, SystemTime>,
    disk: Tmpfs,
    farm: Farm,
}

impl Half {
    /// Returns `None` if nothing can be mounted.
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

    /// Submits a job for five scenes, waits until the worker logs `words`, repairs the disk with
    /// `options`, and checks that the job completes with the first two scenes untouched and no
    /// failure counted.
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
    half.disk.fill(8);
    half.grow_through("full", "size=64m");
}

#[test]
fn a_read_only_store_stops_no_process_and_loses_nothing() {
    let Some(half) = Half::done("read-only") else {
        return;
    };
    half.disk.forbid_writes();
    half.grow_through("read-only", "rw");
}

#[test]
fn a_job_whose_store_cannot_be_written_leaves_the_only_worker_to_others_and_ends_when_it_can() {
    let farm = Farm::start("store-away");
    // A file where a folder is expected: not even root can write below it.
    let blocked = farm.scratch.join("blocked");
    std::fs::write(&blocked, "").unwrap();
    let waiting = Job::quick(&blocked.join("store"), 40);
    waiting.write(&farm.scratch.join("waiting.toml"));
    let said = farm.run(&["job", "plan", "waiting.toml"]).ok();
    assert!(
        said.stderr.contains("cannot be written to") && said.stderr.contains("blocked"),
        "{}",
        said.stderr
    );
    let first = farm.submit(&waiting);
    let _worker = farm.worker("only");
    let explained = || farm.run(&["job", "explain", &first]).ok().stdout;
    until("the job says that it waits", || {
        let text = explained();
        (text.contains("waits for store") && text.contains("next try in")).then_some(())
    });

    let other = Job::quick(&farm.store(), 3);
    let second = farm.submit(&other);
    farm.until_done_once(&other, &second);
    let status = farm.status(&first);
    assert_eq!(status["state"], "active", "{status}");
    assert_eq!(status["tasks"]["dead"], 0, "{status}");
    // One task probes the store at intervals, not every task.
    let tries = farm.events_of(&first, "released").len();
    assert!(tries < 15, "{tries} tries");

    std::fs::remove_file(&blocked).unwrap();
    std::fs::create_dir(&blocked).unwrap();
    farm.until_done_once(&waiting, &first);
}

/// Starts a worker that sees another folder at the store's path. Returns `None` if nothing can be
/// mounted.
fn unmounted(farm: &Farm, instead: &Path) -> Option<Process> {
    let (store, instead) = (farm.store(), instead.display().to_string());
    let script = "mount --bind \"$0\" \"$1\" && shift && exec \"$@\"";
    let store = store.display().to_string();
    let args = ["-m", "sh", "-c", script, &instead, &store];
    let unshare = |run: &[&str]| {
        farm.cli()
            .other("unshare".as_ref(), &[&args[..], run].concat())
    };
    let tried = unshare(&["true"]).output();
    if !tried.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: a folder cannot be mounted for one process alone here");
        return None;
    }
    let program = picofarm_tests::binary::picofarm().display().to_string();
    let worker = ["worker", "--log", "info", "--name", "unmounted"];
    let more = ["--threads", "1", "--coordinator", farm.url()];
    let run = [&[&*program], &worker[..], &more].concat();
    Some(Process::start(
        "unmounted",
        unshare(&run),
        farm.scratch.path(),
    ))
}

#[test]
fn a_worker_whose_store_is_not_mounted_gives_no_scene_and_stops_no_other() {
    let farm = Farm::start("unmounted");
    let job = Job::quick(&farm.store(), 6);
    let id = farm.submit(&job);
    let empty = farm.scratch.join("empty");
    std::fs::create_dir(&empty).unwrap();
    let words = "has no store identity; expected";
    if let Some(mut without) = unmounted(&farm, &empty) {
        without.until_says(words);
        assert_eq!(farm.count(&id, "done"), 0);
        let with = farm.worker("mounted");
        farm.until_done_once(&job, &id);
        let committed = farm.events_of(&id, "committed");
        assert!(committed.iter().all(|e| e["worker"] == "mounted"));
        assert_eq!(std::fs::read_dir(&empty).unwrap().count(), 0);
        with.kill();
        without.kill();
    }

    // If a folder vanishes under a job, its tasks stop, and they continue when it is back.
    let more = Job {
        count: Some(9),
        ..job
    };
    let id = farm.submit(&more);
    let away = farm.scratch.join("away");
    std::fs::rename(farm.store(), &away).unwrap();
    let mut worker = farm.worker("worker");
    worker.until_says(words);
    let status = farm.status(&id);
    assert_eq!(status["state"], "active", "{status}");
    assert_eq!(status["tasks"]["dead"], 0, "{status}");
    let explained = farm.run(&["job", "explain", &id]).ok().stdout;
    assert!(explained.contains("is it mounted?"), "{explained}");
    assert!(!farm.store().exists(), "the store's folder was made");
    std::fs::rename(&away, farm.store()).unwrap();
    farm.until_done_once(&more, &id);
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

#[test]
fn a_full_temporary_folder_stops_no_job_and_the_doctor_names_it() {
    let scratch = Scratch::new("temp-full");
    let Some(_disk) = Tmpfs::mount(&scratch.join("tmp"), 64) else {
        return;
    };
    let full = scratch.join("tmp").display().to_string();
    // Writes as much as there is room for.
    let _ = std::fs::write(scratch.join("tmp/fill"), [0; 1 << 16]);
    let cli = Cli::new(scratch.path());
    let cli = cli.with("TMPDIR", &full).with("SQLITE_TMPDIR", &full);
    cli.run(&["doctor"])
        .fails(7, &[&format!("0 B free in {full}"), "free some space"]);
    let size = ["--scenes", "1", "--samples", "4", "--spots", "4"];
    let more = ["--assets", "parametric", "--resolution", "8"];
    let done = cli.json(&[&["demo"], &size[..], &more].concat());
    assert_eq!(done["scenes"], 1, "{done}");
}
