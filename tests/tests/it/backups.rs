//! Backups of the catalog of a farm at work, jobs that wait for others, and usage.

use std::fs;

use picofarm_tests::{Farm, Job, store, wait::until};
use serde_json::{Value, json};

/// Returns the sorted tasks of a job's events of these kinds.
fn tasks(farm: &Farm, job: &str, kinds: &[&str]) -> Vec<u64> {
    let mut tasks = Vec::new();
    for event in farm.events(job) {
        if kinds.iter().any(|kind| event["kind"] == *kind) {
            let end = |name: &str| event[name].as_u64().unwrap();
            tasks.extend(end("lo")..end("hi"));
        }
    }
    tasks.sort_unstable();
    tasks
}

#[test]
fn a_coordinator_goes_on_from_a_backup_of_a_running_farm_and_nothing_is_lost_or_doubled() {
    let mut farm = Farm::with_lease("backup", 10.0);
    let job = Job {
        samples: 64,
        ..Job::quick(&farm.store(), 30)
    };
    let id = farm.submit(&job);
    let _worker = farm.worker("worker");
    let at_least = |n| (farm.count(&id, "done") >= n).then_some(());
    until("some scenes", || at_least(5));
    let catalog = ["--catalog", "catalog.sqlite"];
    let made = farm.json(&[&["catalog", "backup", "copy.sqlite"], &catalog[..]].concat());
    assert_eq!(made["jobs"], 1);
    let restore = [
        &["catalog", "restore", "copy.sqlite", "--force"],
        &catalog[..],
    ]
    .concat();
    farm.run(&restore)
        .fails(7, &["held by another coordinator"]);
    farm.run(&[&["catalog", "backup", "copy.sqlite"], &catalog[..]].concat())
        .fails(3, &["copy.sqlite exists", "--force"]);
    let copied = farm.count(&id, "done");
    until("more scenes", || at_least(copied + 3));
    let times = store::times(&job.place());

    farm.kill_coordinator();
    farm.json(&restore);
    farm.start_coordinator();
    let status = farm.until_ended(&id);
    assert_eq!(
        (&status["state"], &status["tasks"]["done"]),
        (&json!("done"), &json!(30))
    );
    let all: Vec<u64> = (0..30).collect();
    assert_eq!(tasks(&farm, &id, &["committed", "reused"]), all);
    // Scenes of the time after the backup were taken over.
    assert!(tasks(&farm, &id, &["reused"]).len() >= 3);
    let now = store::times(&job.place());
    assert!(times.iter().all(|(file, time)| now[file] == *time));
    farm.run(&["dataset", "verify", &job.place().display().to_string()])
        .ok();
}

#[test]
fn a_catalog_in_postgres_is_left_to_its_own_programs() {
    let farm = Farm::start("backup-postgres");
    let url = "postgres://me:secret@localhost/farm";
    let ended = farm.run(&["catalog", "backup", "copy", "--catalog", url]);
    assert!(!ended.stderr.contains("secret"), "{}", ended.stderr);
    ended.fails(3, &["me@localhost/farm", "pg_dump"]);
    farm.run(&["catalog", "restore", "copy", "--catalog", url])
        .fails(3, &["pg_restore"]);
}

#[test]
fn a_job_waits_for_the_job_that_its_file_names_and_usage_counts_both() {
    let farm = Farm::start("after");
    farm.submit(&Job::quick(&farm.store(), 2));
    let later = Job {
        dataset: "later".into(),
        name: "later".into(),
        ..Job::quick(&farm.store(), 3)
    };
    let file = farm.scratch.join("later.toml");
    let submit = |after: &str| {
        fs::write(&file, format!("after = {after}\n{}", later.toml())).unwrap();
        farm.run(&["job", "submit", "later.toml", "--json"])
    };
    submit("[7]").fails(3, &["after: no job", "7"]);
    submit("[1.5]").fails(3, &["later.toml"]);
    let id = submit("[1, \"quick\"]").ok().json()["job"].clone();
    let id = id.as_str().unwrap();
    let why = farm.run(&["job", "explain", id]).ok().stdout;
    assert!(
        why.contains("until other jobs are done (`after`): job 1"),
        "{why}"
    );
    let _worker = farm.worker("worker");
    assert_eq!(farm.until_ended(id)["state"], "done");
    let begun = |job: &str| farm.events_of(job, "leased")[0]["sequence"].as_u64();
    let ended = farm.events_of("1", "ended")[0]["sequence"].as_u64();
    assert!(begun(id) > ended);

    let usage = farm.json(&["usage", "--by", "user"]);
    let row = &usage[0];
    assert_eq!((&row["user"], &row["tasks"]), (&json!("anyone"), &json!(5)));
    assert!(row["core_seconds"].as_f64().unwrap() > 0.0 && row["bytes"].as_u64().unwrap() > 0);
    let old = farm.json(&["usage", "--by", "day", "--until", "2020-01-01"]);
    assert_eq!(old, Value::Array(vec![]));
    farm.run(&["usage", "--since", "2020-01-02", "--until", "2020-01-01"])
        .fails(3, &["--until: the day is before --since"]);
}
