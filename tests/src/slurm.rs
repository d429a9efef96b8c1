//! A Slurm cluster of a test's own on this machine, and workers that come to it by the scripts of `deploy/slurm`.

use std::{
    fmt::Write,
    fs,
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
    process::Command,
};

use crate::{binary, farm::Farm, wait::until};

/// A running cluster, with everything that runs on it; ended when dropped.
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
    /// Starts a cluster of nodes with one core each in the farm's folder; `None`, having said so, where tests/run has
    /// not seen to it that Slurm is installed. Declare it after the farm, so that it ends first.
    ///
    /// # Panics
    /// When it does not start.
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

    /// Runs one of Slurm's commands: what it prints.
    ///
    /// # Panics
    /// When it fails.
    pub fn run(&self, program: &str, args: &[&str]) -> String {
        let mut command = Command::new(program);
        said(
            &format!("{program} {args:?}"),
            command.args(args).env("SLURM_CONF", &self.conf),
        )
    }

    /// Submits a job array of workers for the farm as a person would: its id. Their logs lie with those of the farm.
    ///
    /// # Panics
    /// When it is refused.
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

    /// What the worker of an array element (`12_0`) has logged so far, over all its lives.
    pub fn log(&self, element: &str) -> String {
        // It is not there before the element has started.
        fs::read_to_string(self.home.join(format!("{element}.stderr"))).unwrap_or_default()
    }

    /// Waits until the worker of an array element has said `words` so many times.
    ///
    /// # Panics
    /// When it does not.
    pub fn until_said(&self, element: &str, words: &str, times: usize) {
        until(&format!("worker {element} to say {words:?}"), || {
            (self.log(element).matches(words).count() >= times).then_some(())
        });
    }

    /// Waits until an array element is in this state, as squeue names it.
    ///
    /// # Panics
    /// When it does not come there.
    pub fn until_state(&self, element: &str, state: &str) {
        until(&format!("{element} to be {state}"), || {
            let now = self.run("squeue", &["-h", "-t", "all", "-o", "%T", "-j", element]);
            (now == state).then_some(())
        });
    }

    /// Starts a requeued element now; Slurm itself waits for two minutes.
    ///
    /// # Panics
    /// When it is not there.
    pub fn start_again(&self, element: &str) {
        self.until_state(element, "PENDING");
        // Its credential was revoked within this second, and slurmd knows seconds only: one made in the same second is
        // refused as that of a job "already killed", and Slurm gives the job up.
        let start = ["update", &format!("JobId={element}"), "StartTime=now+2"];
        self.run("scontrol", &start);
    }

    /// Cuts a node off: Slurm's processes on it are gone, the worker goes on.
    ///
    /// # Panics
    /// When there is no such node.
    pub fn lose_node(&self, node: &str) {
        self.script(&["lose"], &[node]);
    }

    /// Sends a signal (`STOP`) to the worker that runs on a node.
    ///
    /// # Panics
    /// When there is none.
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
