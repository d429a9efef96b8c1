//! A sweep over real workers: trials that fall behind leave them to others, one worker is killed,
//! the best model gets its name, and more trials later are further ones: drawn, or chosen by what
//! was found. TensorBoard reads what came out, where `PICOFARM_PYTHON` names a Python that has it.

use std::{fs, path::Path, thread::sleep, time::Duration};

use picofarm_tests::{Farm, Rooms, store};

fn job(store: &Path, trials: u64, promote: &str) -> String {
    let rooms = Rooms::small(12).split_stages(store, [8, 2, 2]);
    format!(
        r#"
name = "sweep of {trials}"
[limits]
max_crashes = 1000
{rooms}[[stage]]
name = "tof"
kind = "train"
source = "rooms"
[stage.sweep]
trials = {trials}
seed = 2
promote = {promote:?}
stop = {{ halving = {{ first = 4, factor = 3 }} }}
over = {{ lr = {{ log = [1e-5, 3e-2] }}, width = {{ int = [2, 6] }} }}
[stage.train]
target = "tof"
model = "depth"
net = {{ width = "{{width}}", levels = 3 }}
optimise = {{ learning_rate = "{{lr}}", epochs = 108, batch = 4 }}
checkpoint_minutes = 0.01
[[stage]]
kind = "evaluate"
source = "rooms"
evaluate = {{ models = ["tof"] }}
"#
    )
}

fn write(farm: &Farm, trials: u64, promote: &str) -> String {
    let file = farm.store().with_file_name(format!("{trials}.toml"));
    fs::write(&file, job(&farm.store(), trials, promote)).unwrap();
    file.to_str().unwrap().to_owned()
}

#[test]
fn a_sweep_stops_what_falls_behind_and_names_the_best_although_a_worker_is_killed() {
    let farm = Farm::with_lease("sweep", 2.0);
    let answer = farm.json(&["job", "submit", &write(&farm, 6, "best")]);
    let id = answer["job"].as_str().unwrap().to_owned();
    let _one = farm.worker("one");
    let other = farm.worker("other");
    // Kills the worker while the other trial is training.
    let begun = std::time::Instant::now();
    while !other.stderr().contains("stage=\"tof.") && farm.status(&id)["state"] == "active" {
        sleep(Duration::from_millis(20));
        assert!(
            begun.elapsed() < Duration::from_secs(120),
            "{}",
            other.stderr()
        );
    }
    other.kill();
    let _another = farm.worker("another");
    assert_eq!(farm.until_ended(&id)["state"], "done");

    let store = farm.store();
    let store = store.to_str().unwrap();
    let sweep = farm.json(&["sweep", "status", store, "depth"]);
    let trials = sweep["trials"].as_array().unwrap();
    assert_eq!(trials.len(), 6, "{sweep}");
    let ended = |end: &str| trials.iter().filter(|t| t["end"] == end).count();
    let epochs: u64 = trials.iter().map(|t| t["epochs"].as_u64().unwrap()).sum();
    assert_eq!(ended("finished") + ended("pruned"), 6, "{sweep}");
    assert!(ended("finished") >= 1 && ended("pruned") >= 1, "{sweep}");
    assert!(epochs < 6 * 108, "{epochs}");
    let best = farm.json(&["sweep", "best", store, "depth"]);
    let model = best["model"].as_str().unwrap();
    let named = farm.json(&["model", "show", store, "best"]);
    let promoted = &named["manifest"]["lineage"]["promoted"];
    assert_eq!(promoted["model"], model);
    assert_eq!(promoted["begun"], 6);
    assert_eq!(named["evaluations"].as_array().unwrap().len(), 1);
    let table = farm.store().with_file_name("sweep.csv");
    let out = table.to_str().unwrap();
    farm.run(&["sweep", "export", store, "depth", "--out", out])
        .ok();
    let text = std::fs::read_to_string(&table).unwrap();
    let rows: Vec<&str> = text.split_terminator("\r\n").collect();
    assert_eq!(rows.len(), 7, "{text}");
    assert!(rows[0].starts_with("trial,model,end,epochs,"), "{text}");
    farm.run(&["sweep", "export", store, "depth", "--curves", "--out", out])
        .ok();
    let text = std::fs::read_to_string(&table).unwrap();
    let epochs: usize = trials
        .iter()
        .map(|t| t["history"].as_array().unwrap().len())
        .sum();
    assert_eq!(text.split_terminator("\r\n").count(), 1 + epochs, "{text}");
    let page = farm.store().with_file_name("sweep.html");
    farm.json(&[
        "sweep",
        "report",
        store,
        "depth",
        "--out",
        page.to_str().unwrap(),
    ]);
    assert!(fs::read_to_string(&page).unwrap().contains(model));

    // When trials are added, those that have ended do not change.
    let hashes = || {
        let mut hashes = store::hashes(&farm.store().join("models"));
        hashes.retain(|key, _| key.contains("/trials/") && !key.ends_with("trials/6.json"));
        hashes
    };
    let before = hashes();
    let file = write(&farm, 7, "better");
    let plan = farm.json(&["job", "plan", &file]);
    // 12 rooms, the split and six trials exist.
    assert_eq!(
        (&plan["reuse"], &plan["run"]),
        (&19.into(), &3.into()),
        "{plan}"
    );
    let answer = farm.json(&["job", "submit", &file]);
    let id = answer["job"].as_str().unwrap();
    let ended = farm.until_ended(id);
    assert_eq!(ended["state"], "done");
    assert_eq!(hashes(), before);
    let sweep = farm.json(&["sweep", "status", store, "depth"]);
    assert_eq!(sweep["trials"].as_array().unwrap().len(), 7);
}

