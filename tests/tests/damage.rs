//! `dataset verify` finds every kind of damage and names the object; mending costs only the damaged scene.

use std::{fs, path::Path};

use picofarm_tests::{Farm, Job, store};

type Harm = fn(&Path);

fn flip(path: &Path) {
    let mut bytes = fs::read(path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    fs::write(path, bytes).unwrap();
}

fn truncate(path: &Path) {
    let bytes = fs::read(path).unwrap();
    fs::write(path, &bytes[..bytes.len() - 1]).unwrap();
}

fn delete(path: &Path) {
    fs::remove_file(path).unwrap();
}

#[test]
fn a_flipped_bit_a_missing_byte_and_a_missing_object_are_each_found_and_named() {
    let farm = Farm::start("damage");
    let job = Job::quick(&farm.store(), 2);
    let id = farm.submit(&job);
    let _worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
    let place = job.place();
    let whole = store::hashes(&place);
    let folder = place.display().to_string();
    let verify = ["dataset", "verify", folder.as_str()];
    let info = farm.json(&["dataset", "info", &folder]);
    assert_eq!(info["scenes"], 2, "{info}");

    let harms: [(&str, Harm); 3] = [
        ("flipped", flip),
        ("truncated", truncate),
        ("deleted", delete),
    ];
    let mut objects = store::objects(&place, 1);
    let manifest = objects.pop().expect("the manifest comes last");
    for key in objects {
        let path = place.join(&key);
        let bytes = fs::read(&path).unwrap();
        for (harm, damage) in &harms {
            damage(&path);
            farm.run(&verify).fails(6, &[&key]);
            if *harm != "flipped" {
                farm.run(&[&verify[..], &["--fast"]].concat())
                    .fails(6, &[&key]);
            }
            fs::write(&path, &bytes).unwrap();
        }
    }
    let path = place.join(&manifest);
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    farm.run(&verify).fails(6, &[&manifest]);
    fs::write(&path, &bytes).unwrap();

    farm.run(&verify).ok();
    assert_eq!(store::hashes(&place), whole, "verifying changes nothing");

    farm.run(&["dataset", "verify", "no-such-folder"])
        .fails(3, &["no-such-folder", "no data set"]);
}

#[test]
fn a_damaged_scene_is_mended_as_the_hint_says_and_only_that_scene_is_rendered() {
    let farm = Farm::start("mend");
    let job = Job::quick(&farm.store(), 2);
    let id = farm.submit(&job);
    let _worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
    let place = job.place();
    let (hashes, times) = (store::hashes(&place), store::times(&place));
    let objects = store::objects(&place, 1);
    let broken = place.join(&objects[0]);
    flip(&broken);
    let folder = place.display().to_string();
    let hint = "remove the objects named, then submit the job to a coordinator with a new catalog";
    farm.run(&["dataset", "verify", &folder])
        .fails(6, &[&objects[0], hint]);

    delete(&broken);
    let fresh = Farm::start("mend-fresh");
    let again = fresh.submit(&job);
    let _other = fresh.worker("other");
    fresh.until_done_once(&job, &again);
    assert_eq!(fresh.count(&again, "reused"), 1, "a whole scene is adopted");
    assert_eq!(
        store::hashes(&place),
        hashes,
        "the same scene comes out bit for bit"
    );
    let new_times = store::times(&place);
    for key in store::objects(&place, 0) {
        assert_eq!(new_times[&key], times[&key], "{key} was written again");
    }
}
