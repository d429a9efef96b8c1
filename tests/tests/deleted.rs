//! Data that were deleted are not taken for done: the same job file makes them again, to the same bytes.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
};

use picofarm_tests::{Farm, Job, store};
use serde_json::Value;

fn reasons(plan: &Value) -> String {
    plan["stages"][0]["reasons"].to_string()
}

/// The keys of objects that are not the same in both.
fn differing<'a>(a: &'a BTreeMap<String, String>, b: &'a BTreeMap<String, String>) -> Vec<&'a str> {
    let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    let differ = keys.into_iter().filter(|key| a.get(*key) != b.get(*key));
    differ.map(String::as_str).collect()
}

#[test]
fn a_deleted_store_and_a_deleted_scene_are_made_again_by_the_same_job_file() {
    let farm = Farm::start("deleted");
    let job = Job::quick(&farm.store(), 3);
    let file = farm.scratch.join("job.toml");
    job.write(&file);
    let worker = farm.worker("worker");
    let id = farm.submit(&job);
    farm.until_done_once(&job, &id);
    let whole = store::hashes(&job.place());
    let file = file.display().to_string();
    assert_eq!(farm.json(&["job", "submit", &file])["existed"], true);

    fs::remove_file(job.place().join("manifests/1.json")).unwrap();
    let plan = farm.json(&["job", "plan", &file]);
    assert_eq!((&plan["reuse"], &plan["run"]), (&2.into(), &1.into()));
    let said = reasons(&plan);
    assert!(
        said.contains("1 of 3 scenes recorded as done are gone from"),
        "{said}"
    );
    let again = farm.json(&["job", "submit", &file]);
    assert_eq!(again["existed"], false, "{again}");
    farm.until_ended(again["job"].as_str().unwrap());
    assert_eq!(store::hashes(&job.place()), whole);

    fs::remove_dir_all(farm.store()).unwrap();
    let plan = farm.json(&["job", "plan", &file]);
    assert_eq!((&plan["reuse"], &plan["run"]), (&0.into(), &3.into()));
    let again = farm.json(&["job", "submit", &file]);
    assert_eq!(again["existed"], false, "{again}");
    let status = farm.until_ended(again["job"].as_str().unwrap());
    assert_eq!(status["state"], "done", "{status}");
    let made = store::hashes(&job.place());
    assert_eq!(differing(&made, &whole), [""; 0]);

    assert_eq!(farm.json(&["job", "submit", &file])["existed"], true);
    worker.kill();
}
