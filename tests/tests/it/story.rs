//! A user's path through the commands: write a job, plan, submit, follow, inspect, stop, repair.

use std::fs;

use picofarm_tests::{Cli, Farm, Job, Scratch, store};
use serde_json::json;

/// Writes the template of `job init` with small settings.
fn small_template(farm: &Farm) {
    let cli = farm.cli();
    let file = cli.json(&["job", "init", "mine.toml", "--kind", "primitive"]);
    assert_eq!(file, json!({"file": "mine.toml"}));
    cli.run(&["job", "init", "mine.toml"])
        .fails(3, &["mine.toml exists and is left as it is"]);
    let path = farm.scratch.join("mine.toml");
    let text = fs::read_to_string(&path).unwrap();
    let small = [
        ("count = 8", "count = 2"),
        ("spots = 25", "spots = 4"),
        ("resolution = 256", "resolution = 16"),
        ("samples = 32", "samples = 4"),
        ("bins = 637", "bins = 64"),
        ("bin_width_m = 0.0384", "bin_width_m = 0.384"),
        ("picofarm-data/store", "store"),
    ];
    let text = small.iter().fold(text, |text, (from, to)| {
        assert!(text.contains(from), "the template has {from:?}");
        text.replacen(from, to, 1)
    });
    fs::write(path, text).unwrap();
}

#[test]
fn a_job_from_its_first_line_to_its_data_set() {
    let farm = Farm::start("story");
    small_template(&farm);

    let plan = farm.json(&["job", "plan", "mine.toml"]);
    assert_eq!(
        (&plan["total"], &plan["run"], &plan["reuse"]),
        (&2.into(), &2.into(), &0.into())
    );
    assert_eq!(
        farm.json(&["job", "list"])["jobs"],
        json!([]),
        "planning changes nothing"
    );

    let submitted = farm.json(&["job", "submit", "mine.toml"]);
    assert_eq!(submitted["existed"], false);
    let id = submitted["job"].as_str().unwrap();
    let status = farm.status(&id[..8]);
    assert_eq!(
        (&status["id"], &status["state"]),
        (&id.into(), &"active".into())
    );
    assert_eq!(status["tasks"]["pending"], 2, "{status}");
    farm.run(&["job", "wait", id, "--timeout-s", "0.2"])
        .fails(1, &["has not ended"]);

    let _worker = farm.worker("worker");
    farm.run(&["job", "watch", id]).ok();
    let ended = farm.json(&["job", "wait", id]);
    assert_eq!(
        (&ended["state"], &ended["tasks"]["done"]),
        (&"done".into(), &2.into())
    );
    assert_eq!(farm.json(&["job", "list"])["jobs"][0]["id"], id);
    farm.committed_once(id, 2);
    let kinds: Vec<_> = farm.events(id).iter().map(|e| e["kind"].clone()).collect();
    assert_eq!(
        (&kinds[0], kinds.last().unwrap()),
        (&json!("submitted"), &json!("ended"))
    );
    let one = farm.json(&["job", "logs", id, "--task", "1"]);
    assert!(
        one.as_array()
            .unwrap()
            .iter()
            .any(|e| e["kind"] == "committed")
    );
    let text = farm.run(&["job", "logs", id]).ok().stdout;
    assert!(
        text.contains("committed") && text.contains("worker"),
        "{text}"
    );

    let place = farm.scratch.join("store/rooms");
    let folder = place.display().to_string();
    assert_eq!(farm.json(&["dataset", "info", &folder])["scenes"], 2);
    let report = farm.json(&["dataset", "verify", &folder]);
    assert_eq!(report["scenes"], 2);
    farm.json(&["dataset", "picture", &folder, "--out", "pictures"]);
    assert!(farm.scratch.join("pictures/contact-sheet.png").is_file());

    // The same file again is the same job, also while nothing runs.
    let times = store::times(&place);
    let again = farm.json(&["job", "submit", "mine.toml"]);
    assert_eq!(
        (&again["job"], &again["existed"]),
        (&id.into(), &true.into())
    );
    let plan = farm.json(&["job", "plan", "mine.toml"]);
    assert_eq!(
        (&plan["run"], &plan["reuse"], &plan["existing_job"]),
        (&0.into(), &2.into(), &id.into())
    );
    assert_eq!(store::times(&place), times);

    // With more scenes, only the new ones run.
    let path = farm.scratch.join("mine.toml");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace("count = 2", "count = 3")).unwrap();
    let plan = farm.json(&["job", "plan", "mine.toml"]);
    assert_eq!((&plan["run"], &plan["reuse"]), (&1.into(), &2.into()));
    let grown = farm
        .run(&["job", "submit", "mine.toml", "--watch", "--json"])
        .ok()
        .json();
    assert_eq!(
        (&grown["tasks"]["done"], &grown["tasks"]["reused"]),
        (&3.into(), &2.into())
    );
    farm.run(&["dataset", "verify", &folder]).ok();
}

