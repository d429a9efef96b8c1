//! A farm of real processes: one coordinator, any number of workers, and the commands of users.

use std::path::PathBuf;

use serde_json::Value;

use crate::{
    cli::{Cli, Ended},
    job::Job,
    ports::lasting,
    process::Process,
    s3::Server,
    scratch::Scratch,
    store,
    wait::until,
};

/// A folder with a catalog and a store, and the coordinator on them.
pub struct Farm {
    // Processes end before the folder is deleted.
    coordinator: Option<Process>,
    url: Option<String>,
    lease_s: f64,
    catalog: String,
    cli: Cli,
    /// Its folder.
    pub scratch: Scratch,
}

impl Farm {
    /// Starts a farm with long leases, so that none expires in a test.
    pub fn start(name: &str) -> Self {
        Self::with_lease(name, 300.0)
    }

    /// Starts a farm with leases of `lease_s` seconds.
    pub fn with_lease(name: &str, lease_s: f64) -> Self {
        Self::on(Scratch::new(name), "catalog.sqlite", lease_s)
    }

    /// Starts a farm in an existing folder, with the catalog at this path in it.
    pub fn on(scratch: Scratch, catalog: &str, lease_s: f64) -> Self {
        let mut farm = Self {
            coordinator: None,
            url: None,
            lease_s,
            catalog: catalog.to_owned(),
            cli: Cli::new(scratch.path()),
            scratch,
        };
        farm.start_coordinator();
        farm
    }

    /// Makes the farm's workers and commands use an S3 server.
    pub fn reaching(self, server: &Server) -> Self {
        Self {
            cli: server.with(self.cli),
            ..self
        }
    }

    /// Starts the coordinator: the first time on a free port, later on the same one.
    ///
    /// # Panics
    /// If it does not start.
    pub fn start_coordinator(&mut self) {
        self.start_coordinator_with(&[]);
    }

    /// Like `start_coordinator`, with more arguments.
    ///
    /// # Panics
    /// If it does not start.
    pub fn start_coordinator_with(&mut self, more: &[&str]) {
        let listen = match &self.url {
            Some(url) => url.trim_start_matches("http://").to_owned(),
            None => format!("127.0.0.1:{}", lasting()),
        };
        let lease = self.lease_s.to_string();
        let args = [
            "coordinator",
            "--allow-insecure",
            "--json",
            "--log",
            "info",
            "--catalog",
            &self.catalog,
        ];
        let args = [&args[..], &["--listen", &listen, "--lease-s", &lease], more].concat();
        let mut process = self.cli.start("coordinator", &args);
        let line = process.first_line();
        let document: Value = serde_json::from_str(&line).expect("the first line is JSON");
        let url = document["coordinator"]
            .as_str()
            .expect("it names its address");
        if let Some(before) = &self.url {
            assert_eq!(url, before, "a coordinator comes back where it was");
        }
        self.url = Some(url.to_owned());
        self.coordinator = Some(process);
    }

    /// Returns the coordinator's process.
    ///
    /// # Panics
    /// If it was taken.
    pub fn coordinator(&mut self) -> &mut Process {
        self.coordinator.as_mut().expect("a coordinator runs")
    }

    /// Ends the coordinator as `kill -9` does.
    ///
    /// # Panics
    /// If there is none, or it had ended by itself.
    pub fn kill_coordinator(&mut self) {
        self.coordinator.take().expect("a coordinator runs").kill();
    }

    /// Returns the coordinator's URL.
    ///
    /// # Panics
    /// Before its first start.
    pub fn url(&self) -> &str {
        self.url.as_deref().expect("it was started")
    }

    /// Starts a worker with one thread.
    pub fn worker(&self, name: &str) -> Process {
        let args = ["worker", "--log", "info", "--name", name, "--threads", "1"];
        self.cli
            .start(name, &[&args[..], &["--coordinator", self.url()]].concat())
    }

    /// Returns commands that use the coordinator.
    pub fn cli(&self) -> Cli {
        self.cli.clone().with("PICOFARM_COORDINATOR", self.url())
    }

    /// Counts the occurrences of `words` in the logs of all processes of this farm.
    ///
    /// # Panics
    /// If a log cannot be read.
    pub fn logged(&self, words: &str) -> u64 {
        let entries = std::fs::read_dir(self.scratch.path()).expect("the test's folder is there");
        let count = |path: PathBuf| {
            let log = std::fs::read_to_string(path).expect("a log is text");
            log.lines().filter(|line| line.contains(words)).count() as u64
        };
        entries
            .map(|entry| entry.expect("a folder can be listed").path())
            .filter(|path| path.extension().is_some_and(|e| e == "stderr"))
            .map(count)
            .sum()
    }

    /// Runs a command to its end.
    pub fn run(&self, args: &[&str]) -> Ended {
        self.cli().run(args)
    }

    /// Returns the JSON answer of a successful command.
    pub fn json(&self, args: &[&str]) -> Value {
        self.cli().json(args)
    }

    /// Returns the folder for results.
    pub fn store(&self) -> PathBuf {
        self.scratch.join("store")
    }

