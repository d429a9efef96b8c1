//! A sweep over real workers: trials that fall behind leave them to others, one worker is killed, the best model gets its
//! name, and more trials later are further ones.

use std::{fs, path::Path, thread::sleep, time::Duration};

use picofarm_tests::{Farm, store};

fn job(store: &Path, trials: u64, promote: &str) -> String {
    format!(
        r#"
name = "sweep of {trials}"
[limits]
max_crashes = 1000
[[stage]]
name = "rooms"
scenes = {{ kind = "primitive", count = 12, seed = 3, spots = 4 }}
render = {{ resolution = 16, samples = 2, bins = 32, bin_width_m = 0.768 }}
output = {{ store = {store:?}, dataset = "rooms" }}
[[stage]]
kind = "split"
source = "rooms"
split = {{ counts = [8, 2, 2] }}
[[stage]]
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
    // Into a training of the other.
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

    // More trials are further ones: those that have ended stay as they are.
    let hashes = || {
        let mut hashes = store::hashes(&farm.store().join("models"));
        hashes.retain(|key, _| key.contains("/trials/") && !key.ends_with("trials/6.json"));
        hashes
    };
    let before = hashes();
    let file = write(&farm, 7, "better");
    let plan = farm.json(&["job", "plan", &file]);
    // 12 rooms, the split and six trials are there.
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
