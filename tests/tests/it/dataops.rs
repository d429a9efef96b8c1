//! Data derived from data: `dataset reprocess` and `dataset split`, when killed, stopped, repeated,
//! and given invalid arguments.

use std::{
    fs,
    path::{Path, PathBuf},
};

use picofarm_tests::{Cli, Farm, Job, Signal, store, wait::until};
use serde_json::json;

/// Number of scenes that take long enough together to be interrupted.
const COUNT: u64 = 40;

/// Starts a farm with a store of `count` small finished scenes.
fn source(name: &str, count: u64) -> (Farm, Job) {
    let farm = Farm::start(name);
    let job = Job::quick(&farm.store(), count);
    let id = farm.submit(&job);
    let _worker = farm.worker("renderer");
    farm.until_ended(&id);
    assert_eq!(store::finished(&job.place()).len() as u64, count);
    (farm, job)
}

struct Reprocess {
    cli: Cli,
    source: String,
    store: PathBuf,
}

impl Reprocess {
    fn of(farm: &Farm, job: &Job) -> Self {
        Self {
            cli: farm.cli(),
            source: job.place().display().to_string(),
            store: job.store.clone(),
        }
    }

    fn place(&self, target: &str) -> PathBuf {
        self.store.join(target)
    }

    fn args<'a>(&'a self, target: &'a str, more: &[&'a str]) -> Vec<&'a str> {
        [&["dataset", "reprocess", &self.source, target], more].concat()
    }
}

#[test]
fn a_reprocess_killed_again_and_again_gives_what_an_undisturbed_one_gives() {
    let (farm, job) = source("reprocess-killed", COUNT);
    let reprocess = Reprocess::of(&farm, &job);
    let sensor = ["--rebin", "4", "--peak-photons", "10..400"];
    let calm = reprocess.place("calm").display().to_string();
    let whole = reprocess.cli.json(&reprocess.args(&calm, &sensor));
    assert_eq!(
        (&whole["computed"], &whole["adopted"]),
        (&json!(COUNT), &json!(0))
    );

    let stormy = reprocess.place("stormy");
    let target = stormy.display().to_string();
    let args = reprocess.args(&target, &sensor);
    for round in 0..3 {
        let process = reprocess.cli.start("struck", &args);
        let far = || (store::finished(&stormy).len() > 8 * round).then_some(());
        until("some scenes", far);
        process.kill();
    }
    let before = store::finished(&stormy).len();
    assert!(before < COUNT as usize, "nothing was left to strike");
    let rest = reprocess.cli.json(&args);
    assert_eq!(rest["adopted"], before);
    assert_eq!(rest["computed"], COUNT as usize - before);
    assert_eq!(rest["bytes"], whole["bytes"]);
    assert!(store::hashes(&stormy) == store::hashes(&reprocess.place("calm")));
    // The second run writes nothing.
    let times = store::times(&stormy);
    assert_eq!(reprocess.cli.json(&args)["adopted"], COUNT);
    assert!(store::times(&stormy) == times);
    reprocess.cli.run(&["dataset", "verify", &target]).ok();
}

#[test]
fn ctrl_c_keeps_what_is_finished_and_says_how_to_go_on() {
    let (farm, job) = source("reprocess-stopped", COUNT);
    let reprocess = Reprocess::of(&farm, &job);
    let place = reprocess.place("counts");
    let target = place.display().to_string();
    let args = reprocess.args(&target, &[]);
    let mut process = reprocess.cli.start("stopped", &args);
    until("a scene", || {
        (!store::finished(&place).is_empty()).then_some(())
    });
    process.signal(Signal::Interrupt);
    process
        .end()
        .fails(130, &["interrupted", "same command again"]);
    let kept = store::finished(&place).len();
    assert!((1..COUNT as usize).contains(&kept));
    assert_eq!(reprocess.cli.json(&args)["adopted"], kept);
}

#[test]
fn what_cannot_be_reprocessed_is_named_and_nothing_is_written() {
    let (farm, job) = source("reprocess-refused", 2);
    let reprocess = Reprocess::of(&farm, &job);
    let target = reprocess.place("target").display().to_string();
    let run = |more: &[&str]| reprocess.cli.run(&reprocess.args(&target, more));
    run(&["--rebin", "5"]).fails(
        3,
        &[
            "reprocess.sensor.rebin: 5 does not divide",
            "64 bins",
            "--drop-left-over",
        ],
    );
    run(&["--histogram", "transient_9"]).fails(2, &["--histogram", "transient_25"]);
    run(&["--histogram", "transient_25"]).fails(3, &["reprocess.histogram", "it has transient"]);
    run(&["--histogram", "transient_spots"]).fails(3, &["reprocess.spots"]);
    run(&["--spots", "1"]).fails(3, &["reprocess.spots"]);
    run(&["--dark=-1"]).fails(3, &["dark_per_bin"]);
    run(&["--no-poisson", "--profile", "counts-u16"]).fails(3, &["output.profile"]);
    run(&["--profile", "gzip"]).fails(3, &["output.profile", "\"gzip\""]);
    let nowhere = reprocess.place("nowhere").display().to_string();
    let args = ["dataset", "reprocess", &nowhere, &target];
    reprocess
        .cli
        .run(&args)
        .fails(3, &["source: ", "no data set here"]);
    assert!(!Path::new(&target).exists());
    run(&[]).ok();
    let before = store::hashes(Path::new(&target));
    run(&["--seed", "1"]).fails(3, &["output.dataset", "another job"]);
    run(&["--rebin", "4"]).fails(3, &["gate.bin"]);
    assert!(store::hashes(Path::new(&target)) == before);
}