#[test]
fn a_cancelled_job_stops_keeps_what_it_has_and_can_be_submitted_again() {
    let farm = Farm::start("cancel");
    let job = Job::slow(&farm.store(), 30);
    let id = farm.submit(&job);
    let mut worker = farm.worker("worker");
    worker.until_says("task starts");
    let cancelled = farm.json(&["job", "cancel", &id]);
    assert_eq!(cancelled["state"], "cancelled");
    farm.run(&["job", "wait", &id])
        .fails(5, &["was cancelled", "--again"]);

    // The worker is free for other work at once.
    let quick = Job {
        name: "other".into(),
        dataset: "other".into(),
        ..Job::quick(&farm.store(), 1)
    };
    let quick_id = farm.submit(&quick);
    farm.until_done_once(&quick, &quick_id);
    assert!(worker.runs());
    let kept = store::finished(&job.place()).len() as u64;
    assert!(kept < 30);

    let file = farm.scratch.join("slow.toml").display().to_string();
    let again = farm.json(&["job", "submit", &file, "--again"]);
    assert_eq!(
        (&again["existed"], &again["plan"]["reuse"]),
        (&false.into(), &kept.into())
    );
    let second = again["job"].as_str().unwrap();
    assert_ne!(second, id);
    farm.json(&["job", "cancel", second]);
}

#[test]
fn a_dead_task_is_retried_after_its_cause_is_corrected() {
    let farm = Farm::start("retry");
    let cli = farm.cli();
    let generate = [
        "scene",
        "generate",
        "--kind",
        "primitive",
        "--spots",
        "4",
        "--resolution",
        "16",
    ];
    for (seed, name) in [("1", "one.glb"), ("2", "two.glb")] {
        cli.json(&[&generate[..], &["--seed", seed, "--out", name]].concat());
    }
    let files = ["one.glb", "two.glb"].map(|name| farm.scratch.join(name));
    let job = Job {
        max_failures: 1,
        ..Job::files(&farm.store(), &[&files[0], &files[1]])
    };
    let id = farm.submit(&job);
    fs::rename(&files[1], farm.scratch.join("elsewhere")).unwrap();
    let _worker = farm.worker("worker");
    farm.run(&["job", "wait", &id])
        .fails(5, &["1 of 2 tasks are dead", "picofarm job retry"]);
    let dead = &farm.events_of(&id, "dead")[0];
    assert!(
        dead["task"] == 1 && dead["message"].as_str().unwrap().contains("two.glb"),
        "{dead}"
    );

    fs::rename(farm.scratch.join("elsewhere"), &files[1]).unwrap();
    assert_eq!(farm.json(&["job", "retry", &id])["retried"], 1);
    farm.until_done_once(&job, &id);
    assert_eq!(farm.json(&["job", "retry", &id])["retried"], 0);
}

#[test]
fn a_scene_file_that_changed_after_submission_is_not_rendered() {
    let farm = Farm::start("changed");
    let cli = farm.cli();
    let generate = [
        "scene",
        "generate",
        "--kind",
        "primitive",
        "--resolution",
        "16",
        "--out",
        "one.glb",
    ];
    cli.json(&[&generate[..], &["--seed", "1"]].concat());
    let file = farm.scratch.join("one.glb");
    let job = Job {
        max_failures: 1,
        ..Job::files(&farm.store(), &[&file])
    };
    let id = farm.submit(&job);
    cli.json(&[&generate[..], &["--seed", "2"]].concat());
    let _worker = farm.worker("worker");
    farm.run(&["job", "wait", &id]).code(5);
    let dead = &farm.events_of(&id, "dead")[0];
    let message = dead["message"].as_str().unwrap();
    assert!(
        message.contains("one.glb") && message.contains("SHA-256"),
        "{message}"
    );
    assert!(store::finished(&job.place()).is_empty());
}

