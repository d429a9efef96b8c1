//! Reconstructions as a job: planned, leased, killed and resumed like renders, from ground truth,
//! from single-spot captures and from predictions of networks.

use std::{fs, path::Path, thread::sleep, time::Duration};

use picofarm_tests::{Farm, Rooms, Signal, rng::Rng, store};
use serde_json::Value;

const SCENES: u64 = 64;

fn job(store: &Path, scenes: u64) -> String {
    let rooms = Rooms::fine(scenes).per_spot().stage(store);
    format!(
        r#"
name = "rooms in 3D"
[limits]
max_crashes = 1000
{rooms}[[stage]]
name = "from-captures"
kind = "reconstruct"
source = "rooms"
reconstruct = {{ from = "captures", grid = {{ nodes = 40, iterations = 10 }} }}
output = {{ store = {store:?}, dataset = "captures-3d" }}
"#
    )
}

fn submit(farm: &Farm, text: &str) -> String {
    let file = farm.store().with_file_name("job.toml");
    fs::write(&file, text).unwrap();
    let answer = farm.json(&["job", "submit", file.to_str().unwrap()]);
    answer["job"].as_str().unwrap().to_owned()
}

/// Returns the objects of an undisturbed run of the job.
fn undisturbed() -> std::collections::BTreeMap<String, String> {
    let farm = Farm::start("rooms-calm");
    let id = submit(&farm, &job(&farm.store(), SCENES));
    let _worker = farm.worker("calm");
    assert_eq!(farm.until_ended(&id)["state"], "done");
    store::hashes(&farm.store().join("captures-3d"))
}

#[test]
fn each_room_of_a_job_is_reconstructed_once_with_equal_bytes_however_often_workers_are_killed() {
    let farm = Farm::with_lease("rooms-struck", 2.0);
    let id = submit(&farm, &job(&farm.store(), SCENES));
    let mut rng = Rng::new(3);
    let mut workers = vec![farm.worker("worker-0"), farm.worker("worker-1")];
    let mut started = 2;
    let mut kills = 0;
    while farm.status(&id)["state"] == "active" && kills < 20 {
        sleep(Duration::from_millis(150 + rng.number() % 600));
        let at = (rng.number() % 2) as usize;
        let struck = workers.swap_remove(at);
        struck.kill();
        kills += 1;
        workers.push(farm.worker(&format!("worker-{started}")));
        started += 1;
    }
    assert_eq!(farm.until_ended(&id)["state"], "done");
    assert!(kills >= 5, "{kills} kills before it was over");
    let status = farm.status(&id);
    assert_eq!(status["tasks"]["done"], 2 * SCENES, "{status}");
    let alarms = farm.events_of(&id, "alarm");
    assert!(alarms.is_empty(), "{alarms:?}");
    let found = store::hashes(&farm.store().join("captures-3d"));
    assert_eq!(found, undisturbed(), "after {kills} kills");
}