    /// Submits a job and returns its id.
    ///
    /// # Panics
    /// If it is refused.
    pub fn submit(&self, job: &Job) -> String {
        let file = self.scratch.join(&format!("{}.toml", job.name));
        job.write(&file);
        let answer = self.json(&["job", "submit", &file.display().to_string()]);
        answer["job"]
            .as_str()
            .expect("a submission answers with a job")
            .to_owned()
    }

    /// Returns the output of `job status`.
    pub fn status(&self, job: &str) -> Value {
        self.json(&["job", "status", job])
    }

    /// Returns the number of tasks in a state (`done`, `dead`, `pending`, …).
    ///
    /// # Panics
    /// If the status lacks this number.
    pub fn count(&self, job: &str, state: &str) -> u64 {
        self.status(job)["tasks"][state]
            .as_u64()
            .expect("a status counts tasks")
    }

    /// Returns the whole history.
    ///
    /// # Panics
    /// If it is not a list.
    pub fn events(&self, job: &str) -> Vec<Value> {
        let answer = self.json(&["job", "logs", job, "--last", "1000000"]);
        answer.as_array().expect("a history is a list").clone()
    }

    /// Returns the events of a kind.
    pub fn events_of(&self, job: &str, kind: &str) -> Vec<Value> {
        let mut events = self.events(job);
        events.retain(|e| e["kind"] == kind);
        events
    }

    /// Waits until one of `workers` is in the middle of a scene. Returns `false` if the job ended
    /// first. Workers report progress six times per lease, so this is for farms with short leases.
    ///
    /// # Panics
    /// If neither happens.
    pub fn until_busy(&self, job: &str, workers: &[&str]) -> bool {
        until(&format!("{workers:?} to be in a scene"), || {
            let status = self.status(job);
            let running = status["running"]
                .as_array()
                .expect("a status lists what runs");
            let busy = running.iter().any(|task| {
                workers.iter().any(|name| task["worker"] == *name)
                    && task["fraction"].as_f64().is_some_and(|share| share > 0.0)
            });
            (busy || status["state"] != "active").then_some(busy)
        })
    }

    /// Waits until the job ends, and returns its last status. A long job may take long, as long as
    /// it makes progress.
    ///
    /// # Panics
    /// If it does not end.
    pub fn until_ended(&self, job: &str) -> Value {
        let mut before = Value::Null;
        loop {
            let status = until(&format!("job {job} to get on"), || {
                let status = self.status(job);
                let over = status["state"] != "active";
                (over || status["tasks"]["done"] != before).then_some(status)
            });
            if status["state"] != "active" {
                return status;
            }
            before = status["tasks"]["done"].clone();
        }
    }

    /// Returns the JSON answer of a command. Retries while the coordinator cannot answer.
    ///
    /// # Panics
    /// If it fails for another reason, or for long.
    pub fn patiently(&self, args: &[&str]) -> Value {
        until(&format!("an answer to {args:?}"), || {
            let ended = self.run(&[args, &["--json"]].concat());
            match ended.code {
                Some(0) => Some(ended.json()),
                Some(4) => None,
                _ => panic!("{args:?}: {}", ended.stderr),
            }
        })
    }

    /// Waits until the job is done, and checks that each scene was committed exactly once and that
    /// the data set is undamaged.
    ///
    /// # Panics
    /// If any of this fails.
    pub fn until_done_once(&self, job: &Job, id: &str) {
        let status = self.until_ended(id);
        assert_eq!(status["state"], "done", "{status}");
        let total = status["tasks"]["total"]
            .as_u64()
            .expect("a status counts tasks");
        assert_eq!(status["tasks"]["done"], total, "{status}");
        self.committed_once(id, total);
        let place = job.place();
        if place.is_absolute() {
            assert_eq!(store::finished(&place), (0..total).collect::<Vec<_>>());
        }
        let report = self.json(&["dataset", "verify", &place.display().to_string()]);
        assert_eq!(report["scenes"], total, "{report}");
    }

    /// Checks in the history that each of `total` scenes was committed exactly once and that there
    /// was no alarm.
    ///
    /// # Panics
    /// If a check fails.
    pub fn committed_once(&self, job: &str, total: u64) {
        for task in 0..total {
            let task = task.to_string();
            let mut events = self.json(&["job", "logs", job, "--task", &task]);
            let events = events.as_array_mut().expect("a history is a list");
            events.retain(|e| e["kind"] == "committed" || e["kind"] == "reused");
            assert_eq!(
                events.len(),
                1,
                "scene {task} must be committed once: {events:?}"
            );
        }
        let alarms = self.events_of(job, "alarm");
        assert!(alarms.is_empty(), "{alarms:?}");
    }
}

/// Returns the objects of an undisturbed run of `job` on a farm of its own.
pub fn undisturbed(name: &str, job: &Job) -> std::collections::BTreeMap<String, String> {
    let farm = Farm::start(&format!("{name}-undisturbed"));
    let job = Job {
        store: farm.store(),
        ..job.clone()
    };
    let id = farm.submit(&job);
    let _worker = farm.worker("calm");
    farm.until_done_once(&job, &id);
    store::hashes(&job.place())
}
