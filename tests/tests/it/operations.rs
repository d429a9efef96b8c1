//! Operators' questions to a running farm: is it healthy, how much is there to do, why does this
//! not run, which workers are there.

use picofarm_tests::{
    Cli, Farm, Job, Process, Scratch, Signal,
    http::{get, sample},
    postgres::Postgres,
    wait::until,
};
use serde_json::Value;

/// Starts a coordinator with an HTTP endpoint, and returns it with both addresses.
fn coordinator(cli: &Cli) -> (Process, String, String) {
    let args = ["coordinator", "--allow-insecure", "--json", "--log", "info"];
    let more = [
        "--listen",
        "127.0.0.1:0",
        "--http",
        "127.0.0.1:0",
        "--lease-s",
        "300",
    ];
    let mut process = cli.start("coordinator", &[&args[..], &more].concat());
    let line: Value = serde_json::from_str(&process.first_line()).expect("the first line is JSON");
    let address = |name: &str| {
        line[name]
            .as_str()
            .expect("it names its addresses")
            .to_owned()
    };
    let (url, http) = (address("coordinator"), address("http"));
    (process, url, http)
}

fn worker(cli: &Cli, name: &str) -> Process {
    cli.start(
        name,
        &["worker", "--log", "info", "--name", name, "--threads", "1"],
    )
}

fn until_code(url: &str, code: u16) -> String {
    until(&format!("{url} to answer {code}"), || {
        get(url)
            .filter(|(found, _)| *found == code)
            .map(|(_, body)| body)
    })
}

#[test]
fn the_metrics_agree_with_the_job_and_explain_says_what_it_waits_for() {
    let scratch = Scratch::new("metrics");
    let cli = Cli::new(scratch.path());
    let (_coordinator, url, http) = coordinator(&cli);
    let cli = cli.with("PICOFARM_COORDINATOR", &url);
    assert_eq!(until_code(&format!("{http}/readyz"), 200), "ready\n");
    let (code, words) = get(&format!("{http}/healthz")).expect("it answers");
    assert!(code == 200 && words.starts_with("ok"), "{code} {words}");
    assert_eq!(get(&format!("{http}/jobs")).expect("it answers").0, 404);

    let job = Job::quick(&scratch.join("store"), 4);
    let file = scratch.join("job.toml");
    job.write(&file);
    let submitted = cli.json(&["job", "submit", &file.display().to_string()]);
    let id = submitted["job"]
        .as_str()
        .expect("a job has an id")
        .to_owned();

    // Without a worker, the metrics request workers, and the job reports it.
    let page = until("the tasks to be counted", || {
        let (_, page) = get(&format!("{http}/metrics"))?;
        (sample(&page, "picofarm_tasks_pending") == Some(4.0)).then_some(page)
    });
    assert_eq!(sample(&page, "picofarm_workers"), Some(0.0), "{page}");
    assert_eq!(sample(&page, "picofarm_jobs_active"), Some(1.0), "{page}");
    let why = cli.json(&["job", "explain", &id, "--task", "0"]);
    assert_eq!(why["reasons"][0]["code"], "no_workers", "{why}");
    assert_eq!(why["task"]["state"], "pending", "{why}");
    assert_eq!(cli.json(&["workers"])["workers"], Value::Array(vec![]));
    cli.run(&["job", "explain", &id, "--task", "99"])
        .fails(3, &["has no task 99"]);

    // The history is shown as it grows, until the job ends.
    let follower = cli.start("follower", &["job", "logs", &id, "--follow", "--json"]);
    let mut forever = cli.start("events", &["events", "--follow"]);
    let one = worker(&cli, "one");
    let shown = follower.end().ok().stdout;
    let kinds: Vec<Value> = shown
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).expect("one event a line")["kind"].clone())
        .collect();
    let count = |kind: &str| kinds.iter().filter(|k| *k == kind).count();
    assert_eq!((count("submitted"), count("ended")), (1, 1), "{shown}");
    let status = cli.json(&["job", "status", &id]);
    assert_eq!(status["tasks"]["done"], 4, "{status}");

    // A task's log on its worker appears in the task's history. The history of the whole job omits
    // it unless requested.
    let lines = |args: &[&str]| -> Vec<String> {
        let events = cli.json(&[&["job", "logs", &id], args].concat());
        let events = events.as_array().expect("a list of events");
        let logs = events.iter().filter(|e| e["kind"] == "log");
        logs.map(|e| format!("{}", e["message"])).collect()
    };
    let of_task = lines(&["--task", "0"]);
    assert_eq!(of_task.len(), 2, "{of_task:?}");
    assert!(of_task[0].contains("info: scene made"), "{of_task:?}");
    assert!(of_task[1].contains("info: rendered"), "{of_task:?}");
    assert!(lines(&[]).is_empty() && lines(&["--verbose"]).len() == 8);

    let page = get(&format!("{http}/metrics")).expect("it answers").1;
    for (name, value) in [
        ("picofarm_tasks_committed_total{adopted=\"false\"}", 4.0),
        ("picofarm_task_seconds_count", 4.0),
        ("picofarm_reports_refused_total", 0.0),
        ("picofarm_task_failures_total{kind=\"user\"}", 0.0),
        (
            "picofarm_grpc_request_seconds_count{method=\"Jobs/SubmitJob\"}",
            1.0,
        ),
        ("picofarm_ready", 1.0),
    ] {
        assert_eq!(sample(&page, name), Some(value), "{name} in {page}");
    }
    let leased = count("leased") as f64;
    assert_eq!(
        sample(&page, "picofarm_leases_granted_total"),
        Some(leased),
        "{page}"
    );

    let workers = cli.json(&["workers"]);
    assert_eq!(workers["workers"][0]["name"], "one", "{workers}");
    let why = cli.json(&["job", "explain", &id, "--task", "2"]);
    assert_eq!(why["reasons"][0]["code"], "ended", "{why}");
    assert_eq!(why["task"]["output"]["made"]["worker"], "one", "{why}");

    // The other follower continues until Ctrl-C.
    assert!(forever.runs());
    until("the end to be shown", || {
        forever.stdout().contains("ended").then_some(())
    });
    forever.signal(Signal::Interrupt);
    forever.end().code(130);
    drop(one);
}

