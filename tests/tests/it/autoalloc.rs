//! Workers that come and go with the tasks, on a batch system made of a shell script and on a real
//! Slurm cluster on this machine.

use picofarm_tests::{Batch, Farm, Job, Process, Slurm, batch::POOL, wait::until};
use serde_json::Value;

fn words(args: &[String]) -> Vec<&str> {
    args.iter().map(String::as_str).collect()
}

fn start(farm: &Farm, batch: &Batch) -> Process {
    farm.cli().start("autoalloc", &words(&batch.args(&POOL)))
}

/// Decides once and returns the decision.
fn once(farm: &Farm, batch: &Batch, more: &[&str]) -> Value {
    let more = [&POOL[..], &["--once"], more].concat();
    farm.json(&words(&batch.args(&more)))
}

fn private(file: &std::path::Path) {
    use std::os::unix::fs::PermissionsExt;
    std::fs::set_permissions(file, std::fs::Permissions::from_mode(0o600))
        .expect("the test's own file");
}

fn until_empty(batch: &Batch) {
    until("the last allocation to end", || {
        batch.list().is_empty().then_some(())
    });
}

#[test]
fn workers_come_with_the_tasks_up_to_the_bound_and_go_with_the_last() {
    let farm = Farm::start("autoalloc-grow");
    let batch = Batch::new(&farm, 10);
    let mut pool = start(&farm, &batch);
    until("the first decision", || {
        pool.stdout().contains("no task waits").then_some(())
    });
    assert_eq!(
        batch.number("last"),
        0,
        "nothing is submitted without a task"
    );

    let job = Job::slow(&farm.store(), 4);
    let id = farm.submit(&job);
    farm.until_done_once(&job, &id);
    until_empty(&batch);
    assert_eq!(batch.number("most"), 2, "{}", pool.stdout());
    let said = pool.stdout();
    assert!(
        said.contains(&format!("4 of stage render of job {id}")),
        "{said}"
    );
    let workers = farm.events_of(&id, "committed");
    let of_pool = |e: &Value| e["worker"].as_str().is_some_and(|w| w.starts_with("pool-"));
    assert!(workers.iter().all(of_pool), "{workers:?}");
    assert!(pool.runs());
}

#[test]
fn a_batch_system_that_refuses_is_quoted_and_asked_again() {
    let farm = Farm::start("autoalloc-refuse");
    let batch = Batch::new(&farm, 10);
    batch.write("closed", "");
    let job = Job::quick(&farm.store(), 2);
    let id = farm.submit(&job);
    let more = [&POOL[..], &["--once"]].concat();
    farm.run(&words(&batch.args(&more)))
        .fails(7, &["the queue is closed for maintenance"]);
    let pool = start(&farm, &batch);
    until("the refusal to be shown", || {
        let said = pool.stdout();
        let quoted = said.contains("the queue is closed for maintenance");
        (quoted && said.contains("submits again in 5.0 s")).then_some(())
    });
    assert_eq!(batch.number("last"), 0);
    batch.delete("closed");
    farm.until_done_once(&job, &id);
    until_empty(&batch);
}

#[test]
fn a_killed_autoalloc_leaves_no_orphan_and_its_successor_doubles_nothing() {
    let farm = Farm::start("autoalloc-restart");
    // A full cluster: every allocation waits.
    let batch = Batch::new(&farm, 0);
    let id = farm.submit(&Job::quick(&farm.store(), 5));
    let pool = start(&farm, &batch);
    until("two allocations to wait", || {
        (batch.list().len() == 2).then_some(())
    });
    pool.kill();

    let again = once(&farm, &batch, &[]);
    assert_eq!(
        (&again["pending"], &again["submit"]),
        (&2.into(), &0.into()),
        "{again}"
    );
    assert_eq!(batch.number("last"), 2);
    assert!(
        again["reason"]
            .as_str()
            .expect("words")
            .contains("--max-workers is reached"),
        "{again}"
    );

    farm.json(&["job", "cancel", &id]);
    let dry = once(&farm, &batch, &["--dry-run"]);
    assert_eq!(
        (
            &dry["cancel"].as_array().expect("ids").len(),
            &dry["cancelled"]
        ),
        (&2, &Value::Array(vec![]))
    );
    assert_eq!(batch.list().len(), 2, "a dry run cancels nothing");
    let last = once(&farm, &batch, &[]);
    assert_eq!(last["cancelled"], serde_json::json!(["1", "2"]), "{last}");
    assert!(batch.list().is_empty());
}

#[test]
fn allocations_that_end_before_their_workers_connect_are_reported_and_pause_the_pool() {
    let farm = Farm::start("autoalloc-fruitless");
    let batch = Batch::new(&farm, 10);
    farm.submit(&Job::quick(&farm.store(), 1));
    let env = farm.scratch.join("worker.env");
    std::fs::write(
        &env,
        format!(
            "PICOFARM_COORDINATOR={}\nPICOFARM_BIN=/nowhere/picofarm\n",
            farm.url()
        ),
    )
    .expect("the test's folder is writable");
    private(&env);
    let file = env.display().to_string();
    let args = batch.args(&[&POOL[..], &["--worker-env", &file]].concat());
    let mut pool = farm.cli().start("autoalloc", &words(&args));
    pool.until_says("1 ended before a worker connected");
    pool.until_says("submits again in 5.0 s");
    pool.until_says("2 ended before a worker connected");
    pool.until_says("submits again in 10.0 s");
}