fn metrics(farm: &Farm, folder: &str, scene: u64) -> Value {
    let path = farm
        .store()
        .join(format!("{folder}/scenes/{scene}/metrics.json"));
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// Number of rooms in the folders `truth-3d` and `seen-3d`.
const COUNT: u64 = 6;

/// Checks the output of commands about the folders `truth-3d` and `seen-3d`.
fn looked_at(farm: &Farm) {
    let place = |name: &str| farm.store().join(name).to_str().unwrap().to_owned();
    let (truth, seen) = (place("truth-3d"), place("seen-3d"));
    let pictures = place("pictures");
    let drawn = farm.json(&[
        "dataset", "picture", &truth, "--out", &pictures, "--rows", "3",
    ]);
    let sheet = fs::read(drawn["contact_sheet"].as_str().unwrap()).unwrap();
    assert!(sheet.starts_with(b"\x89PNG"));
    // Three rows of pictures with 160 pixels.
    let height = u32::from_be_bytes(sheet[20..24].try_into().unwrap());
    assert!((480..600).contains(&height), "{height}");

    let page = place("rooms.html");
    let written = farm.json(&["dataset", "report", &truth, &seen, "--out", &page]);
    assert_eq!(written["scenes"], 2 * COUNT, "{written}");
    let html = fs::read_to_string(&page).unwrap();
    for said in [
        "truth-3d",
        "from predictions, 4 spots, 32×32 pixels, 48 nodes",
        "0.0862",
    ] {
        assert!(html.contains(said), "{said}");
    }
    let pictures = html.matches("data:image/png;base64,").count();
    assert_eq!(pictures, 6, "best, median and worst of either");
    let said_of = fs::read_to_string(written["json"].as_str().unwrap()).unwrap();
    let said_of: Value = serde_json::from_str(&said_of).unwrap();
    let info = farm.json(&["dataset", "info", &truth]);
    let of_truth = &said_of["groups"][0];
    assert_eq!(
        of_truth["figures"]["l1_m"]["mean"], info["means"]["l1_m"]["mean"],
        "{said_of}"
    );
    assert!(
        of_truth["figures"]["l1_m"]["standard_error"]
            .as_f64()
            .unwrap()
            > 0.0
    );
    // The rooms, spots and images differ from the paper's.
    assert_eq!(of_truth["as_published"], false, "{said_of}");
    let ranks: Vec<&str> = of_truth["extremes"]
        .as_array()
        .unwrap()
        .iter()
        .map(|e| e["rank"].as_str().unwrap())
        .collect();
    assert_eq!(ranks, ["best", "median", "worst"]);

    let rooms = place("rooms");
    let refused = farm.run(&["dataset", "report", &rooms]).code(3);
    assert!(
        refused.stderr.contains("holds no reconstructions"),
        "{}",
        refused.stderr
    );
}

#[test]
fn reconstructions_without_views_have_no_pictures_and_say_so() {
    let farm = Farm::start("rooms-unseen");
    let id = submit(&farm, &job(&farm.store(), 2));
    let _worker = farm.worker("worker");
    assert_eq!(farm.until_ended(&id)["state"], "done");
    let place = farm.store().join("captures-3d");
    let place = place.to_str().unwrap();
    let pictures = farm.store().join("pictures");
    let refused = farm
        .run(&[
            "dataset",
            "picture",
            place,
            "--out",
            pictures.to_str().unwrap(),
        ])
        .code(3);
    assert!(refused.stderr.contains("views = 0"), "{}", refused.stderr);
    assert!(refused.stderr.contains("views = 24"), "{}", refused.stderr);
    let page = farm.store().join("rooms.html");
    farm.run(&["dataset", "report", place, "--out", page.to_str().unwrap()])
        .ok();
    let html = fs::read_to_string(page).unwrap();
    assert!(html.contains("No novel views") && !html.contains("data:image"));
}

#[test]
fn rooms_come_from_predictions_and_truth_alike_and_what_is_missing_is_named() {
    let farm = Farm::start("rooms-predicted");
    let store = farm.store();
    let network = "net = { width = 4, levels = 3 }\noptimise = { epochs = 30, batch = 2 }\ninput = { bins = 40 }";
    let rooms = Rooms::fine(COUNT).split_stages(&store, [4, 1, 1]);
    let text = format!(
        r#"
name = "rooms in 3D"
{rooms}[[stage]]
name = "tof"
kind = "train"
source = "rooms"
[stage.train]
target = "tof"
model = "tof"
{network}
[[stage]]
name = "shadow"
kind = "train"
source = "rooms"
[stage.train]
target = "shadow"
model = "shadow"
{network}
[[stage]]
name = "networks"
kind = "infer"
source = "rooms"
infer = {{ models = ["tof", "shadow"] }}
output = {{ store = {store:?}, dataset = "seen" }}
[[stage]]
name = "from-truth"
kind = "reconstruct"
source = "rooms"
reconstruct = {{ views = 2, grid = {{ nodes = 48, iterations = 30 }} }}
output = {{ store = {store:?}, dataset = "truth-3d" }}
[[stage]]
name = "from-predictions"
kind = "reconstruct"
source = "rooms"
reconstruct = {{ from = "predictions", predictions = "networks", views = 2, grid = {{ nodes = 48, iterations = 30 }} }}
output = {{ store = {store:?}, dataset = "seen-3d" }}
"#
    );
    let id = submit(&farm, &text);
    let mut worker = farm.worker("worker");
    assert_eq!(farm.until_ended(&id)["state"], "done");
    let mut from_predictions = 0.0;
    for scene in 0..COUNT {
        for folder in ["truth-3d", "seen-3d"] {
            let found = metrics(&farm, folder, scene);
            let l1 = found["novel_views"]["all"]["l1_m"].as_f64().unwrap();
            // Networks trained on four rooms are poor: in one room or another they see nothing.
            let most = if folder == "truth-3d" { 0.25 } else { 2.5 };
            assert!(l1 > 0.0 && l1 < most, "{folder} {scene}: {found}");
            if folder == "seen-3d" {
                from_predictions += l1 / COUNT as f64;
            }
            assert_eq!(found["spots"], 4, "{found}");
            assert_eq!(found["image"], serde_json::json!([32, 32]), "{found}");
            let source = found["provenance"]["source"].as_str().unwrap();
            assert!(source.starts_with("primitive-"), "{found}");
            let files = farm.store().join(format!("{folder}/scenes/{scene}"));
            let begins = |name: &str, magic: &[u8]| {
                let bytes = fs::read(files.join(name)).unwrap();
                assert!(bytes.starts_with(magic), "{folder} {scene}: {name}");
            };
            begins("mesh.ply", b"ply\n");
            begins("mesh.glb", b"glTF");
            begins("views.png", b"\x89PNG");
        }
    }
    assert!(from_predictions < 1.0, "{from_predictions}");
    // A damaged result is found, and restored by running the same job again.
    let folder = farm.store().join("truth-3d");
    let verified = farm.json(&["dataset", "verify", folder.to_str().unwrap()]);
    assert_eq!(verified["scenes"], COUNT, "{verified}");
    assert_eq!(verified["problems"], serde_json::json!([]), "{verified}");
    let mesh = folder.join("scenes/3/mesh.ply");
    let whole = fs::read(&mesh).unwrap();
    fs::write(&mesh, &whole[..whole.len() / 2]).unwrap();
    let damaged = farm
        .run(&["dataset", "verify", folder.to_str().unwrap()])
        .code(6);
    assert!(
        damaged.stderr.contains("scenes/3/mesh.ply"),
        "{}",
        damaged.stderr
    );
    let no_data_set = farm.run(&["dataset", "show", folder.to_str().unwrap(), "3"]);
    assert!(
        no_data_set.stderr.contains("holds reconstructions"),
        "{}",
        no_data_set.stderr
    );
    let again = submit(&farm, &text);
    assert_eq!(farm.until_ended(&again)["state"], "done");
    assert_eq!(fs::read(&mesh).unwrap(), whole);
    looked_at(&farm);
    // A source without separate histograms per spot; predictions of other rooms.
    let before = text
        .split("[[stage]]\nname = \"from-truth\"")
        .next()
        .unwrap();
    let fails = |stages: &str, words: &[&str]| {
        let id = submit(&farm, &format!("{before}{stages}"));
        assert_eq!(farm.until_ended(&id)["state"], "failed");
        let events = farm.events(&id);
        let said = |m: &str| words.iter().all(|w| m.contains(w));
        let found = events
            .iter()
            .any(|e| e["message"].as_str().is_some_and(said));
        assert!(found, "{words:?}: {events:?}");
    };
    fails(
        &format!(
            r#"
[[stage]]
name = "from-captures"
kind = "reconstruct"
source = "rooms"
reconstruct = {{ from = "captures" }}
output = {{ store = {store:?}, dataset = "captures-3d" }}
"#
        ),
        &["per_spot = true"],
    );
    let others = Rooms {
        name: "others".into(),
        seed: 9,
        ..Rooms::fine(COUNT)
    };
    let others = others.stage(&store);
    fails(
        &format!(
            r#"
{others}[[stage]]
name = "mixed"
kind = "reconstruct"
source = "others"
reconstruct = {{ from = "predictions", predictions = "seen" }}
output = {{ store = {store:?}, dataset = "mixed-3d" }}
"#
        ),
        &["reconstruct.predictions", "\"rooms\"", "\"others\""],
    );
    worker.signal(Signal::Terminate);
    one_command_asks_the_same_networks(&farm);
}

/// Runs `picofarm reconstruct --spots-from predictions` with the farm's models.
fn one_command_asks_the_same_networks(farm: &Farm) {
    let store = farm.store();
    let store = store.to_str().unwrap();
    for (spots, file) in [("4", "room.glb"), ("16", "other.glb")] {
        let made = [
            "scene",
            "generate",
            "--kind",
            "primitive",
            "--seed",
            "77",
            "--spots",
            spots,
        ];
        farm.run(&[&made[..], &["--resolution", "32", "--out", file]].concat())
            .ok();
    }
    let ask = |file: &str, resolution: &str, options: &[&str], out: &str| {
        let base = [
            "reconstruct",
            file,
            "--spots-from",
            "predictions",
            "--resolution",
            resolution,
            "--nodes",
            "48",
            "--samples",
            "2",
            "--out",
            out,
        ];
        farm.run(&[&base[..], options].concat())
    };
    let models = ["--models", store, "--tof", "tof", "--shadow", "shadow"];
    let with = |more: &[&'static str]| [&models[..], more].concat();
    let made = |out: &str| fs::read(farm.scratch.join(out).join("metrics.json")).unwrap();
    ask("room.glb", "32", &with(&["--threads", "1"]), "one").ok();
    ask(
        "room.glb",
        "32",
        &with(&["--threads", "3", "--bins", "200", "--bin-width-m", "0.0768"]),
        "three",
    )
    .ok();
    assert!(made("one") == made("three"));
    let metrics: Value = serde_json::from_slice(&made("one")).unwrap();
    assert_eq!(metrics["spots_from"], "predictions");
    let predictions = &metrics["predictions"];
    assert_eq!(
        predictions["models"]["shadow"]["name"], "shadow",
        "{predictions}"
    );
    let error = predictions["depth_mae_m"].as_f64().unwrap();
    assert!(error > 0.0 && error < 2.0, "{predictions}");
    let iou = predictions["lit_iou"].as_f64().unwrap();
    assert!(iou > 0.3 && iou < 1.0, "{predictions}");
    let l1 = metrics["novel_views"]["all"]["l1_m"].as_f64().unwrap();
    assert!(l1 > 0.0 && l1 < 2.0, "{metrics}");
    for (file, resolution, options, words) in [
        (
            "room.glb",
            "32",
            vec!["--models", store, "--tof", "tof"],
            &["--shadow", "needs"][..],
        ),
        (
            "room.glb",
            "32",
            vec!["--models", store, "--tof", "shadow", "--shadow", "shadow"],
            &["--tof shadow", "\"tof\""],
        ),
        (
            "room.glb",
            "30",
            with(&[]),
            &["--tof tof", "multiples of 4", "30"],
        ),
        (
            "room.glb",
            "32",
            with(&["--bins", "100"]),
            &["--bins", "200 bins"],
        ),
        (
            "other.glb",
            "32",
            with(&[]),
            &["--shadow shadow", "4 spots", "16 beams"],
        ),
    ] {
        let refused = ask(file, resolution, &options, "refused").code(3);
        for word in words {
            assert!(refused.stderr.contains(word), "{word}: {}", refused.stderr);
        }
        assert!(!farm.scratch.join("refused").exists());
    }
    let plain = [
        "reconstruct",
        "room.glb",
        "--out",
        "refused",
        "--tof",
        "tof",
    ];
    let refused = farm.run(&plain).code(3);
    assert!(
        refused
            .stderr
            .contains("--tof belongs to --spots-from predictions"),
        "{}",
        refused.stderr
    );
}