/// A job with a sweep of one stage for extension, and a sweep of values chosen by hand.
fn learning(store: &Path) -> String {
    let rooms = Rooms::small(8).split_stages(store, [5, 2, 1]);
    format!(
        r#"# What follows keeps its comments.
name = "search"
[limits]
max_crashes = 1000
{rooms}[[stage]]
name = "tof"
kind = "train"
source = "rooms"
[stage.sweep]
trials = 10        # drawn
seed = 2
stop = {{ median = {{ first = 2, least = 4 }} }}
[stage.sweep.over] # learning rate and width
lr = {{ log = [1e-5, 3e-2] }}
width = {{ int = [2, 6] }}
precision = ["f32", "bf16"]
[stage.train]
target = "tof"
model = "depth"
net = {{ width = "{{width}}", levels = 2 }}
optimise = {{ learning_rate = "{{lr}}", precision = "{{precision}}", epochs = 6, batch = 2 }}
[[stage]]
name = "hand"
kind = "train"
source = "rooms"
sweep = {{ values = [{{ lr = 1e-2 }}, {{ lr = 1e-3 }}], stop = {{ hyperband = {{ first = 2 }} }} }}
train = {{ target = "tof", model = "by-hand", net = {{ width = 3, levels = 2 }}, optimise = {{ learning_rate = "{{lr}}", epochs = 4, batch = 2 }} }}
[[stage]]
kind = "evaluate"
source = "rooms"
evaluate = {{ models = ["tof"] }}
"#
    )
}