#[test]
fn tasks_that_no_worker_of_the_pool_can_run_start_none_and_are_explained() {
    let farm = Farm::start("autoalloc-unable");
    let batch = Batch::new(&farm, 10);
    let file = farm.scratch.join("job.toml");
    let job = Job::quick(&farm.store(), 2);
    job.write(&file);
    let mut text = std::fs::read_to_string(&file).expect("it was written");
    text += "\n[resources]\ncores = 64\n";
    std::fs::write(&file, text).expect("the test's folder is writable");
    farm.json(&["job", "submit", &file.display().to_string()]);
    let decision = once(&farm, &batch, &[]);
    assert_eq!(
        (&decision["wanted"], &decision["submit"]),
        (&0.into(), &0.into()),
        "{decision}"
    );
    let why = decision["reason"].as_str().expect("words");
    assert!(
        why.contains("the stage needs 64 cores, the worker has 1"),
        "{why}"
    );
}

#[test]
fn scenes_longer_than_an_allocation_are_named_before_their_submission_with_parts_that_fit() {
    let farm = Farm::start("autoalloc-long");
    let batch = Batch::new(&farm, 0);
    let file = farm.scratch.join("job.toml");
    let path = file.display().to_string();
    let job = Job {
        resolution: 512,
        samples: 64,
        ..Job::quick(&farm.store(), 1)
    };
    job.write(&file);
    let warnings = || farm.json(&["job", "plan", &path])["warnings"].to_string();
    let before = warnings();
    assert!(before.contains("no worker is connected"), "{before}");
    // From its first question on, the coordinator knows the pool.
    once(&farm, &batch, &["--dry-run"]);
    let after = warnings();
    assert!(!after.contains("no worker is connected"), "{after}");
    assert!(
        after.contains("workers of pool pool run for 8 min: set `parts = "),
        "{after}"
    );

    let id = farm.submit(&Job::quick(&farm.store(), 1));
    let why = farm.json(&["job", "explain", &id])["reasons"][0].clone();
    assert_eq!(why["code"], "no_workers", "{why}");
    assert!(
        why["words"]
            .as_str()
            .expect("words")
            .contains("pool pool starts workers"),
        "{why}"
    );
}

#[test]
fn unusable_settings_are_refused_before_anything_is_submitted() {
    let farm = Farm::start("autoalloc-bad");
    let batch = Batch::new(&farm, 10);
    let run = |more: &[&str]| {
        farm.run(&words(
            &batch.args(&[&POOL[..], &["--once"], more].concat()),
        ))
    };
    let short: Vec<&str> = POOL
        .iter()
        .map(|word| if *word == "10m" { "90s" } else { word })
        .collect();
    farm.run(&words(&batch.args(&short)))
        .fails(2, &["--time-limit", "expected at least 2m"]);
    run(&["--pool", "My pool"]).fails(2, &["--pool", "lower-case letters"]);
    let env = farm.scratch.join("worker.env");
    let file = env.display().to_string();
    std::fs::write(&env, "PICOFARM_LOG=info\n").expect("the test's folder is writable");
    run(&["--worker-env", &file]).fails(3, &["mode 644", "chmod 600"]);
    private(&env);
    run(&["--worker-env", &file]).fails(3, &["no PICOFARM_COORDINATOR=URL"]);
    farm.cli()
        .with("PICOFARM_TOKEN", "secret")
        .run(&words(&batch.args(&[&POOL[..], &["--once"]].concat())))
        .fails(3, &["PICOFARM_TOKEN", "--token-file"]);
    batch.write("batch", "echo 7 unheard-of");
    run(&[]).fails(7, &["--list", "7 unheard-of", "ID running SECONDS"]);
}

#[test]
fn on_slurm_a_pool_grows_to_its_bound_survives_its_end_and_shrinks_to_nothing() {
    let farm = Farm::start("autoalloc-slurm");
    let Some(slurm) = Slurm::start(&farm, 3) else {
        return;
    };
    let cli = farm.cli().with("SLURM_CONF", slurm.conf());
    let args = [&["autoalloc", "slurm"], &POOL[..]].concat();
    let pool = cli.start("autoalloc", &args);
    let job = Job::slow(&farm.store(), 8);
    let id = farm.submit(&job);
    let running = || -> Vec<String> {
        let text = slurm.run("squeue", &["-h", "-t", "running", "-o", "%A"]);
        text.lines().map(str::to_owned).collect()
    };
    let both = until("two allocations to run", || {
        let all = running();
        (all.len() == 2).then_some(all)
    });
    // The second worker works, and then its allocation is cancelled.
    let name = format!("pool-{}@", both[1]);
    until("the second worker to have a task", || {
        let leased = farm.events_of(&id, "leased");
        leased
            .iter()
            .any(|e| e["worker"].as_str().is_some_and(|w| w.starts_with(&name)))
            .then_some(())
    });
    slurm.run("scancel", &[&both[1]]);
    // Another program takes the pool over.
    pool.kill();
    let pool = cli.start("autoalloc", &args);
    farm.until_done_once(&job, &id);
    until("the cluster to be empty", || {
        let left = slurm.run("squeue", &["-h"]);
        left.is_empty().then_some(())
    });
    for kind in ["failed", "expired", "dead"] {
        let events = farm.events_of(&id, kind);
        assert!(events.is_empty(), "leaving is no {kind}: {events:?}");
    }
    until("the last decision", || {
        let said = pool.stdout();
        said.contains("no task waits for this pool; 0 of at most 2")
            .then_some(())
    });
    let said = pool.stdout();
    assert!(!said.contains("3 of at most 2"), "{said}");
}
