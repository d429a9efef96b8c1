//! Training as a task: killed at any instant and resumed by another worker, it gives the weights of
//! an undisturbed training, bit for bit.
//!
//! The short form runs with all tests. The long one:
//! `PICOFARM_KILLS=20 tests/run -E 'test(/^training::/)'`.

use std::{fs, path::Path, thread::sleep, time::Duration};

use picofarm_tests::{Farm, Rooms, Signal, rng::Rng, store, wait};

/// Number of kills of training workers.
fn kills_wanted() -> u64 {
    std::env::var("PICOFARM_KILLS").map_or(6, |n| {
        n.parse().expect("PICOFARM_KILLS is a number of kills")
    })
}

/// Returns a job that renders rooms and splits them, for stages that learn from them.
fn rooms(name: &str, store: &Path) -> String {
    let rooms = Rooms::small(16).split_stages(store, [12, 2, 2]);
    format!(
        r#"
name = {name:?}
[limits]
max_crashes = 1000
{rooms}"#
    )
}

fn job(store: &Path) -> String {
    let rooms = rooms("learning", store);
    format!(
        r#"
{rooms}[[stage]]
name = "tof"
kind = "train"
source = "rooms"
[stage.train]
target = "tof"
model = "tof"
net = {{ width = 8, levels = 3 }}
optimise = {{ epochs = 600, batch = 4 }}
checkpoint_minutes = 0.01
[[stage]]
name = "depths"
kind = "infer"
source = "rooms"
infer = {{ models = ["tof"] }}
output = {{ store = {store:?}, dataset = "depths" }}
[[stage]]
name = "shadow"
kind = "train"
source = "rooms"
[stage.train]
target = "shadow"
model = "shadow"
shadow = {{ times = "depths" }}
net = {{ width = 4, levels = 2 }}
optimise = {{ epochs = 20, batch = 4 }}
[[stage]]
kind = "evaluate"
source = "rooms"
evaluate = {{ models = ["tof", "shadow"] }}
[[stage]]
name = "predict"
kind = "infer"
source = "rooms"
infer = {{ models = ["tof", "shadow"] }}
output = {{ store = {store:?}, dataset = "seen" }}
[[stage]]
kind = "report"
report = {{ name = "all", models = ["tof", "shadow"] }}
"#
    )
}

fn submit(farm: &Farm, name: &str) -> String {
    let file = farm.store().with_file_name(format!("{name}.toml"));
    fs::write(&file, job(&farm.store())).unwrap();
    let answer = farm.json(&["job", "submit", file.to_str().unwrap()]);
    answer["job"]
        .as_str()
        .expect("a submission answers with a job")
        .to_owned()
}

#[test]
fn a_training_whose_workers_are_killed_again_and_again_gives_the_weights_of_one_that_was_not() {
    let wanted = kills_wanted();
    let calm = Farm::with_lease("training-calm", 2.0);
    let id = submit(&calm, "calm");
    let _worker = calm.worker("calm");
    assert_eq!(calm.until_ended(&id)["state"], "done");

    let farm = Farm::with_lease("training-killed", 2.0);
    let id = submit(&farm, "killed");
    let mut rng = Rng::new(11);
    let (mut kills, mut resumed) = (0, 0);
    for round in 0..10 * wanted {
        let mut worker = farm.worker(&format!("worker-{round}"));
        if kills == wanted || farm.status(&id)["state"] != "active" {
            break;
        }
        // Waits until the training runs, and then for a random time.
        let begun = std::time::Instant::now();
        while worker.runs() && !worker.stderr().contains("task starts") {
            sleep(Duration::from_millis(20));
            assert!(
                begun.elapsed() < Duration::from_secs(120),
                "{}",
                worker.stderr()
            );
        }
        sleep(Duration::from_millis(300 + rng.number() % 900));
        let said = worker.stderr();
        resumed += u32::from(said.contains("goes on from the checkpoint"));
        kills += u64::from(said.contains("stage=\"tof\"") || said.contains("goes on from"));
        worker.kill();
    }
    assert!(resumed > 0, "no training went on from a checkpoint");
    let _last = farm.worker("last");
    assert_eq!(farm.until_ended(&id)["state"], "done");
    // The trained weights and the results computed from them.
    for (folder, part) in [
        ("models", "weights.safetensors"),
        ("seen", "manifests/15.json"),
    ] {
        let made = |farm: &Farm| {
            let mut hashes = store::hashes(&farm.store().join(folder));
            // The speed of a training varies between runs.
            hashes.retain(|key, _| !key.contains("checkpoints") && !key.ends_with("speed.json"));
            hashes
        };
        let there = made(&farm);
        assert!(there.keys().any(|key| key.contains(part)), "{there:?}");
        assert_eq!(
            there,
            made(&calm),
            "after {kills} kills, {resumed} resumptions"
        );
    }
    // Reports also contain training speeds; the rest of their contents is the same.
    let said = |farm: &Farm| {
        let report = fs::read(farm.store().join("reports/all/manifest.json")).unwrap();
        let report: serde_json::Value = serde_json::from_slice(&report).unwrap();
        let models = report["models"].as_array().unwrap().iter().cloned();
        let bare = models.map(|mut model| {
            model
                .as_object_mut()
                .unwrap()
                .remove("speed")
                .expect("it is told");
            model
        });
        bare.collect::<Vec<_>>()
    };
    assert_eq!(said(&farm), said(&calm));
    eprintln!("{kills} kills, {resumed} resumptions");
    predictions_can_be_looked_at(&calm);
    models_can_be_looked_after(&calm);
}