#[test]
fn a_split_is_exact_repeatable_and_grows_without_moving_a_scene() {
    let (farm, job) = source("split", 10);
    let place = job.place().display().to_string();
    let split = |more: &[&str]| farm.run(&[&["dataset", "split", &place], more].concat());
    split(&["--show"]).fails(3, &["split.name", "--counts"]);
    split(&[]).fails(2, &["--counts"]);
    split(&["--counts", "8,1,2"]).fails(3, &["split.counts", "11", "10 scenes"]);
    let counts = ["--counts", "7,1,2", "--json"];
    let made = split(&counts).ok().json();
    assert_eq!(
        made["counts"],
        json!({"train": 7, "validation": 1, "test": 2})
    );
    assert_eq!(
        (&made["version"], &made["changed"]),
        (&json!(1), &json!(true))
    );
    let file = job.place().join("splits/default/v1.json");
    let v1 = fs::read(&file).unwrap();
    let again = split(&counts).ok().json();
    assert_eq!(
        (&again["version"], &again["changed"]),
        (&json!(1), &json!(false))
    );
    assert_eq!(
        split(&["--show", "--json"]).ok().json()["sha256"],
        made["sha256"]
    );
    split(&["--counts", "7,2,1"]).fails(3, &["split.parts", "[7, 1, 2]", "[7, 2, 1]"]);
    split(&["--counts", "7,1,2", "--seed", "9"]).fails(3, &["split.seed"]);
    split(&["--fractions", "0.5,0.5,0", "--name", "half"]).ok();

    let grown = Job {
        name: "more".into(),
        count: Some(16),
        ..job.clone()
    };
    let id = farm.submit(&grown);
    let _worker = farm.worker("renderer-2");
    farm.until_ended(&id);
    let two = split(&counts).ok().json();
    assert_eq!((&two["version"], &two["made_of"]), (&json!(2), &json!(10)));
    let sides = |bytes: &[u8]| {
        let record: serde_json::Value = serde_json::from_slice(bytes).unwrap();
        record["sides"].as_str().unwrap().to_owned()
    };
    let v2 = fs::read(job.place().join("splits/default/v2.json")).unwrap();
    assert!(sides(&v2).starts_with(&sides(&v1)) && sides(&v2).len() == 16);
    assert_eq!(fs::read(&file).unwrap(), v1);
    farm.run(&["dataset", "verify", &place]).ok();
}

#[test]
fn a_verify_stage_names_the_damaged_scene_and_is_done_when_it_is_repaired() {
    let (farm, job) = source("verify-stage", 4);
    let place = job.place().display().to_string();
    let file = farm.scratch.join("verify.toml");
    let text = format!(
        "name = \"verify\"\n[limits]\nmax_failures = 1\n[[stage]]\nkind = \"verify\"\n\
         source = {{ store = {:?}, dataset = {:?} }}\n",
        job.store, job.dataset
    );
    fs::write(&file, text).unwrap();
    let broken = job.place().join("transient/c/2/0/0/0");
    let whole = fs::read(&broken).unwrap();
    let mut bytes = whole.clone();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&broken, &bytes).unwrap();

    let before = store::hashes(&job.place());
    let _worker = farm.worker("verifier");
    let id = farm.json(&["job", "submit", file.to_str().unwrap()]);
    let id = id["job"].as_str().unwrap();
    farm.until_ended(id);
    assert_eq!((farm.count(id, "done"), farm.count(id, "dead")), (3, 1));
    let explained = farm.run(&["job", "explain", id, "--task", "2"]).ok().stdout;
    for part in [
        "scene 2 is damaged",
        "transient/c/2/0/0/0",
        "dataset repair",
    ] {
        assert!(explained.contains(part), "{part}: {explained}");
    }
    assert_eq!(store::hashes(&job.place()), before, "nothing is written");

    farm.run(&["dataset", "repair", &place]).ok();
    assert_eq!(fs::read(&broken).unwrap(), whole);
    farm.run(&["job", "retry", id]).ok();
    farm.until_ended(id);
    assert_eq!(farm.count(id, "done"), 4);

    // The sizes alone do not reveal the damage.
    fs::write(&broken, &bytes).unwrap();
    let text = fs::read_to_string(&file).unwrap() + "verify = { fast = true }\n";
    fs::write(&file, text).unwrap();
    let id = farm.json(&["job", "submit", file.to_str().unwrap()]);
    let id = id["job"].as_str().unwrap();
    farm.until_ended(id);
    assert_eq!(farm.count(id, "done"), 4);
}
