//! Data sets on an S3 server have the same bytes as on a local store, work with the same tools, and
//! lose nothing if the server dies.

use picofarm_tests::{
    Farm, Job,
    farm::undisturbed,
    s3::{KEY, READER, SECRET, Server},
    wait::until,
};

const PREFIX: &str = "sets/deep";

/// Starts a farm and a server, and returns them with a job that writes to a bucket of its own.
fn place(
    name: &str,
    lease_s: f64,
    job: fn(&std::path::Path, u64) -> Job,
    count: u64,
) -> Option<(Farm, Server, Job, String)> {
    let server = Server::start(name)?;
    let farm = Farm::with_lease(name, lease_s).reaching(&server);
    let bucket = server.bucket();
    let job = job(format!("s3://{bucket}/{PREFIX}").as_ref(), count);
    Some((farm, server, job, bucket))
}

#[test]
fn a_job_into_s3_leaves_the_objects_of_a_local_one_and_every_tool_reads_them() {
    let Some((farm, server, job, bucket)) = place("s3-story", 300.0, Job::quick, 3) else {
        return;
    };
    let id = farm.submit(&job);
    let worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
    let below = format!("{PREFIX}/{}", job.dataset);
    let hashes = server.hashes(&bucket, &below);
    assert_eq!(hashes, undisturbed("s3-story", &job));

    let url = job.place().display().to_string();
    let info = farm.json(&["dataset", "info", &url]);
    assert_eq!(info["scenes"], 3, "{info}");
    let pictures = farm.scratch.join("pictures").display().to_string();
    farm.run(&["dataset", "picture", &url, "--out", &pictures])
        .ok();
    farm.run(&["doctor", "--store", &url]).ok();
    let reader = server.as_user(farm.cli(), READER);
    reader.run(&["dataset", "verify", &url]).ok();
    reader.run(&["dataset", "collect", &url]).ok();
    reader
        .run(&["doctor", "--store", &url])
        .fails(7, &[&format!("s3://{bucket}/"), "no permission"]);
    assert!(!worker.stderr().contains(SECRET));
    worker.kill();

    // Objects of a published scene vanish; a new catalog has no record of them; intact scenes are
    // adopted.
    let transient = format!("{below}/transient/c/1/0/0/0");
    let depth = format!("{below}/depth/c/1/0/0");
    for key in [&transient, &depth] {
        server.delete(&bucket, key);
    }
    farm.run(&["dataset", "verify", &url])
        .fails(6, &[&format!("s3://{bucket}/{transient}"), "missing"]);
    let fresh = Farm::start("s3-story-fresh").reaching(&server);
    let again = fresh.submit(&job);
    let other = fresh.worker("other");
    fresh.until_done_once(&job, &again);
    assert_eq!(fresh.count(&again, "reused"), 2);
    assert_eq!(server.hashes(&bucket, &below), hashes);
    other.kill();

    // Files left by killed workers are collected, and nothing else. An object that a stalled server
    // wrote after its probe was abandoned is collected first.
    let collect = [
        "dataset",
        "collect",
        url.as_str(),
        "--older-than",
        "0s",
        "--nothing-runs",
    ];
    farm.json(&[&collect[..], &["--delete"]].concat());
    // The store's identity is an additional object.
    assert_eq!(server.hashes(&bucket, PREFIX).len(), hashes.len() + 1);
    server.delete(&bucket, &format!("{below}/manifests/2.json"));
    server.put(&bucket, &format!("{PREFIX}/.probe-1-race"), b"x".to_vec());
    let dry = farm.json(&collect);
    let of_2 = |key: &str| key.contains("/c/2/") || key.ends_with("/c/2");
    let lost = hashes.keys().filter(|key| of_2(key)).count() as u64;
    assert_eq!(
        (&dry["objects"], &dry["deleted"]),
        (&(lost + 1).into(), &false.into()),
        "{dry}"
    );
    assert_eq!(
        farm.json(&["dataset", "collect", &url, "--delete"])["young"],
        lost
    );
    let done = farm.json(&[&collect[..], &["--delete"]].concat());
    assert_eq!(done["bytes"], dry["bytes"], "{done}");
    let mut left = hashes.clone();
    left.retain(|key, _| !of_2(key) && key != "manifests/2.json");
    assert_eq!(server.hashes(&bucket, &below), left);
    assert_eq!(server.hashes(&bucket, PREFIX).len(), left.len() + 1);
    let report = farm.json(&["dataset", "verify", &url]);
    assert_eq!(
        (&report["scenes"], &report["unpublished"]),
        (&2.into(), &serde_json::json!([]))
    );
}

