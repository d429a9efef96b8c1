//! `dataset verify` finds every kind of damage and names the object. Repair only makes the damaged
//! scenes again.

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
fn any_damage_is_repaired_bit_for_bit_and_nothing_else_is_written() {
    let farm = Farm::start("repair");
    let job = Job::quick(&farm.store(), 3);
    let id = farm.submit(&job);
    let worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
    worker.kill();
    let place = job.place();
    let (whole, times) = (store::hashes(&place), store::times(&place));
    let folder = place.display().to_string();
    let repair = ["dataset", "repair", folder.as_str()];
    let sound = farm.json(&repair);
    assert_eq!(sound["scenes"], serde_json::json!([]), "{sound}");

    let objects = store::objects(&place, 1);
    let manifest = objects.last().expect("the manifest comes last").clone();
    let harms: [(&str, Harm); 3] = [
        ("flipped", flip),
        ("truncated", truncate),
        ("deleted", delete),
    ];
    // A histogram, an image, a small array, and the manifest with everything else intact.
    for key in [&objects[0], &objects[2], &objects[14], &manifest] {
        for (harm, damage) in &harms {
            damage(&place.join(key));
            // Only the manifest shows that a scene was finished.
            let complete = (*key == manifest && *harm == "deleted").then_some("--complete");
            let args: Vec<&str> = repair.iter().copied().chain(complete).collect();
            let dry = farm.json(&[&args[..], &["--dry-run"]].concat());
            assert_eq!(dry["scenes"][0]["scene"], 1, "{harm} {key}: {dry}");
            assert_ne!(store::hashes(&place), whole, "--dry-run repairs nothing");
            let done = farm.json(&args);
            let written = &done["scenes"][0]["written"];
            let path = place.join(key).display().to_string();
            assert_eq!(written, &serde_json::json!([path]), "{harm} {key}: {done}");
            assert_eq!(done["scenes"].as_array().unwrap().len(), 1);
            assert_eq!(store::hashes(&place), whole, "{harm} {key}");
        }
    }
    // Two histograms or two manifests swapped: both scenes are made again.
    for key in ["transient/c/N/0/0/0", "manifests/N.json"] {
        let [a, b] = ["0", "2"].map(|n| place.join(key.replace('N', n)));
        let held = place.join("held");
        fs::rename(&a, &held).unwrap();
        fs::rename(&b, &a).unwrap();
        fs::rename(&held, &b).unwrap();
        let said = farm.run(&["dataset", "verify", &folder]);
        said.fails(6, &["scene 0", "scene 2", "dataset repair"]);
        let done = farm.json(&repair);
        assert_eq!(done["scenes"].as_array().unwrap().len(), 2, "{done}");
        assert_eq!(store::hashes(&place), whole, "{key}");
    }
    // Metadata of arrays follow from the root's.
    flip(&place.join("depth/zarr.json"));
    farm.run(&["dataset", "verify", &folder, "--fast"])
        .fails(6, &["depth/zarr.json"]);
    farm.run(&repair).ok();
    assert_eq!(store::hashes(&place), whole);
    // The contents of the root follow from the recipe and the other metadata.
    for damage in [flip as Harm, delete] {
        damage(&place.join("zarr.json"));
        let said = farm.run(&["dataset", "verify", &folder]);
        assert!(
            said.code != Some(0) && said.stderr.contains("dataset repair"),
            "{said:?}"
        );
        farm.run(&repair).ok();
        assert_eq!(store::hashes(&place), whole);
    }
    let new_times = store::times(&place);
    for (key, time) in times.iter().filter(|(k, _)| k.contains("intensity/c/0/")) {
        assert_eq!(&new_times[key], time, "{key} was written again");
    }
    assert!(store::leftovers(&place).is_empty());
}

#[test]
fn nothing_is_overwritten_by_what_is_not_proved_to_be_the_same() {
    let farm = Farm::start("alarm");
    let job = Job::quick(&farm.store(), 2);
    let id = farm.submit(&job);
    let worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
    worker.kill();
    let place = job.place();
    let folder = place.display().to_string();
    let whole = store::hashes(&place);
    farm.run(&["dataset", "snapshot", "create", &folder, "v1"])
        .ok();
    // With both histogram and manifest broken, only the snapshot shows what the scene was.
    let keys = ["transient/c/0/0/0/0", "manifests/0.json"].map(|k| place.join(k));
    for key in &keys {
        flip(key);
    }
    let broken = store::hashes(&place);
    let repair = ["dataset", "repair", folder.as_str()];
    farm.run(&repair)
        .fails(6, &["scene 0", "nothing proves", "transient/c/0/0/0/0"]);
    assert_eq!(store::hashes(&place), broken);
    farm.run(&[&repair[..], &["--snapshot", "v1"]].concat())
        .ok();
    let mut now = store::hashes(&place);
    now.remove("snapshots/v1.json.gz").expect("it is kept");
    assert_eq!(now, whole);
    // A job that did not make the data set is rejected, even if the user names it.
    let recipes = place.join("recipes");
    let away = farm.store().join("recipes-away");
    fs::rename(&recipes, &away).unwrap();
    flip(&keys[0]);
    farm.run(&repair)
        .fails(6, &["does not say how it was made", "--job"]);
    let other = Job {
        seed: job.seed + 1,
        ..job.clone()
    };
    let file = |job: &Job, name: &str| {
        let path = farm.store().join(name);
        fs::write(&path, job.toml()).unwrap();
        path.display().to_string()
    };
    let wrong = file(&other, "other.toml");
    farm.run(&[&repair[..], &["--job", &wrong]].concat())
        .fails(6, &["none of the 1 known ways"]);
    let right = file(&job, "job.toml");
    farm.run(&[&repair[..], &["--job", &right]].concat()).ok();
    fs::rename(&away, &recipes).unwrap();
    let mut now = store::hashes(&place);
    now.remove("snapshots/v1.json.gz").expect("it is kept");
    assert_eq!(now, whole);
}

