//! The workers of `up` are processes of their own: the death of one, or a task too large for all of
//! them, ends nothing else.

use std::fs;

use picofarm_tests::{Cli, Job, Process, Scratch, wait::until};
use rustix::process::{Pid, Resource, Rlimit, Signal, kill_process, prlimit};
use serde_json::Value;

/// A farm of `up` in a folder of its own.
struct Up {
    process: Process,
    cli: Cli,
    scratch: Scratch,
}

impl Up {
    fn start(name: &str) -> Self {
        let scratch = Scratch::new(name);
        let cli = Cli::new(scratch.path());
        let args = ["up", "--listen", "127.0.0.1:0", "--json", "--log", "info"];
        let mut process = cli.start("up", &[&args[..], &["--allow-insecure"]].concat());
        let line: Value = serde_json::from_str(&process.first_line()).unwrap();
        let url = line["coordinator"].as_str().unwrap();
        let cli = cli.with("PICOFARM_COORDINATOR", url);
        let up = Self {
            process,
            cli,
            scratch,
        };
        until("its worker to connect", || up.connected().then_some(()));
        up
    }

    fn connected(&self) -> bool {
        let workers = self.cli.json(&["workers"]);
        workers["workers"].as_array().is_some_and(|w| w.len() == 1)
    }

    fn worker(&self) -> Option<u32> {
        let mut children = children(self.process.id());
        assert!(children.len() < 2, "{children:?}");
        children.pop()
    }

    fn submit(&self, name: &str, text: &str) -> String {
        let file = self.scratch.join(&format!("{name}.toml"));
        fs::write(&file, text).unwrap();
        let answer = self
            .cli
            .json(&["job", "submit", &file.display().to_string()]);
        answer["job"].as_str().unwrap().to_owned()
    }

    fn small(&self, name: &str) -> Job {
        Job {
            name: name.into(),
            dataset: name.into(),
            ..Job::quick(&self.scratch.join("store"), 3)
        }
    }

    fn until_ended(&self, job: &str) -> Value {
        until(&format!("the end of {job}"), || {
            let status = self.cli.json(&["job", "status", job]);
            (status["state"] != "active").then_some(status)
        })
    }

    /// Checks that another job runs to its end.
    fn still_works(&mut self, name: &str) {
        let job = self.submit(name, &self.small(name).toml());
        let ended = self.until_ended(&job);
        assert_eq!(ended["state"], "done", "{ended}");
        assert!(self.process.runs(), "{}", self.process.stderr());
    }
}

/// Returns the child processes of `pid`.
fn children(pid: u32) -> Vec<u32> {
    let processes = fs::read_dir("/proc").unwrap().filter_map(Result::ok);
    let ids = processes.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    ids.filter(|id| parent(*id) == Some(pid)).collect()
}

/// Returns the parent of a process that has not ended.
fn parent(pid: u32) -> Option<u32> {
    let text = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name in parentheses may contain any character.
    let mut rest = text.rsplit_once(')')?.1.split_whitespace();
    let state = rest.next()?;
    (state != "Z").then(|| rest.next()?.parse().ok()).flatten()
}

fn pid(id: u32) -> Pid {
    Pid::from_raw(id.try_into().unwrap()).unwrap()
}

#[test]
fn a_worker_that_is_killed_costs_its_task_an_attempt_and_nothing_else() {
    let mut up = Up::start("worker-killed");
    let slow = Job {
        max_crashes: 3,
        ..Job::slow(&up.scratch.join("store"), 3)
    };
    let job = up.submit("slow", &slow.toml());
    let first = until("the worker's process", || up.worker());
    up.process.until_says("task starts");
    kill_process(pid(first), Signal::KILL).unwrap();
    up.process
        .until_says("killed by signal 9: probably out of memory");
    let ended = up.until_ended(&job);
    assert_eq!(ended["state"], "done", "{ended}");
    let history = up.cli.json(&["job", "logs", &job, "--last", "1000"]);
    let lost = history
        .as_array()
        .unwrap()
        .iter()
        .find(|e| e["kind"] == "expired");
    let said = lost.expect("the lease was lost")["message"].to_string();
    assert!(
        said.contains("killed by signal 9: probably out of memory"),
        "{said}"
    );
    let second = until("another process", || up.worker());
    assert_ne!(first, second);
    up.still_works("after");
}

#[test]
fn a_task_that_gets_no_memory_fails_alone() {
    let mut up = Up::start("no-memory");
    let worker = until("the worker's process", || up.worker());
    let status = fs::read_to_string(format!("/proc/{worker}/status")).unwrap();
    let used = status
        .lines()
        .find_map(|l| l.strip_prefix("VmSize:"))
        .unwrap();
    let used: u64 = used.trim().trim_end_matches(" kB").parse().unwrap();
    let limit = Rlimit {
        current: Some((used << 10) + (300 << 20)),
        maximum: None,
    };
    prlimit(Some(pid(worker)), Resource::As, limit).unwrap();
    // Histograms of 2 GB, which exceeds the limit and the addresses that the allocator has
    // reserved.
    let big = Job {
        name: "big".into(),
        dataset: "big".into(),
        resolution: 2800,
        max_failures: 1,
        max_crashes: 1,
        count: Some(1),
        ..up.small("big")
    };
    let job = up.submit("big", &big.toml());
    let ended = up.until_ended(&job);
    assert_eq!(ended["state"], "failed", "{ended}");
    let why = up
        .cli
        .json(&["job", "explain", &job, "--task", "0"])
        .to_string();
    assert!(why.contains("memory"), "{why}");
    up.still_works("after");
}

#[test]
fn a_scene_that_no_worker_can_hold_is_explained_and_holds_up_nothing() {
    let mut up = Up::start("too-big");
    let text = up.small("huge").toml();
    let huge = text
        .replace("resolution = 16", "resolution = 4096")
        .replace("bins = 64", "bins = 65536");
    let file = up.scratch.join("huge.toml");
    fs::write(&file, &huge).unwrap();
    let plan = up
        .cli
        .run(&["job", "plan", &file.display().to_string()])
        .ok();
    assert!(plan.stdout.contains("GiB of memory"), "{}", plan.stdout);
    let job = up.submit("huge", &huge);
    up.still_works("after");
    let why = up.cli.run(&["job", "explain", &job]).ok().stdout;
    assert!(
        why.contains("GiB of memory") && why.contains("the largest worker has"),
        "{why}"
    );
    assert_eq!(up.cli.json(&["job", "status", &job])["tasks"]["pending"], 3);
}

#[test]
fn no_worker_is_left_behind_by_a_parent_that_is_killed() {
    let up = Up::start("parent-killed");
    let worker = until("the worker's process", || up.worker());
    up.process.kill();
    until("the worker's end", || {
        parent(worker).is_none().then_some(())
    });
}

#[test]
fn an_interrupted_farm_ends_its_workers_in_order() {
    let mut up = Up::start("in-order");
    let worker = until("the worker's process", || up.worker());
    up.process.signal(picofarm_tests::Signal::Terminate);
    let ended = up.process.end();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert!(ended.stderr.contains("worker ends"), "{}", ended.stderr);
    assert_eq!(parent(worker), None);
}
