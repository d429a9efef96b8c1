//! Scene files that are corrected after their job was submitted: finished scenes are taken over,
//! only the corrected file is rendered, and a scene of other content never counts for it.

use std::{
    fs,
    path::{Path, PathBuf},
};

use picofarm_tests::{Cli, Farm, Job, farm::undisturbed, store};
use serde_json::Value;

/// A scene file of a small room.
fn room(cli: &Cli, file: &Path, seed: u64) {
    let (seed, file) = (seed.to_string(), file.display().to_string());
    let args = ["scene", "generate", "--kind", "primitive", "--spots", "4"];
    let more = ["--resolution", "16", "--seed", &seed, "--out", &file];
    cli.json(&[&args[..], &more].concat());
}

/// So many scene files, of which `broken` begins as a `.glb` file does and has no more.
fn rooms(farm: &Farm, count: u64, broken: Option<usize>) -> Vec<PathBuf> {
    let name = |i| farm.scratch.join(&format!("room-{i}.glb"));
    let files: Vec<PathBuf> = (0..count).map(name).collect();
    for (seed, file) in (1..).zip(&files) {
        room(&farm.cli(), file, seed);
    }
    if let Some(broken) = broken {
        fs::write(&files[broken], b"glTF but no more").unwrap();
    }
    files
}

fn job(farm: &Farm, files: &[PathBuf]) -> Job {
    let files: Vec<&Path> = files.iter().map(PathBuf::as_path).collect();
    Job {
        max_failures: 1,
        ..Job::files(&farm.store(), &files)
    }
}

fn id(answer: &Value) -> String {
    answer["job"].as_str().expect("it names a job").to_owned()
}

/// The tasks that a job rendered, and the number of those that it took over.
fn rendered(farm: &Farm, job: &str) -> (Vec<u64>, u64) {
    let tasks = farm.events_of(job, "committed").into_iter();
    let mut tasks: Vec<u64> = tasks.map(|e| e["task"].as_u64().unwrap()).collect();
    tasks.sort_unstable();
    (tasks, farm.count(job, "reused"))
}

#[test]
fn a_corrected_scene_file_is_all_that_a_retry_renders_and_the_data_set_is_that_of_a_fresh_run() {
    const FILES: u64 = 8;
    const BROKEN: usize = 5;
    let farm = Farm::start("corrected");
    let files = rooms(&farm, FILES, Some(BROKEN));
    let job = job(&farm, &files);
    let worker = farm.worker("worker");
    let first = farm.submit(&job);
    farm.run(&["job", "wait", &first])
        .fails(5, &["1 of 8 tasks are dead", "picofarm job retry"]);
    let dead = &farm.events_of(&first, "dead")[0];
    assert!(
        dead["task"] == BROKEN as u64 && dead["message"].as_str().unwrap().contains("room-5.glb"),
        "{dead}"
    );
    let before = store::times(&job.place());

    // As it is, it may be tried again, in the same job.
    assert_eq!(farm.json(&["job", "retry", &first])["retried"], 1);
    assert_eq!(farm.until_ended(&first)["state"], "failed");

    room(&farm.cli(), &files[BROKEN], 1 + BROKEN as u64);
    let said = farm.run(&["job", "retry", &first]).code(0);
    assert!(
        said.stderr.contains("room-5.glb") && said.stderr.contains("takes its place"),
        "{}",
        said.stderr
    );
    let answer = farm.json(&["job", "retry", &first]);
    assert_eq!(answer["existed"], true, "asked twice, there is one new job");
    let second = id(&answer);
    assert_ne!(second, first);
    farm.until_done_once(&job, &second);
    assert_eq!(rendered(&farm, &second), (vec![BROKEN as u64], FILES - 1));

    // What was there was not written again, and what is there now is what the corrected files give
    // in one go.
    let after = store::times(&job.place());
    for (name, time) in &before {
        let grows = name.starts_with("specular_any") || name == "zarr.json";
        assert!(grows || after[name] == *time, "{name} was written again");
    }
    assert_eq!(
        store::hashes(&job.place()),
        undisturbed("corrected", &job),
        "the bytes of a fresh run"
    );

    // The file is the same job now, whoever asks.
    let file = farm.scratch.join("files.toml").display().to_string();
    let again = farm.json(&["job", "submit", &file]);
    assert_eq!((&again["existed"], id(&again)), (&true.into(), second));
    worker.kill();
}