#[test]
fn a_server_killed_in_mid_job_costs_no_failure_and_no_scene() {
    let Some((farm, mut server, job, bucket)) = place("s3-killed", 6.0, Job::slow, 4) else {
        return;
    };
    let job = Job {
        max_failures: 1,
        max_crashes: 1,
        ..job
    };
    let below = format!("{PREFIX}/{}", job.dataset);
    let id = farm.submit(&job);
    let worker = farm.worker("worker");
    let mut struck = 0;
    for round in 1..=2 {
        struck += u32::from(farm.until_busy(&id, &["worker"]));
        server.kill();
        until("the worker to miss the server", || {
            let missed = worker.stderr().matches("cannot be reached: ").count();
            (missed >= round).then_some(())
        });
        server.up();
    }
    assert_eq!(struck, 2, "the job is too short for this machine");
    farm.until_done_once(&job, &id);
    assert_eq!(farm.count(&id, "dead"), 0);
    let failed = farm.events_of(&id, "failed");
    assert!(failed.is_empty(), "{failed:?}");
    assert_eq!(
        server.hashes(&bucket, &below),
        undisturbed("s3-killed", &job)
    );
}

#[test]
fn what_keeps_a_store_from_being_used_is_said_without_secrets() {
    let Some(server) = Server::start("s3-errors") else {
        return;
    };
    let bucket = server.bucket();
    let url = format!("s3://{bucket}/sets");
    let cli = picofarm_tests::Cli::new(server.scratch.path());
    let fails = |cli: &picofarm_tests::Cli, store: &str, code, parts: &[&str]| {
        let ended = cli
            .run(&["doctor", "--store", store, "--log", "trace"])
            .fails(code, parts);
        for secret in [SECRET, "wrong-secret", "session-secret"] {
            assert!(
                !ended.stdout.contains(secret) && !ended.stderr.contains(secret),
                "{}",
                ended.stderr
            );
        }
    };
    let good = server.with(cli.clone());
    good.run(&["doctor", "--store", &url, "--log", "trace"])
        .ok();
    assert!(
        server.hashes(&bucket, "sets").is_empty(),
        "the probe left something"
    );
    good.run(&["dataset", "info", &url])
        .fails(3, &["no data set"]);
    fails(
        &good,
        "s3://no-such-bucket/sets",
        7,
        &["s3://no-such-bucket/sets", "does the bucket exist?"],
    );
    good.run(&["dataset", "info", "s3://no-such-bucket/sets"])
        .fails(7, &["the bucket does not exist"]);
    fails(
        &good,
        "s3://key:wrong-secret@bucket/x",
        2,
        &["AWS_SECRET_ACCESS_KEY"],
    );
    fails(
        &server.as_user(cli.clone(), (KEY, "wrong-secret")),
        &url,
        7,
        &["check AWS_SECRET_ACCESS_KEY"],
    );
    fails(
        &server.as_user(cli.clone(), ("nobody", "wrong-secret")),
        &url,
        7,
        &["check AWS_ACCESS_KEY_ID"],
    );
    fails(
        &good.clone().with("AWS_ACCESS_KEY_ID", ""),
        &url,
        7,
        &["AWS_ACCESS_KEY_ID is not"],
    );
    fails(
        &good.clone().with("AWS_ALLOW_HTTP", ""),
        &url,
        7,
        &["set AWS_ALLOW_HTTP=true"],
    );
    let away = good.with("AWS_ENDPOINT_URL", "http://127.0.0.1:9");
    fails(
        &away,
        &url,
        7,
        &["http://127.0.0.1:9 cannot be reached", "AWS_ENDPOINT_URL"],
    );
}
