//! One flash as a job: rooms are rendered, taken apart by physics, evaluated and reconstructed,
//! with equal bytes however often workers are killed.

use std::{fs, path::Path, thread::sleep, time::Duration};

use picofarm_tests::{Farm, rng::Rng, store};

const SCENES: u64 = 24;

fn job(store: &Path, scenes: u64) -> String {
    format!(
        r#"
name = "one flash"
[limits]
max_crashes = 1000
[[stage]]
name = "rooms"
scenes = {{ kind = "primitive", count = {scenes}, seed = 9, spots = 25 }}
render = {{ resolution = 32, samples = 2, bins = 400, bin_width_m = 0.0384 }}
output = {{ store = {store:?}, dataset = "rooms" }}
[[stage]]
name = "apart"
kind = "demultiplex"
source = "rooms"
output = {{ store = {store:?}, dataset = "rooms-apart" }}
[[stage]]
name = "3d"
kind = "reconstruct"
source = "rooms"
reconstruct = {{ from = "predictions", predictions = "apart", grid = {{ nodes = 32, iterations = 10, accept_inconsistent = true }} }}
output = {{ store = {store:?}, dataset = "rooms-3d" }}
"#
    )
}

/// The stages that compare predictions with the truth.
const SCORED: &str = r#"
[[stage]]
kind = "split"
source = "rooms"
split = { fractions = [0.5, 0.25, 0.25] }
[[stage]]
name = "errors"
kind = "evaluate"
source = "rooms"
evaluate = { predictions = "apart" }
"#;

fn submit(farm: &Farm, text: &str) -> String {
    let file = farm.store().with_file_name("job.toml");
    fs::write(&file, text).unwrap();
    let answer = farm.json(&["job", "submit", file.to_str().unwrap()]);
    answer["job"].as_str().unwrap().to_owned()
}

/// Returns the objects of all three stages.
fn made(farm: &Farm) -> Vec<std::collections::BTreeMap<String, String>> {
    let folders = ["rooms", "rooms-apart", "rooms-3d"];
    folders.map(|f| store::hashes(&farm.store().join(f))).into()
}

#[test]
fn flashes_are_taken_apart_evaluated_and_reconstructed_with_equal_bytes_however_often_workers_are_killed()
 {
    let farm = Farm::with_lease("flash-struck", 2.0);
    let id = submit(&farm, &(job(&farm.store(), SCENES) + SCORED));
    let mut rng = Rng::new(5);
    let mut workers = vec![farm.worker("worker-0"), farm.worker("worker-1")];
    let (mut started, mut kills) = (2, 0);
    while farm.status(&id)["state"] == "active" && kills < 20 {
        sleep(Duration::from_millis(150 + rng.number() % 600));
        let struck = workers.swap_remove((rng.number() % 2) as usize);
        struck.kill();
        kills += 1;
        workers.push(farm.worker(&format!("worker-{started}")));
        started += 1;
    }
    assert_eq!(farm.until_ended(&id)["state"], "done");
    assert!(kills >= 3, "{kills} kills before it was over");
    assert_eq!(farm.status(&id)["tasks"]["done"], 3 * SCENES + 2);
    let alarms = farm.events_of(&id, "alarm");
    assert!(alarms.is_empty(), "{alarms:?}");

    let calm = Farm::start("flash-calm");
    let undisturbed = submit(&calm, &(job(&calm.store(), SCENES) + SCORED));
    let _worker = calm.worker("calm");
    assert_eq!(calm.until_ended(&undisturbed)["state"], "done");
    assert_eq!(made(&farm), made(&calm), "after {kills} kills");

    let place = farm.store().join("rooms-apart");
    let info = farm.json(&["dataset", "info", place.to_str().unwrap()]);
    let mut found: Vec<&str> = Vec::new();
    for evaluation in info["evaluations"].as_array().unwrap() {
        assert_eq!(evaluation["model"], "demultiplex", "{evaluation}");
        assert_eq!(evaluation["scenes"], SCENES / 4, "{evaluation}");
        found.push(evaluation["predicts"].as_str().unwrap());
    }
    found.sort_unstable();
    assert_eq!(found, ["shadow", "specular", "tof"], "{info}");
}

#[test]
fn predictions_of_physics_are_shown_verified_and_repaired_like_those_of_networks() {
    let farm = Farm::start("flash-kept");
    let id = submit(&farm, &job(&farm.store(), 2));
    let _worker = farm.worker("worker");
    assert_eq!(farm.until_ended(&id)["state"], "done");
    let place = farm.store().join("rooms-apart");
    let name = place.to_str().unwrap();
    let info = farm.json(&["dataset", "info", name]);
    assert_eq!(info["scenes"], 2, "{info}");
    assert_eq!(info["spec"]["depth"], true, "{info}");
    assert_eq!(
        info["spec"]["spots"].as_array().unwrap().len(),
        25,
        "{info}"
    );
    let shown = farm.json(&["dataset", "show", name, "1"]);
    let by = &shown["manifest"]["models"]["tof"];
    assert_eq!(by["name"], "demultiplex", "{shown}");
    assert_eq!(shown["kind"], "demultiplex", "{shown}");
    farm.run(&["dataset", "verify", name]).code(0);

    let before = store::hashes(&place);
    let depth = place.join("depth/c/1/0/0");
    fs::write(&depth, b"damaged").unwrap();
    farm.run(&["dataset", "verify", name]).code(6);
    let file = farm.store().with_file_name("job.toml");
    farm.run(&[
        "job",
        "submit",
        file.to_str().unwrap(),
        "--from-stage",
        "apart",
        "--watch",
    ])
    .code(0);
    assert_eq!(store::hashes(&place), before);
}

#[test]
fn bins_too_coarse_to_tell_spots_apart_are_refused_with_their_width() {
    let farm = Farm::start("flash-coarse");
    let text = job(&farm.store(), 1).replace(
        "bins = 400, bin_width_m = 0.0384",
        "bins = 16, bin_width_m = 1.0",
    );
    let id = submit(&farm, &text);
    let _worker = farm.worker("worker");
    assert_eq!(farm.until_ended(&id)["state"], "failed");
    let events = farm.events(&id);
    let said = |e: &serde_json::Value| {
        e["message"]
            .as_str()
            .is_some_and(|m| m.contains("1 m wide"))
    };
    assert!(events.iter().any(said), "{events:?}");
}