#[test]
fn the_job_file_of_corrected_and_added_scene_files_is_submitted_again_and_renders_only_those() {
    let farm = Farm::start("corrected-file");
    let files = rooms(&farm, 5, Some(1));
    let first = job(&farm, &files[..4]);
    let worker = farm.worker("worker");
    let failed = farm.submit(&first);
    assert_eq!(farm.until_ended(&failed)["state"], "failed");

    room(&farm.cli(), &files[1], 2);
    let second = job(&farm, &files);
    let file = farm.scratch.join("files.toml");
    second.write(&file);
    let file = file.display().to_string();
    let plan = farm.json(&["job", "plan", &file]);
    let reasons = plan["stages"][0]["reasons"].to_string();
    assert!(
        reasons.contains("3 of 5 scenes were made by job")
            && reasons.contains("files with the same content"),
        "{reasons}"
    );
    let submitted = farm.json(&["job", "submit", &file]);
    assert_eq!(submitted["existed"], false);
    farm.until_done_once(&second, &id(&submitted));
    assert_eq!(rendered(&farm, &id(&submitted)), (vec![1, 4], 3));

    // A lost object of a scene is made again by the recipe in the data set.
    let place = second.place();
    let whole = store::hashes(&place);
    for scene in [1, 2] {
        fs::remove_file(place.join(&store::objects(&place, scene)[0])).unwrap();
    }
    let shown = place.display().to_string();
    farm.run(&["dataset", "verify", &shown]).code(6);
    farm.json(&["dataset", "repair", &shown]);
    farm.json(&["dataset", "verify", &shown]);
    assert_eq!(store::hashes(&place), whole);
    worker.kill();
}

#[test]
fn a_file_that_changed_after_its_scene_was_rendered_is_refused_until_the_scene_is_gone() {
    let farm = Farm::start("corrected-late");
    let files = rooms(&farm, 3, Some(2));
    let job = job(&farm, &files);
    let worker = farm.worker("worker");
    let first = farm.submit(&job);
    assert_eq!(farm.until_ended(&first)["state"], "failed");

    // Two files are other ones now: that of a finished scene, and the broken one.
    room(&farm.cli(), &files[0], 7);
    room(&farm.cli(), &files[2], 8);
    let file = farm.scratch.join("files.toml").display().to_string();
    let wanted = [
        "scenes.files[0]",
        "room-0.glb",
        &first,
        "SHA-256",
        "name another data set",
    ];
    let before = store::hashes(&job.place());
    for asked in [
        ["job", "retry", &first],
        ["job", "plan", &file],
        ["job", "submit", &file],
    ] {
        farm.run(&asked).fails(3, &wanted);
    }
    assert_eq!(store::hashes(&job.place()), before);

    // Without the scene the new content is free to be rendered, and only what was finished of the
    // same content is kept.
    for object in store::objects(&job.place(), 0) {
        fs::remove_file(job.place().join(object)).unwrap();
    }
    let retried = farm.json(&["job", "retry", &first]);
    farm.until_done_once(&job, &id(&retried));
    assert_eq!(rendered(&farm, &id(&retried)), (vec![0, 2], 1));
    worker.kill();
}

#[test]
fn a_job_that_still_runs_is_not_retried_with_corrected_files() {
    let farm = Farm::start("corrected-early");
    let files = rooms(&farm, 2, Some(0));
    let job = job(&farm, &files);
    let id = farm.submit(&job);
    let worker = farm.worker("worker");
    assert_eq!(farm.until_ended(&id)["state"], "failed");
    worker.kill();
    // Its dead task waits for a worker: the job runs.
    assert_eq!(farm.json(&["job", "retry", &id])["retried"], 1);
    room(&farm.cli(), &files[0], 3);
    // Nothing is dead, so there is nothing to correct yet.
    assert_eq!(farm.json(&["job", "retry", &id])["retried"], 0);
    let worker = farm.worker("another");
    assert_eq!(farm.until_ended(&id)["state"], "failed");
    let dead = farm.events_of(&id, "dead");
    let said = dead.last().unwrap()["message"].as_str().unwrap();
    assert!(said.contains("picofarm job retry"), "{said}");
    worker.kill();
}