#[test]
fn a_second_signal_ends_a_worker_at_once() {
    let mut farm = Farm::start("second-signal");
    let job = Job::slow(&farm.store(), 1);
    farm.submit(&job);
    let mut worker = farm.worker("stubborn");
    worker.until_says("task starts");
    // The frozen coordinator cannot take the lease back, so the worker waits.
    farm.coordinator().signal(Signal::Stop);
    worker.signal(Signal::Terminate);
    worker.until_says("stopping");
    if worker.runs() {
        // Shortly after the first, it counts as the same signal.
        worker.signal(Signal::Terminate);
        worker.signal(Signal::Interrupt);
        worker.end().code(130);
    }
    farm.coordinator().signal(Signal::Continue);
}

#[test]
fn a_coordinator_whose_database_is_gone_is_alive_and_not_ready_and_comes_back() {
    let Some(mut postgres) = Postgres::start("ready") else {
        return;
    };
    let scratch = Scratch::new("ready");
    let cli = Cli::new(scratch.path()).with("PICOFARM_CATALOG", &postgres.url);
    let (_coordinator, _, http) = coordinator(&cli);
    until_code(&format!("{http}/readyz"), 200);
    postgres.down();
    let why = until_code(&format!("{http}/readyz"), 503);
    assert!(why.contains("catalog"), "{why}");
    assert_eq!(get(&format!("{http}/healthz")).expect("it answers").0, 200);
    let page = get(&format!("{http}/metrics")).expect("it answers").1;
    assert_eq!(sample(&page, "picofarm_ready"), Some(0.0), "{page}");
    postgres.up();
    until_code(&format!("{http}/readyz"), 200);
}

#[test]
fn a_job_shows_the_jobs_and_the_quota_that_it_waits_for() {
    let scratch = Scratch::new("waits");
    let cli = Cli::new(scratch.path());
    let args = [
        "coordinator",
        "--allow-insecure",
        "--json",
        "--listen",
        "127.0.0.1:0",
    ];
    let bound = ["--max-bytes-per-user", "1kB"];
    let mut coordinator = cli.start("coordinator", &[&args[..], &bound].concat());
    let line: Value = serde_json::from_str(&coordinator.first_line()).expect("it prints JSON");
    let url = line["coordinator"].as_str().expect("it names its address");
    let cli = cli.with("PICOFARM_COORDINATOR", url);
    let submit = |name: &str, head: &str| {
        let mut job = Job::quick(&scratch.join("store"), 200);
        job.name = name.into();
        let file = scratch.join(&format!("{name}.toml"));
        std::fs::write(&file, format!("{head}{}", job.toml())).expect("it is writable");
        cli.run(&["job", "submit", &file.display().to_string()])
    };
    submit("first", "").ok();
    submit("second", "after = [1]\n").ok();
    let status = |job: &str| cli.json(&["job", "status", job]);
    assert_eq!(status("1")["waits_for"], serde_json::json!([]));
    assert_eq!(status("2")["waits_for"][0]["code"], "after");
    let shown = cli.run(&["job", "status", "2"]).ok().stdout;
    assert!(shown.contains("not begun until other jobs are done") && shown.contains("job 1"));

    let _worker = worker(&cli, "only");
    let waits = until("the quota", || {
        let waits = status("1")["waits_for"][0].clone();
        (waits["code"] == "quota_bytes").then_some(waits)
    });
    let words = waits["words"].as_str().expect("it has words");
    assert!(words.contains("at most 1.0 kB"), "{words}");
    submit("third", "").fails(7, &["at most 1.0 kB", "--max-bytes-per-user"]);
}