/// Submits a training with this interval between checkpoints.
fn submit_saved(farm: &Farm, minutes: f64, epochs: u32) -> String {
    let optimise = format!("epochs = {epochs}, batch = 4");
    submit_training(farm, &optimise, (1, minutes))
}

/// Returns the steps at which a training has a checkpoint in the store.
fn saved(farm: &Farm) -> Vec<u64> {
    let folder = farm.store().join("models/tof");
    if !folder.exists() {
        return Vec::new();
    }
    let there = store::hashes(&folder);
    let steps = there.keys().filter_map(|key| {
        let name = Path::new(key).file_name()?.to_str()?;
        name.strip_suffix(".ckpt")?.parse().ok()
    });
    steps.collect()
}

/// Returns the number of steps done, as reported by the task.
fn step_of(farm: &Farm, id: &str) -> Option<u64> {
    let status = farm.status(id);
    let text = status.to_string();
    let (_, rest) = text.split_once("\"step\":")?;
    let digits: String = rest.chars().take_while(char::is_ascii_digit).collect();
    digits.parse().ok()
}

#[test]
fn a_training_told_to_end_is_saved_where_it_stands_and_another_worker_goes_on_from_there() {
    let calm = Farm::start("saved-calm");
    let id = submit_saved(&calm, 60.0, 600);
    let _worker = calm.worker("calm");
    assert_eq!(calm.until_ended(&id)["state"], "done");

    let farm = Farm::with_lease("saved-told", 4.0);
    // No checkpoint is due within the duration of this test.
    let id = submit_saved(&farm, 60.0, 600);
    let mut leaver = farm.worker("leaver");
    wait::until("the training to be under way", || {
        step_of(&farm, &id).filter(|step| *step > 5)
    });
    assert_eq!(saved(&farm), Vec::<u64>::new());
    let told = std::time::Instant::now();
    leaver.signal(Signal::Terminate);
    leaver.end().ok();
    eprintln!("ended {:.2} s after SIGTERM", told.elapsed().as_secs_f64());
    let steps = saved(&farm);
    assert!(matches!(steps[..], [step] if step > 5), "{steps:?}");
    assert_eq!(farm.events_of(&id, "released").len(), 1);
    let heir = farm.worker("heir");
    assert_eq!(farm.until_ended(&id)["state"], "done");
    let words = format!("goes on from the checkpoint after {} steps", steps[0]);
    assert!(heir.stderr().contains(&words), "{}", heir.stderr());
    for kind in ["failed", "expired", "dead"] {
        assert_eq!(farm.events_of(&id, kind).len(), 0, "{kind}");
    }
    assert_eq!(weights(&farm), weights(&calm));
}

fn weights(farm: &Farm) -> Vec<u8> {
    let objects = farm.store().join("models/tof");
    let there = store::hashes(&objects);
    let key = there
        .keys()
        .find(|key| key.ends_with("weights.safetensors"));
    fs::read(objects.join(key.expect("the model is there"))).unwrap()
}

