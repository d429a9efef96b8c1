//! A farm as in production: several coordinators on one Postgres (or one on SQLite), and workers
//! that reach them through proxies. Any of them may fail at any time.

use std::net::SocketAddr;

use serde_json::Value;

use crate::{
    cli::Cli, job::Job, ports::lasting, postgres::Postgres, process::Process, proxy::Proxy,
    scratch::Scratch, wait::until,
};

/// One of several coordinators.
pub struct Coordinator {
    process: Option<Process>,
    address: SocketAddr,
    /// The proxy in front of it, which outlives its process.
    pub proxy: Proxy,
}

/// Coordinators, their database and their proxies.
pub struct Cluster {
    /// The coordinators.
    pub coordinators: Vec<Coordinator>,
    cli: Cli,
    lease_s: f64,
    database: Database,
    /// Its folder.
    pub scratch: Scratch,
}

/// The database of the coordinators' catalog.
enum Database {
    Postgres(Postgres),
    /// A SQLite file in the cluster's folder, for one coordinator.
    Sqlite,
}

impl Cluster {
    /// Starts one coordinator on SQLite.
    pub fn on_sqlite(name: &str, lease_s: f64) -> Self {
        Self::with_database(Database::Sqlite, name, 1, lease_s, |cli| cli)
    }

    /// Starts coordinators with leases of `lease_s` seconds. Prints a message and returns `None` if
    /// there is no Postgres.
    pub fn start(name: &str, coordinators: usize, lease_s: f64) -> Option<Self> {
        Self::reaching(name, coordinators, lease_s, |cli| cli)
    }

    /// Like `start`, with additional settings for its processes and commands.
    pub fn reaching(
        name: &str,
        coordinators: usize,
        lease_s: f64,
        with: impl FnOnce(Cli) -> Cli,
    ) -> Option<Self> {
        let database = Database::Postgres(Postgres::start(name)?);
        Some(Self::with_database(
            database,
            name,
            coordinators,
            lease_s,
            with,
        ))
    }

    fn with_database(
        database: Database,
        name: &str,
        coordinators: usize,
        lease_s: f64,
        with: impl FnOnce(Cli) -> Cli,
    ) -> Self {
        let scratch = Scratch::new(name);
        let mut cluster = Self {
            coordinators: Vec::new(),
            cli: with(Cli::new(scratch.path())),
            lease_s,
            database,
            scratch,
        };
        for _ in 0..coordinators {
            let (process, address) = cluster.launch(&format!("127.0.0.1:{}", lasting()));
            cluster.coordinators.push(Coordinator {
                process: Some(process),
                address,
                proxy: Proxy::before(address),
            });
        }
        cluster
    }

    /// Kills the database and starts it again. SQLite ends with its coordinator.
    pub fn crash_database(&mut self) {
        match &mut self.database {
            Database::Postgres(postgres) => postgres.crash(),
            Database::Sqlite => {
                self.kill_coordinator(0);
                self.start_coordinator(0);
            }
        }
    }

    fn launch(&self, listen: &str) -> (Process, SocketAddr) {
        let lease = self.lease_s.to_string();
        let args = ["coordinator", "--allow-insecure", "--json", "--log", "info"];
        let args = [&args[..], &["--listen", listen, "--lease-s", &lease]].concat();
        let catalog = match &self.database {
            Database::Postgres(postgres) => postgres.url.clone(),
            Database::Sqlite => "catalog.sqlite".into(),
        };
        let cli = self.cli.clone().with("PICOFARM_CATALOG", &catalog);
        let mut process = cli.start("coordinator", &args);
        let line = process.first_line();
        let document: Value = serde_json::from_str(&line).expect("the first line is JSON");
        let url = document["coordinator"]
            .as_str()
            .expect("it names its address");
        let address = url
            .trim_start_matches("http://")
            .parse()
            .expect("an address");
        (process, address)
    }

    /// Returns a coordinator's process.
    ///
    /// # Panics
    /// If it was killed.
    pub fn coordinator(&mut self, i: usize) -> &mut Process {
        self.coordinators[i].process.as_mut().expect("it runs")
    }

    /// Ends a coordinator as `kill -9` does.
    ///
    /// # Panics
    /// If it does not run.
    pub fn kill_coordinator(&mut self, i: usize) {
        self.coordinators[i].process.take().expect("it runs").kill();
    }

    /// Starts a killed coordinator again at its address.
    pub fn start_coordinator(&mut self, i: usize) {
        let listen = self.coordinators[i].address.to_string();
        let (process, _) = self.launch(&listen);
        self.coordinators[i].process = Some(process);
    }

    /// Returns the URLs of the coordinators as a worker's list, starting with `first`.
    pub fn urls(&self, first: usize) -> String {
        let n = self.coordinators.len();
        let url = |i: usize| self.coordinators[(first + i) % n].proxy.url();
        (0..n).map(url).collect::<Vec<_>>().join(",")
    }

    /// Starts a worker with one thread that prefers the coordinator `first`.
    pub fn worker(&self, name: &str, first: usize) -> Process {
        self.worker_with(name, first, &[])
    }

    /// Like `worker`, with additional options.
    pub fn worker_with(&self, name: &str, first: usize, options: &[&str]) -> Process {
        let args = ["worker", "--log", "info", "--name", name, "--threads", "1"];
        let urls = self.urls(first);
        self.cli.start(
            name,
            &[&args[..], &["--coordinator", &urls], options].concat(),
        )
    }

    /// Returns commands that use any coordinator that answers, without the proxies.
    pub fn cli(&self) -> Cli {
        let urls: Vec<_> = self
            .coordinators
            .iter()
            .map(|h| format!("http://{}", h.address))
            .collect();
        self.cli
            .clone()
            .with("PICOFARM_COORDINATOR", &urls.join(","))
    }

    /// Returns the JSON answer of a command. Retries while no coordinator can answer.
    pub fn json(&self, args: &[&str]) -> Value {
        until(&format!("an answer to {args:?}"), || {
            let ended = self.cli().run(&[args, &["--json"]].concat());
            match ended.code {
                Some(0) => Some(ended.json()),
                Some(4) => None,
                _ => panic!("{args:?}: {}", ended.stderr),
            }
        })
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

    /// Waits until the job ends, and returns its last status.
    ///
    /// # Panics
    /// If it does not end.
    pub fn until_ended(&self, job: &str) -> Value {
        until(&format!("the end of job {job}"), || {
            let status = self.status(job);
            (status["state"] != "active").then_some(status)
        })
    }

    /// Returns the whole history.
    ///
    /// # Panics
    /// If it is not a list.
    pub fn events(&self, job: &str) -> Vec<Value> {
        let answer = self.json(&["job", "logs", job, "--last", "1000000"]);
        answer.as_array().expect("a history is a list").clone()
    }
}