#[test]
fn a_sweep_is_extended_by_what_its_trials_found_and_only_new_ones_are_trained() {
    let farm = Farm::start("extend");
    let (place, text) = (farm.store(), farm.store().display().to_string());
    let store = text.as_str();
    let file = place.with_file_name("search.toml");
    fs::write(&file, learning(&place)).unwrap();
    let path = |name: &str| place.with_file_name(name).display().to_string();
    let first = path("search.toml");
    let submitted = farm.json(&["job", "submit", &first]);
    let _one = farm.worker("one");
    let _other = farm.worker("other");
    let ended = farm.until_ended(submitted["job"].as_str().unwrap());
    assert_eq!(ended["state"], "done", "{ended}");

    // The same records give the same file; a random sampler gives another.
    let extended = farm.json(&["sweep", "extend", &first, "--trials", "3", "--stage", "tof"]);
    let next = path("search-13.toml");
    assert_eq!(extended["file"], next.as_str());
    assert_eq!(extended["ended"], 10);
    let proposed = extended["trials"].as_array().unwrap();
    let numbers: Vec<u64> = proposed
        .iter()
        .map(|t| t["trial"].as_u64().unwrap())
        .collect();
    assert_eq!(numbers, [10, 11, 12]);
    let again = path("again.toml");
    let extend = [
        "sweep", "extend", &first, "--trials", "3", "--stage", "tof", "--out", &again,
    ];
    farm.json(&extend);
    assert_eq!(fs::read(&again).unwrap(), fs::read(&next).unwrap());
    farm.json(&extend);
    // Another proposal never replaces a file, because a user may have edited it.
    let other = [&extend[..], &["--sampler", "random"]].concat();
    farm.run(&other)
        .fails(3, &["again.toml", "is there", "--out"]);
    assert_eq!(fs::read(&again).unwrap(), fs::read(&next).unwrap());
    fs::remove_file(&again).unwrap();
    farm.json(&other);
    assert_ne!(fs::read(&again).unwrap(), fs::read(&next).unwrap());
    let written = fs::read_to_string(&next).unwrap();
    assert!(
        written.starts_with("# What follows keeps its comments.\n")
            && written.contains("# learning rate and width"),
        "{written}"
    );
    farm.run(&["sweep", "extend", &first, "--trials", "3"])
        .fails(3, &["several sweeps", "--stage tof | hand"]);
    farm.run(&[
        "sweep", "extend", &first, "--trials", "3", "--stage", "hand",
    ])
    .fails(3, &["sweep.over", "is missing"]);
    let elsewhere = std::env::temp_dir().join("x.toml").display().to_string();
    farm.run(&[
        "sweep", "extend", &first, "--trials", "1", "--stage", "tof", "--out", &elsewhere,
    ])
    .fails(3, &["another folder"]);

    // Finished tasks are reused: 8 rooms, the split, ten and two trials, and the values chosen by
    // hand.
    let hashes = || {
        let mut hashes = store::hashes(&place.join("models"));
        hashes.retain(|key, _| key.contains("/trials/"));
        hashes
    };
    let before = hashes();
    assert_eq!(before.len(), 12);
    let plan = farm.json(&["job", "plan", &next]);
    assert_eq!(
        (&plan["reuse"], &plan["run"]),
        (&22.into(), &5.into()),
        "{plan}"
    );
    // Submits that file, and then one with another trial.
    let run = [
        "sweep", "run", &next, "--trials", "1", "--rounds", "1", "--stage", "tof",
    ];
    let rounds = farm.json(&run);
    assert_eq!(rounds["rounds"][1]["file"], path("search-14.toml").as_str());
    let after = hashes();
    assert_eq!(after.len(), 16);
    assert!(
        before
            .iter()
            .all(|(key, hash)| after.get(key) == Some(hash))
    );
    let sweep = farm.json(&["sweep", "status", store, "depth"]);
    let trials = sweep["trials"].as_array().unwrap();
    assert_eq!(trials.len(), 14);
    for (trial, proposed) in trials[10..13].iter().zip(proposed) {
        let values = trial["values"].as_array().unwrap();
        for pair in values {
            assert_eq!(
                pair[1].as_f64(),
                proposed["values"][pair[0].as_str().unwrap()].as_f64()
            );
        }
    }
    for name in ["depth", "depth-13", "depth-14"] {
        farm.json(&["model", "show", store, name]);
    }
    // Run again, it finds everything done.
    assert_eq!(farm.json(&run)["rounds"], rounds["rounds"]);

    let compared = farm.json(&["sweep", "compare", store, "depth", "by-hand"]);
    let epochs: u64 = trials.iter().map(|t| t["epochs"].as_u64().unwrap()).sum();
    let one = &compared[0];
    assert_eq!(one["epochs"], epochs);
    let count = ["finished", "stopped", "diverged"].map(|end| one[end].as_u64().unwrap());
    assert_eq!(count.iter().sum::<u64>(), 14, "{one}");
    let best = farm.json(&["sweep", "best", store, "depth"]);
    assert_eq!(
        (&one["best"]["model"], &one["best"]["loss"]),
        (&best["model"], &best["loss"])
    );
    assert_eq!(compared[1]["best"]["values"].as_object().unwrap().len(), 1);
    farm.run(&["sweep", "compare", store, "depth"])
        .fails(3, &["nothing to compare it with"]);

    let page = path("sweep.html");
    farm.json(&["sweep", "report", store, "depth", "--out", &page]);
    let Some(python) = std::env::var_os("PICOFARM_PYTHON") else {
        eprintln!(
            "SKIPPED reading event files: tests/run installs a Python with tensorboard, PICOFARM_PYTHON names it"
        );
        return;
    };
    let run = |args: &[&str]| farm.cli().run_other(&python, args).ok();
    let script = Path::new(&picofarm_tests::package()).join("../docs/python/tensorboard_events.py");
    let script = script.display().to_string();
    run(&["-B", &script, &path("sweep.json"), &path("runs")]);
    for trial in trials {
        let model = trial["model"].as_str().unwrap();
        let loss = run(&["-B", "-c", READ_LOSS, &path("runs"), model]).json();
        let history = trial["history"].as_array().unwrap();
        assert_eq!(loss.as_array().unwrap().len(), history.len());
        for (point, line) in loss.as_array().unwrap().iter().zip(history) {
            assert_eq!(point[0], line["step"]);
            let (found, stored) = (point[1].as_f64(), line["loss"].as_f64());
            assert!(
                (found.unwrap() / stored.unwrap() - 1.0).abs() < 1e-6,
                "{point} {line}"
            );
        }
    }
}

/// Prints the steps and losses of a run as TensorBoard's own reader finds them.
const READ_LOSS: &str = "\
import json, sys
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
events = EventAccumulator('/'.join(sys.argv[1:])).Reload().Scalars('loss')
print(json.dumps([[e.step, e.value] for e in events]))
";