#[test]
fn no_more_than_one_step_is_lost_by_a_kill_where_each_step_is_saved() {
    let farm = Farm::with_lease("saved-each", 2.0);
    let id = submit_saved(&farm, 0.0, 150);
    let killed = farm.worker("killed");
    wait::until("some steps", || {
        step_of(&farm, &id).filter(|step| *step > 5)
    });
    // The last progress that it reported before it was killed.
    let said = step_of(&farm, &id).unwrap();
    killed.kill();
    let steps = saved(&farm);
    let newest = *steps.iter().max().expect("each step is saved");
    assert!(newest + 1 >= said, "{newest} saved, {said} done");
    let heir = farm.worker("heir");
    assert_eq!(farm.until_ended(&id)["state"], "done");
    let words = format!("goes on from the checkpoint after {newest} steps");
    assert!(heir.stderr().contains(&words), "{}", heir.stderr());
}

/// Submits a training of one stage with these numbers of processes and of minutes between
/// checkpoints.
fn submit_training(farm: &Farm, optimise: &str, (processes, minutes): (u32, f64)) -> String {
    let rooms = rooms("training", &farm.store());
    let job = format!(
        r#"
{rooms}[[stage]]
name = "tof"
kind = "train"
source = "rooms"
[stage.train]
target = "tof"
model = "tof"
net = {{ width = 8, levels = 3 }}
optimise = {{ {optimise} }}
processes = {processes}
checkpoint_minutes = {minutes}
"#
    );
    let file = farm.store().with_file_name("training.toml");
    fs::write(&file, job).unwrap();
    let answer = farm.json(&["job", "submit", file.to_str().unwrap()]);
    answer["job"].as_str().unwrap().to_owned()
}

#[test]
fn processes_of_one_training_that_are_killed_or_frozen_and_come_again_leave_the_bits_of_one() {
    let wanted = kills_wanted();
    let submitted = |farm: &Farm, processes: u32| {
        let optimise = "epochs = 900, batch = 12, accumulate = 4";
        submit_training(farm, optimise, (processes, 0.02))
    };
    let calm = Farm::with_lease("together-calm", 2.0);
    let id = submitted(&calm, 1);
    let _worker = calm.worker("calm");
    assert_eq!(calm.until_ended(&id)["state"], "done");

    let farm = Farm::with_lease("together-killed", 2.0);
    let id = submitted(&farm, 3);
    let mut rng = Rng::new(23);
    let start = |n: u64| farm.worker(&format!("worker-{n}"));
    let mut workers = vec![start(0), start(1), start(2)];
    let (mut kills, mut said) = (0, String::new());
    while kills < wanted {
        // Waits until all processes train.
        let begun = std::time::Instant::now();
        while farm.status(&id)["state"] == "active"
            && !workers
                .iter_mut()
                .any(|w| w.stderr().contains("processes train together"))
            && begun.elapsed() < Duration::from_secs(60)
        {
            sleep(Duration::from_millis(50));
        }
        sleep(Duration::from_millis(300 + rng.number() % 700));
        if farm.status(&id)["state"] != "active" {
            break;
        }
        // The victim is chosen at random: the leader or another process.
        let which = (rng.number() % 3) as usize;
        let victim = std::mem::replace(&mut workers[which], start(3 + kills));
        said.push_str(&victim.stderr());
        victim.kill();
        kills += 1;
    }
    assert_eq!(farm.until_ended(&id)["state"], "done");
    for worker in &mut workers {
        said.push_str(&worker.stderr());
    }
    assert!(said.contains("processes train together"), "{said}");
    assert!(said.contains("trains together with the process"), "{said}");
    let made = |farm: &Farm| {
        let mut hashes = store::hashes(&farm.store().join("models"));
        hashes.retain(|key, _| !key.contains("checkpoints") && !key.ends_with("speed.json"));
        hashes
    };
    let there = made(&farm);
    assert!(
        there.keys().any(|key| key.contains("weights.safetensors")),
        "{there:?}"
    );
    // The weights are the same, and no calls are left.
    assert_eq!(there, made(&calm), "after {kills} kills");
    eprintln!("{kills} kills");

    // Each worker in turn is frozen for longer than a lease and then resumed. The others continue
    // in the meantime, and a resumed worker does no harm.
    let farm = Farm::with_lease("together-frozen", 2.0);
    let id = submitted(&farm, 3);
    let mut workers: Vec<_> = (0..3).map(|n| farm.worker(&format!("cold-{n}"))).collect();
    wait::until("the processes to train together", || {
        let mut said = workers.iter_mut().map(|worker| worker.stderr());
        said.any(|said| said.contains("processes train together"))
            .then_some(())
    });
    let mut frozen = 0;
    for worker in &mut workers {
        if farm.status(&id)["state"] != "active" {
            break;
        }
        worker.signal(Signal::Stop);
        frozen += 1;
        sleep(Duration::from_secs(4));
        worker.signal(Signal::Continue);
    }
    assert_eq!(farm.until_ended(&id)["state"], "done");
    assert_eq!(made(&farm), made(&calm), "after {frozen} freezes");
    eprintln!("{frozen} freezes");
}

