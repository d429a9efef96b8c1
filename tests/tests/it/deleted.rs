//! Deleted data do not count as done: the same job file makes them again, with the same bytes.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
};

use picofarm_proto::{
    PROTOCOL,
    key::{StageKey, task_key},
    wire::{
        self, farm_client::FarmClient, session_request::Message as Say,
        session_response::Message as Heard,
    },
};
use picofarm_tests::{Farm, Job, store};
use serde_json::Value;

fn reasons(plan: &Value) -> String {
    plan["stages"][0]["reasons"].to_string()
}

/// Returns the keys of objects that differ between both.
fn differing<'a>(a: &'a BTreeMap<String, String>, b: &'a BTreeMap<String, String>) -> Vec<&'a str> {
    let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    let differ = keys.into_iter().filter(|key| a.get(*key) != b.get(*key));
    differ.map(String::as_str).collect()
}

#[test]
fn a_deleted_store_and_a_deleted_scene_are_made_again_by_the_same_job_file() {
    let farm = Farm::start("deleted");
    let job = Job::quick(&farm.store(), 3);
    let file = farm.scratch.join("job.toml");
    job.write(&file);
    let worker = farm.worker("worker");
    let id = farm.submit(&job);
    farm.until_done_once(&job, &id);
    let whole = store::hashes(&job.place());
    let file = file.display().to_string();
    assert_eq!(farm.json(&["job", "submit", &file])["existed"], true);

    fs::remove_file(job.place().join("manifests/1.json")).unwrap();
    let plan = farm.json(&["job", "plan", &file]);
    assert_eq!((&plan["reuse"], &plan["run"]), (&2.into(), &1.into()));
    let said = reasons(&plan);
    assert!(
        said.contains("1 of 3 scenes recorded as done are gone from"),
        "{said}"
    );
    let again = farm.json(&["job", "submit", &file]);
    assert_eq!(again["existed"], false, "{again}");
    farm.until_ended(again["job"].as_str().unwrap());
    assert_eq!(store::hashes(&job.place()), whole);

    fs::remove_dir_all(farm.store()).unwrap();
    let plan = farm.json(&["job", "plan", &file]);
    assert_eq!((&plan["reuse"], &plan["run"]), (&0.into(), &3.into()));
    let again = farm.json(&["job", "submit", &file]);
    assert_eq!(again["existed"], false, "{again}");
    let status = farm.until_ended(again["job"].as_str().unwrap());
    assert_eq!(status["state"], "done", "{status}");
    let made = store::hashes(&job.place());
    assert_eq!(differing(&made, &whole), [""; 0]);

    assert_eq!(farm.json(&["job", "submit", &file])["existed"], true);
    worker.kill();
}

#[test]
fn a_plan_counts_the_scenes_of_a_store_that_no_coordinator_has_recorded_and_workers_take_them_over()
{
    let before = Farm::start("unrecorded-before");
    let job = Job::quick(&before.store(), 3);
    let worker = before.worker("worker");
    let id = before.submit(&job);
    before.until_done_once(&job, &id);
    worker.kill();
    let whole = store::times(&job.place());

    // Another farm, whose catalog is empty.
    let farm = Farm::start("unrecorded");
    let file = farm.scratch.join("job.toml");
    job.write(&file);
    let file = file.display().to_string();
    let plan = farm.json(&["job", "plan", &file]);
    let counts = ["reuse", "taken", "run"].map(|part| plan[part].as_u64().unwrap());
    assert_eq!(counts, [0, 3, 0], "{plan}");
    let said = reasons(&plan);
    assert!(said.contains("holds 3 of 3 scenes"), "{said}");
    assert!(
        !said.contains("3 run") && !said.contains("not there"),
        "{said}"
    );
    let said = farm.run(&["job", "plan", &file]).ok().stdout;
    let first = "3 tasks: 0 reuse, 3 taken over from the store, 0 run";
    assert_eq!(said.lines().next(), Some(first), "{said}");

    // One more is rendered.
    let more = Job {
        count: Some(4),
        ..job.clone()
    };
    more.write(&farm.scratch.join("job.toml"));
    let plan = farm.json(&["job", "plan", &file]);
    let counts = ["reuse", "taken", "run"].map(|part| plan[part].as_u64().unwrap());
    assert_eq!(counts, [0, 3, 1], "{plan}");

    job.write(&farm.scratch.join("job.toml"));
    let submitted = farm.json(&["job", "submit", &file]);
    let worker = farm.worker("worker");
    let status = farm.until_ended(submitted["job"].as_str().unwrap());
    assert_eq!(status["state"], "done", "{status}");
    assert_eq!(status["tasks"]["reused"], 3, "{status}");
    assert_eq!(store::times(&job.place()), whole);
    worker.kill();
}