#[test]
fn settings_come_from_flag_then_environment_then_file() {
    let scratch = Scratch::new("settings");
    let cli = Cli::new(scratch.path());
    let setting = |cli: &Cli, args: &[&str]| {
        let all = cli.json(&[&["config"], args].concat());
        let field = |name: &str| all["coordinator"][name].as_str().unwrap().to_owned();
        (field("value"), field("source"))
    };
    let default = ("http://127.0.0.1:7420".to_owned(), "default".to_owned());
    assert_eq!(setting(&cli, &[]), default);
    fs::write(
        scratch.join("picofarm.toml"),
        "coordinator = \"http://file:1\"\n",
    )
    .unwrap();
    let (value, source) = setting(&cli, &[]);
    assert!(
        value == "http://file:1" && source.contains("picofarm.toml"),
        "{value} {source}"
    );
    let set = cli
        .clone()
        .with("PICOFARM_COORDINATOR", "http://environment:2");
    let (value, source) = setting(&set, &[]);
    assert!(
        value == "http://environment:2" && source.contains("PICOFARM_COORDINATOR"),
        "{source}"
    );
    let (value, source) = setting(&set, &["--coordinator", "http://flag:3"]);
    assert_eq!((value.as_str(), source.as_str()), ("http://flag:3", "flag"));
    let secret = cli
        .clone()
        .with("PICOFARM_COORDINATOR", "http://me:hush@environment:2");
    assert_eq!(setting(&secret, &[]).0, "http://…@environment:2");

    fs::write(scratch.join("picofarm.toml"), "cordinator = \"x\"\n").unwrap();
    cli.run(&["config"]).fails(3, &["cordinator"]);
    cli.run(&["config", "--config", "absent.toml"])
        .fails(3, &["absent.toml"]);
}

#[test]
fn a_healthy_machine_passes_the_doctor_and_a_folder_that_cannot_store_does_not() {
    let farm = Farm::start("doctor");
    let mistyped = farm.json(&["doctor", "--store", "stoer"]);
    let checks = mistyped.as_array().unwrap();
    let store = checks.iter().find(|c| c["what"] == "store").unwrap();
    assert_eq!(store["verdict"], "note", "{store}");
    assert!(!farm.scratch.join("stoer").exists());
    fs::create_dir_all(farm.store()).unwrap();
    let checks = farm.json(&["doctor", "--store", "store"]);
    let checks = checks.as_array().unwrap();
    let verdict =
        |what: &str| checks.iter().find(|c| c["what"] == what).unwrap()["verdict"].clone();
    assert_eq!(
        (verdict("store"), verdict("coordinator")),
        (json!("ok"), json!("ok"))
    );
    assert_ne!(verdict("disk"), json!("bad"));
    fs::write(farm.scratch.join("occupied"), "a file").unwrap();
    farm.run(&["doctor", "--store", "occupied"])
        .fails(7, &["store"]);
}

#[test]
fn help_version_and_completions_are_there_for_every_shell() {
    let scratch = Scratch::new("help");
    let cli = Cli::new(scratch.path());
    let version = cli.run(&["--version"]).ok().stdout;
    assert!(version.starts_with("picofarm ") && version.contains(env!("CARGO_PKG_VERSION")));
    assert!(version.contains("\nfeatures: "), "{version}");
    let help = cli.run(&["--help"]).ok().stdout;
    assert!(
        help.contains("Exit codes:") && help.contains("130"),
        "{help}"
    );
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let script = cli.run(&["completions", shell]).ok().stdout;
        assert!(
            script.contains("picofarm") && script.contains("dataset"),
            "{shell}"
        );
    }
    cli.run(&["completions", "tcsh"]).code(2);
}
