//! A Slurm cluster for a single test on this machine, and workers started by the scripts of
//! `deploy/slurm`.

use std::{
    fmt::Write,
    fs,
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
    process::Command,
};

use crate::{binary, farm::Farm, wait::until};

/// A running cluster, with everything that runs on it. It ends on drop.
pub struct Slurm {
    dir: PathBuf,
    home: PathBuf,
    conf: String,
}

fn here(path: &str) -> PathBuf {
    Path::new(&crate::package()).join(path)
}

fn said(what: &str, command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|e| panic!("{what}: {e}"));
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{what}: {error}");
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

impl Slurm {
    /// Starts a cluster of nodes with one core each in the farm's folder. Prints a message and
    /// returns `None` if tests/run has not set up Slurm. Declare it after the farm, so that it ends
    /// first.
    ///
    /// # Panics
    /// If it does not start.
    pub fn start(farm: &Farm, nodes: usize) -> Option<Self> {
        if std::env::var_os("PICOFARM_TEST_SLURM").is_none() {
            eprintln!(
                "SKIPPED: tests/run sets PICOFARM_TEST_SLURM where it is root and Slurm is installed"
            );
            return None;
        }
        let mut slurm = Self {
            dir: farm.scratch.join("slurm"),
            home: farm.scratch.path().to_owned(),
            conf: String::new(),
        };
        slurm.conf = slurm.script(&["start"], &[&nodes.to_string()]);
        Some(slurm)
    }

    fn script(&self, command: &[&str], args: &[&str]) -> String {
        let mut script = Command::new(here("services/slurm.sh"));
        said(
            &format!("slurm.sh {command:?} {args:?}"),
            script.args(command).arg(&self.dir).args(args),
        )
    }

    /// Returns the path of the cluster's slurm.conf, for SLURM_CONF.
    pub fn conf(&self) -> &str {
        &self.conf
    }

    /// Runs one of Slurm's commands and returns its output.
    ///
    /// # Panics
    /// If it fails.
    pub fn run(&self, program: &str, args: &[&str]) -> String {
        let mut command = Command::new(program);
        said(
            &format!("{program} {args:?}"),
            command.args(args).env("SLURM_CONF", &self.conf),
        )
    }

    /// Submits a job array of workers for the farm as a user would, and returns its id. Their logs
    /// are stored with those of the farm.
    ///
    /// # Panics
    /// If it is refused.
    pub fn workers(&self, farm: &Farm, array: &str) -> String {
        let env = farm.scratch.join("worker.env");
        let mut text = String::new();
        for (name, value) in [
            ("PICOFARM_COORDINATOR", farm.url()),
            ("PICOFARM_LOG", "info"),
            ("PICOFARM_BIN", &binary::picofarm().display().to_string()),
        ] {
            writeln!(text, "{name}={value}").expect("writing to a string");
        }
        fs::write(&env, text).expect("the test's folder is writable");
        let private = fs::Permissions::from_mode(0o600);
        fs::set_permissions(&env, private).expect("the test's own file");
        let mut submit = Command::new(here("../deploy/slurm/submit.sh"));
        submit
            .arg(&env)
            .args(["--array", array, "--time=30", "--output=%A_%a.stderr"])
            .current_dir(&self.home)
            .env("HOME", &self.home)
            .env("SLURM_CONF", &self.conf);
        said("submit.sh", &mut submit)
    }

    /// Returns the log so far of the worker of an array element (`12_0`), over all its restarts.
    pub fn log(&self, element: &str) -> String {
        // The file does not exist before the element has started.
        fs::read_to_string(self.home.join(format!("{element}.stderr"))).unwrap_or_default()
    }

    /// Waits until the log of an array element's worker contains `words` at least `times` times.
    ///
    /// # Panics
    /// If it does not.
    pub fn until_said(&self, element: &str, words: &str, times: usize) {
        until(&format!("worker {element} to say {words:?}"), || {
            (self.log(element).matches(words).count() >= times).then_some(())
        });
    }

    /// Waits until an array element is in this state, as named by squeue.
    ///
    /// # Panics
    /// If it does not reach this state.
    pub fn until_state(&self, element: &str, state: &str) {
        until(&format!("{element} to be {state}"), || {
            let now = self.run("squeue", &["-h", "-t", "all", "-o", "%T", "-j", element]);
            (now == state).then_some(())
        });
    }

    /// Starts a requeued element now; Slurm itself waits for two minutes.
    ///
    /// # Panics
    /// If the element does not exist.
    pub fn start_again(&self, element: &str) {
        self.until_state(element, "PENDING");
        // The element's credential was revoked within this second, and slurmd has a resolution of
        // one second. A credential made in the same second is refused as that of a job "already
        // killed", and Slurm abandons the job.
        let start = ["update", &format!("JobId={element}"), "StartTime=now+2"];
        self.run("scontrol", &start);
    }

    /// Disconnects a node: Slurm's processes on it end, but the worker continues.
    ///
    /// # Panics
    /// If there is no such node.
    pub fn lose_node(&self, node: &str) {
        self.script(&["lose"], &[node]);
    }

    /// Sends a signal (`STOP`) to the worker on a node.
    ///
    /// # Panics
    /// If there is none.
    pub fn signal(&self, node: &str, signal: &str) {
        self.script(&["signal"], &[node, signal]);
    }
}

impl Drop for Slurm {
    fn drop(&mut self) {
        let stopped = Command::new(here("services/slurm.sh"))
            .arg("stop")
            .arg(&self.dir)
            .status();
        if !stopped.is_ok_and(|s| s.success()) {
            eprintln!("the Slurm cluster in {} was not ended", self.dir.display());
        }
    }
}