/// Takes a lease of a farm and reports a result that it has made up; returns the coordinator's
/// answer.
async fn lie(url: &str, renderer: &str) -> wire::Acknowledge {
    let hello = wire::Hello {
        worker_id: uuid::Uuid::new_v4().to_string(),
        incarnation: uuid::Uuid::new_v4().to_string(),
        name: "liar".into(),
        version: env!("CARGO_PKG_VERSION").into(),
        protocol: PROTOCOL,
        cores: 1,
        memory_mib: 8_192,
        kinds: [("render".to_owned(), renderer.to_owned())].into(),
        ..wire::Hello::default()
    };
    let mut client = FarmClient::connect(url.to_owned()).await.unwrap();
    let (to, requests) = tokio::sync::mpsc::channel(4);
    let say = async |message| {
        let request = wire::SessionRequest {
            message: Some(message),
        };
        to.send(request).await.unwrap();
    };
    say(Say::Hello(hello)).await;
    say(Say::Credit(wire::Credit { leases: 1 })).await;
    let requests = tokio_stream::wrappers::ReceiverStream::new(requests);
    let mut heard = client.session(requests).await.unwrap().into_inner();
    loop {
        match heard.message().await.unwrap().unwrap().message.unwrap() {
            Heard::Lease(lease) => {
                let key = StageKey::parse(&lease.stage_key).unwrap();
                let done = wire::TaskDone {
                    lease: lease.lease,
                    index: lease.lo,
                    task_key: task_key(&key, lease.lo).to_string(),
                    manifest_sha256: "f".repeat(64),
                    bytes: 1,
                    seconds: 1.0,
                    ..wire::TaskDone::default()
                };
                say(Say::Done(done)).await;
            }
            Heard::Acknowledge(answer) => return answer,
            _ => {}
        }
    }
}

#[test]
fn a_made_up_result_is_refused_and_an_honest_worker_finishes_the_job() {
    let farm = Farm::start("made-up");
    let job = Job::quick(&farm.store(), 1);
    let id = farm.submit(&job);
    let status = farm.status(&id);
    let renderer = status["spec"]["stage"][0]["render"]["renderer"].as_str();
    let renderer = renderer.unwrap_or_else(|| panic!("{status}")).to_owned();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let answer = runtime.block_on(lie(farm.url(), &renderer));
    assert!(
        !answer.accepted && answer.reason.contains("holds no such result"),
        "{answer:?}"
    );
    assert_eq!(farm.status(&id)["state"], "active");
    let worker = farm.worker("honest");
    let status = farm.until_ended(&id);
    assert_eq!(status["state"], "done", "{status}");
    assert_eq!(status["unverified"], 0);
    assert_eq!(farm.events_of(&id, "alarm").len(), 1);
    assert_eq!(farm.events_of(&id, "committed").len(), 1);
    worker.kill();
}

#[test]
fn results_that_cannot_be_verified_are_stated() {
    let mut farm = Farm::start("unverified");
    farm.kill_coordinator();
    farm.start_coordinator_with(&["--check-stores", "none"]);
    let job = Job::quick(&farm.store(), 2);
    let file = farm.scratch.join("job.toml");
    job.write(&file);
    let id = farm.submit(&job);
    let worker = farm.worker("worker");
    farm.until_done_once(&job, &id);
    assert_eq!(farm.status(&id)["unverified"], 2);
    let file = file.display().to_string();
    let plan = farm.json(&["job", "plan", &file]);
    assert_eq!((&plan["reuse"], &plan["run"]), (&2.into(), &0.into()));
    assert!(
        reasons(&plan).contains("2 of 2 scenes recorded as done could not be verified"),
        "{plan}"
    );
    let again = farm.json(&["job", "submit", &file]);
    assert_eq!((&again["existed"], &again["plan"]), (&true.into(), &plan));
    let words = farm.run(&["job", "status", &id]).ok().stdout;
    assert!(
        words.contains("2 results are reported by workers and not verified"),
        "{words}"
    );
    worker.kill();
}