fn flip(file: &Path) {
    let mut bytes = fs::read(file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(file, bytes).unwrap();
}

fn models_can_be_looked_after(farm: &Farm) {
    let (store, folder) = (farm.store(), farm.store().join("models/shadow"));
    let at = store.to_str().unwrap();
    farm.run(&["model", "verify", at]).ok();
    let whole = store::hashes(&folder);
    let of = |part: &str| {
        let key = whole.keys().find(|key| key.ends_with(part));
        folder.join(key.expect("a model has it"))
    };
    // Figures are also stored in the manifest, but weights are not stored anywhere else.
    let (weights, metrics) = (of("weights.safetensors"), of("metrics.json"));
    let sound = fs::read(&weights).unwrap();
    flip(&weights);
    flip(&metrics);
    farm.run(&["model", "verify", at, "shadow"])
        .fails(6, &["weights.safetensors", "metrics.json", "model repair"]);
    farm.run(&["model", "repair", at, "shadow"])
        .fails(6, &["weights.safetensors", "--from-stage"]);
    fs::write(&weights, sound).unwrap();
    farm.run(&["model", "repair", at, "shadow"]).ok();
    assert_eq!(store::hashes(&folder), whole);
    // A model that others build on is not removed.
    farm.run(&["model", "remove", at, "tof"]).fails(
        3,
        &[
            "models were trained with it (shadow)",
            "predictions were made with it",
            "--force",
        ],
    );
    farm.run(&["model", "remove", at, "shadow", "--dry-run"])
        .ok();
    farm.run(&["model", "verify", at]).ok();
    let gone = farm.json(&["model", "remove", at, "shadow", "--force"]);
    assert_eq!(gone["reports"][0], "all");
    assert!(!folder.join("manifest.json").exists());
    farm.run(&["model", "remove", at, "shadow"])
        .fails(3, &["shadow"]);
    farm.run(&["model", "verify", at]).ok();
}

fn predictions_can_be_looked_at(farm: &Farm) {
    let seen = farm.store().join("seen");
    let at = seen.to_str().unwrap();
    let there = farm.json(&["dataset", "info", at]);
    assert_eq!(
        (&there["scenes"], &there["spec"]["depth"]),
        (&16.into(), &true.into())
    );
    let from = farm.json(&["dataset", "show", at, "3"]);
    assert_eq!(from["manifest"]["two_bounce_times"]["model"]["name"], "tof");
    let whole = farm.json(&["dataset", "verify", "--complete", at]);
    assert_eq!(
        (&whole["scenes"], &whole["objects"]),
        (&16.into(), &32.into())
    );
    let whole = store::hashes(&seen);
    fs::remove_file(seen.join("lit/c/3/0/0/0")).unwrap();
    flip(&seen.join("depth/c/5/0/0"));
    farm.run(&["dataset", "verify", "--fast", at])
        .fails(6, &["lit/c/3/0/0/0: missing", "--from-stage"]);
    farm.run(&["dataset", "verify", at])
        .fails(6, &["depth/c/5/0/0", "--from-stage"]);
    farm.run(&["dataset", "repair", at])
        .fails(3, &["what models predict", "--from-stage"]);
    let file = farm.store().with_file_name("calm.toml");
    let file = file.to_str().unwrap();
    let again = farm.json(&["job", "submit", file, "--from-stage", "predict"]);
    assert_eq!(
        farm.until_ended(again["job"].as_str().unwrap())["state"],
        "done"
    );
    assert_eq!(store::hashes(&seen), whole, "what was damaged is put back");
    farm.run(&["dataset", "picture", at, "--out", at])
        .fails(3, &["what models predict"]);
}
