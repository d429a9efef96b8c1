//! `dataset collect` on a local store: lists first, retains recent objects, deletes objects that
//! belong to no finished scene.

use std::fs;

use picofarm_tests::{Farm, Job, store};

#[test]
fn what_killed_workers_left_is_collected_and_the_scene_comes_back_bit_for_bit() {
    let farm = Farm::start("collect");
    let job = Job::quick(&farm.store(), 2);
    let id = farm.submit(&job);
    let worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
    worker.kill();
    let place = job.place();
    let whole = store::hashes(&place);
    let lost = store::objects(&place, 1);
    fs::remove_file(place.join("manifests/1.json")).unwrap();
    let torn = [
        place.join("depth/c/0/0/0#1"),
        farm.store().join(".probe-1-race#2"),
    ];
    for file in &torn {
        fs::write(file, b"half").unwrap();
    }

    let folder = place.display().to_string();
    let collect =
        |args: &[&str]| farm.run(&[&["dataset", "collect", &folder, "--json"], args].concat());
    collect(&["--older-than", "59m", "--delete"]).fails(3, &["at least 1h", "--nothing-runs"]);
    collect(&["--older-than", "1"]).fails(2, &["expected a number with s, m, h or d"]);
    let spared = collect(&["--older-than", "1h", "--delete"]).ok().json();
    assert_eq!(
        (&spared["objects"], &spared["young"]),
        (&0.into(), &15.into()),
        "{spared}"
    );
    let now = ["--older-than", "0s", "--nothing-runs"];
    let dry = collect(&now).ok().json();
    assert_eq!(
        (&dry["objects"], &dry["deleted"]),
        (&17.into(), &false.into()),
        "{dry}"
    );
    assert!(torn.iter().all(|file| file.exists()) && place.join(&lost[0]).exists());
    let done = collect(&[&now[..], &["--delete"]].concat()).ok().json();
    assert_eq!(
        (&done["objects"], &done["deleted"]),
        (&17.into(), &true.into()),
        "{done}"
    );
    assert!(!torn.iter().any(|file| file.exists()));
    let mut left = whole.clone();
    left.retain(|key, _| !lost.contains(key));
    assert_eq!(store::hashes(&place), left);
    farm.run(&["dataset", "verify", &folder]).ok();

    let fresh = Farm::start("collect-fresh");
    let again = fresh.submit(&job);
    let _other = fresh.worker("other");
    fresh.until_done_once(&job, &again);
    assert_eq!(fresh.count(&again, "reused"), 1);
    assert_eq!(store::hashes(&place), whole);
}
