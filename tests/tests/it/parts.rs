//! Heavy scenes in parts, with real processes: several workers share a scene, are killed again and
//! again, and produce the same result as one worker.

use std::{collections::BTreeMap, path::Path};

use picofarm_tests::{Cli, Farm, rng::Rng, store, wait::until};
use serde_json::Value;

fn job(store: &Path, parts: u32) -> String {
    let store = store.display();
    format!(
        r#"name = "heavy"
parts = {parts}
[limits]
max_crashes = 1000
[scenes]
kind = "primitive"
count = 2
seed = 3
spots = 4
[render]
resolution = 64
samples = 4
bin_width_m = 0.384
bins = 64
[output]
store = "{store}"
dataset = "heavy"
"#
    )
}

fn submit(farm: &Farm, cli: &Cli, parts: u32, more: &[&str]) -> String {
    let file = farm.scratch.join("heavy.toml");
    std::fs::write(&file, job(&farm.store(), parts)).expect("the folder is there");
    let file = file.to_str().expect("plain");
    let submitted = cli.json(&[&["job", "submit", file], more].concat());
    submitted["job"].as_str().expect("it has an id").to_owned()
}

fn until_done(cli: &Cli, job: &str) -> Value {
    let status = until("the job to end", || {
        let status = cli.json(&["job", "status", job]);
        (status["state"] != "active").then_some(status)
    });
    assert_eq!(status["state"], "done", "{status}");
    status
}

/// Returns every object, except those that a killed worker may leave while it probes the store.
fn objects(farm: &Farm) -> BTreeMap<String, String> {
    let mut all = store::hashes(&farm.store());
    all.retain(|name, _| !name.starts_with(".probe-"));
    all
}

#[test]
fn workers_that_share_scenes_and_are_killed_give_the_objects_of_one_that_does_not() {
    let calm = Farm::start("parts-calm");
    let cli = calm.cli();
    let whole = submit(&calm, &cli, 1, &[]);
    let _calm = calm.worker("calm");
    until_done(&cli, &whole);

    let wild = Farm::start("parts-wild");
    let cli = wild.cli();
    let parts = submit(&wild, &cli, 5, &[]);
    let status = cli.json(&["job", "status", &parts]);
    let stages: Vec<_> = status["stages"]
        .as_array()
        .expect("it has stages")
        .iter()
        .map(|s| (s["name"].as_str(), s["tasks"]["total"].as_u64()))
        .collect();
    let expected = [(Some("render.parts"), Some(12)), (Some("render"), Some(2))];
    assert_eq!(stages, expected);
    let mut rng = Rng::new(8);
    let mut kills = 0;
    while kills < 8 {
        let workers = [0, 1].map(|w| wild.worker(&format!("wild-{kills}-{w}")));
        std::thread::sleep(std::time::Duration::from_millis(
            200 + (rng.unit() * 500.0) as u64,
        ));
        if cli.json(&["job", "status", &parts])["state"] != "active" {
            break;
        }
        workers.into_iter().for_each(picofarm_tests::Process::kill);
        kills += 1;
    }
    let last = wild.worker("last");
    until_done(&cli, &parts);
    assert!(kills > 0, "it was struck in the middle");
    assert_eq!(objects(&wild), objects(&calm));

    // The whole job finds the parts' result; with force, both stages make it again.
    let plan = wild.scratch.join("heavy.toml");
    std::fs::write(&plan, job(&wild.store(), 1)).expect("the folder is there");
    let plan = cli.json(&["job", "plan", plan.to_str().expect("plain")]);
    assert_eq!((&plan["reuse"], &plan["run"]), (&2.into(), &0.into()));
    let before = wild.logged("part rendered");
    let forced = submit(&wild, &cli, 5, &["--force"]);
    until_done(&cli, &forced);
    assert_eq!(wild.logged("part rendered"), before + 12);
    assert_eq!(objects(&wild), objects(&calm));
    let alarms = cli.run(&["events"]).ok().stdout;
    assert!(!alarms.contains("alarm"), "{alarms}");
    drop(last);
}