#[test]
fn a_reprocessed_scene_is_measured_again_from_its_source() {
    let farm = Farm::start("repair-reprocessed");
    let job = Job::quick(&farm.store(), 2);
    let id = farm.submit(&job);
    let worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
    worker.kill();
    let (clean, noisy) = (job.place(), farm.store().join("noisy"));
    let [from, to] = [&clean, &noisy].map(|p| p.display().to_string());
    farm.run(&["dataset", "reprocess", &from, &to, "--dark", "0.5"])
        .ok();
    let whole = store::hashes(&noisy);
    flip(&noisy.join("transient/c/1/0/0/0"));
    let done = farm.json(&["dataset", "repair", &to]);
    assert_eq!(done["scenes"][0]["scene"], 1, "{done}");
    assert_eq!(store::hashes(&noisy), whole);
    // The source was moved, and the recipe is lost: the manifest has the remaining information.
    let moved = farm.store().join("moved");
    fs::rename(&clean, &moved).unwrap();
    delete(&noisy.join("depth/c/0/0/0"));
    farm.run(&["dataset", "repair", &to])
        .fails(6, &["scene 0", "--source"]);
    let moved = moved.display().to_string();
    farm.run(&["dataset", "repair", &to, "--source", &moved])
        .ok();
    assert_eq!(store::hashes(&noisy), whole);
    fs::remove_dir_all(noisy.join("recipes")).unwrap();
    delete(&noisy.join("depth/c/0/0/0"));
    farm.run(&["dataset", "repair", &to, "--source", &moved])
        .ok();
    let mut left = whole;
    left.retain(|key, _| !key.starts_with("recipes/"));
    assert_eq!(store::hashes(&noisy), left);
}

#[test]
fn a_snapshot_stays_what_it_was_while_the_data_set_grows_and_loses() {
    let farm = Farm::start("snapshots");
    let job = Job::quick(&farm.store(), 2);
    let id = farm.submit(&job);
    let _worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
    let place = job.place();
    let folder = place.display().to_string();
    let snapshot = |args: &[&str]| farm.run(&[&["dataset", "snapshot"], args].concat());
    let made = snapshot(&["create", &folder, "v1", "--json"]).ok().json();
    assert_eq!(
        (&made["scenes"], &made["changed"]),
        (&2.into(), &true.into())
    );
    let again = snapshot(&["create", &folder, "v1", "--json"]).ok().json();
    assert_eq!(
        (&again["id"], &again["changed"]),
        (&made["id"], &false.into())
    );
    let bytes = fs::read(place.join("snapshots/v1.json.gz")).unwrap();

    let larger = Job {
        count: Some(3),
        ..job.clone()
    };
    let more = farm.submit(&larger);
    farm.until_ended(&more);
    snapshot(&["create", &folder, "v1"]).fails(3, &["another snapshot", "another name"]);
    snapshot(&["create", &folder, "../v2"]).fails(3, &["must be up to 64 letters"]);
    snapshot(&["create", &folder, "v2"]).ok();
    assert_eq!(fs::read(place.join("snapshots/v1.json.gz")).unwrap(), bytes);
    let diff = snapshot(&["diff", &folder, "v1", "v2", "--json"])
        .ok()
        .json();
    assert_eq!(
        (&diff["added"], &diff["removed"], &diff["same"]),
        (&serde_json::json!([2]), &serde_json::json!([]), &2.into()),
        "{diff}"
    );
    let listed = snapshot(&["list", &folder, "--json"]).ok().json();
    assert_eq!(listed.as_array().unwrap().len(), 2, "{listed}");
    farm.run(&["dataset", "verify", &folder]).ok();

    // A scene that only v2 has is lost to v2 but not to v1. Objects named by a snapshot are not
    // collected.
    delete(&place.join("manifests/2.json"));
    snapshot(&["verify", &folder, "v1"]).ok();
    snapshot(&["verify", &folder, "v2"]).fails(6, &["scene 2", "manifests/2.json: missing"]);
    let gc = [
        "dataset",
        "gc",
        &folder,
        "--older-than",
        "0s",
        "--nothing-runs",
    ];
    let spared = farm.json(&[&gc[..], &["--delete"]].concat());
    assert_eq!(
        (&spared["objects"], &spared["pinned"]),
        (&0.into(), &15.into())
    );
    farm.run(&["dataset", "repair", &folder, "--snapshot", "v2"])
        .ok();
    snapshot(&["verify", &folder, "v2"]).ok();

    // A modified snapshot is rejected.
    flip(&place.join("snapshots/v2.json.gz"));
    farm.run(&["dataset", "verify", &folder, "--fast"])
        .fails(6, &["snapshots/v2.json.gz"]);
    snapshot(&["show", &folder, "v2"]).fails(6, &["snapshots/v2.json.gz"]);
    let lost = place.join("manifests/0.json");
    let manifest = fs::read(&lost).unwrap();
    delete(&lost);
    farm.run(&gc).fails(6, &["snapshots/v2.json.gz"]);
    fs::write(&lost, manifest).unwrap();

    let shown = farm.json(&["dataset", "show", &folder, "1"]);
    assert_eq!(
        shown["recipe"]["stage"]["scenes"]["seed"], job.seed,
        "{shown}"
    );
    assert_eq!(shown["snapshots"], serde_json::json!(["v1"]), "{shown}");
}
