//! Networks on the evidence of physics, as a job: rooms are taken apart, networks learn from the
//! evidence, predict and are evaluated, with equal bytes however often workers are killed.

use std::{collections::BTreeMap, fs, thread::sleep, time::Duration};

use picofarm_tests::{Farm, rng::Rng, store};
use serde_json::Value;

/// Returns a job in which a network learns from evidence; `train` has more of its settings.
fn job(farm: &Farm, evidence: bool, train: &str) -> String {
    let store = farm.store();
    format!(
        r#"
name = "evidence"
[limits]
max_crashes = 1000
[[stage]]
name = "rooms"
scenes = {{ kind = "primitive", count = 12, seed = 9, spots = 16 }}
render = {{ resolution = 32, samples = 2, bins = 200, bin_width_m = 0.0768 }}
output = {{ store = {store:?}, dataset = "rooms" }}
[[stage]]
kind = "split"
source = "rooms"
split = {{ counts = [8, 2, 2] }}
[[stage]]
name = "apart"
kind = "demultiplex"
source = "rooms"
demultiplex = {{ evidence = {evidence} }}
output = {{ store = {store:?}, dataset = "rooms-apart" }}
[[stage]]
name = "at-truth"
kind = "demultiplex"
source = "rooms"
demultiplex = {{ depth = "truth", evidence = true }}
output = {{ store = {store:?}, dataset = "rooms-truth" }}
[[stage]]
name = "shadow"
kind = "train"
source = "rooms"
needs = ["split"]
[stage.train]
target = "shadow"
model = "sh"
shadow = {{ variant = "evidence", times = "apart" }}
net = {{ width = 4, levels = 3 }}
checkpoint_minutes = 0.002
{train}
[[stage]]
name = "masks"
kind = "infer"
source = "rooms"
infer = {{ models = ["shadow"] }}
output = {{ store = {store:?}, dataset = "rooms-masks" }}
[[stage]]
name = "own"
kind = "evaluate"
source = "rooms"
evaluate = {{ models = ["shadow"] }}
[[stage]]
name = "truth"
kind = "evaluate"
source = "rooms"
evaluate = {{ models = ["shadow"], times = "at-truth" }}
[[stage]]
name = "trees"
kind = "evaluate"
source = "rooms"
needs = ["split"]
evaluate = {{ predictions = "apart" }}
[[stage]]
kind = "report"
report = {{ name = "all", models = ["shadow"], pictures = 1 }}
"#
    )
}

fn submit(farm: &Farm, text: &str) -> String {
    let file = farm.store().with_file_name("job.toml");
    fs::write(&file, text).unwrap();
    let answer = farm.json(&["job", "submit", file.to_str().unwrap()]);
    answer["job"].as_str().unwrap().to_owned()
}

fn made(farm: &Farm) -> Vec<BTreeMap<String, String>> {
    let folders = ["rooms-apart", "rooms-truth", "rooms-masks", "models/sh"];
    let all = folders.map(|f| {
        let mut all = store::hashes(&farm.store().join(f));
        // How fast a training was is no result.
        all.retain(|name, _| !name.contains("speed"));
        all
    });
    all.into()
}

/// Returns the IoU of all evaluations of a model or of predictions.
fn ious(farm: &Farm, args: &[&str]) -> Vec<f64> {
    let info: Value = farm.json(args);
    let all = info["evaluations"].as_array().unwrap();
    // Those of predictions name the quantity.
    let masks = all
        .iter()
        .filter(|e| e["predicts"].is_null() || e["predicts"] == "shadow");
    masks
        .map(|e| e["metrics"]["iou"].as_f64().unwrap())
        .collect()
}

#[test]
fn networks_learn_from_evidence_predict_and_are_evaluated_with_equal_bytes_however_often_workers_are_killed()
 {
    let train = "optimise = { epochs = 30, batch = 4, learning_rate = 3e-3 }";
    let farm = Farm::with_lease("evidence-struck", 2.0);
    let id = submit(&farm, &job(&farm, true, train));
    let mut rng = Rng::new(5);
    let mut workers = vec![farm.worker("worker-0"), farm.worker("worker-1")];
    let (mut started, mut kills) = (2, 0);
    while farm.status(&id)["state"] == "active" && kills < 20 {
        sleep(Duration::from_millis(150 + rng.number() % 600));
        workers.swap_remove((rng.number() % 2) as usize).kill();
        kills += 1;
        workers.push(farm.worker(&format!("worker-{started}")));
        started += 1;
    }
    assert_eq!(farm.until_ended(&id)["state"], "done");
    assert!(kills >= 3, "{kills} kills before it was over");

    let calm = Farm::start("evidence-calm");
    let undisturbed = submit(&calm, &job(&calm, true, train));
    let _worker = calm.worker("calm");
    assert_eq!(calm.until_ended(&undisturbed)["state"], "done");
    assert_eq!(made(&farm), made(&calm), "after {kills} kills");

    // The network has two evaluations: on evidence at the physics' depth, and at the true one.
    let store = calm.store();
    let store = store.to_str().unwrap();
    assert_eq!(ious(&calm, &["model", "show", store, "sh"]).len(), 2);
    let apart = calm.store().join("rooms-apart");
    assert_eq!(
        ious(&calm, &["dataset", "info", apart.to_str().unwrap()]).len(),
        1
    );
    calm.run(&["dataset", "verify", apart.to_str().unwrap()])
        .code(0);
}

#[test]
fn a_network_on_evidence_is_refused_where_there_is_none() {
    let farm = Farm::start("evidence-refused");
    let file = farm.store().with_file_name("job.toml");
    for (evidence, train, expected) in [
        (
            false,
            "",
            "\"rooms-apart\" is written by a stage before this one, and holds no evidence; name a demultiplex stage, and give \
             it demultiplex.evidence = true",
        ),
        (
            true,
            "input = { bins = 50 }",
            "train.input: is for histograms",
        ),
        (
            true,
            "sensor = { dark_per_bin = 0.1 }",
            "train.sensor: is for histograms",
        ),
    ] {
        fs::write(&file, job(&farm, evidence, train)).unwrap();
        farm.run(&["job", "submit", file.to_str().unwrap()])
            .fails(3, &[expected]);
    }
}
