//! Runs commands as users type them, and returns their output.

use std::{
    ffi::OsStr,
    path::{Path, PathBuf},
    process::Command,
};

use serde_json::Value;

use crate::{binary, process::Process};

/// Runs `picofarm` in a folder, isolated from the tester's own settings.
#[derive(Clone)]
pub struct Cli {
    dir: PathBuf,
    /// The program; `None` = `picofarm`.
    program: Option<PathBuf>,
    variables: Vec<(String, String)>,
}

impl Cli {
    /// Runs commands in `dir`, which is also their home folder.
    pub fn new(dir: &Path) -> Self {
        Self {
            dir: dir.to_owned(),
            program: None,
            variables: Vec::new(),
        }
    }

    /// Runs another program of this workspace instead.
    pub fn of_program(mut self, program: &Path) -> Self {
        self.program = Some(program.to_owned());
        self
    }

    /// Adds an environment variable.
    pub fn with(mut self, name: &str, value: &str) -> Self {
        self.variables.push((name.to_owned(), value.to_owned()));
        self
    }

    /// Returns the command for the caller to start.
    pub fn command(&self, args: &[&str]) -> Command {
        let program = self.program.as_deref();
        self.other(program.unwrap_or_else(|| binary::picofarm()).as_ref(), args)
    }

    /// Returns another program's command in the same folder, with the same variables.
    pub fn other(&self, program: &OsStr, args: &[&str]) -> Command {
        let mut command = Command::new(program);
        for (name, _) in std::env::vars_os() {
            let name = name.to_string_lossy().into_owned();
            let stores = ["PICOFARM_", "AWS_", "GOOGLE_", "AZURE_"];
            if stores.iter().any(|start| name.starts_with(start)) {
                command.env_remove(name);
            }
        }
        command
            .args(args)
            .current_dir(&self.dir)
            .env("HOME", &self.dir)
            .env_remove("XDG_CONFIG_HOME")
            .env_remove("XDG_DATA_HOME")
            .envs(self.variables.iter().map(|(n, v)| (n, v)));
        command
    }

    /// Starts the command.
    pub fn start(&self, name: &str, args: &[&str]) -> Process {
        Process::start(name, self.command(args), &self.dir)
    }

    /// Runs another program to its end.
    pub fn run_other(&self, program: &OsStr, args: &[&str]) -> Ended {
        let mut ended = Process::start("program", self.other(program, args), &self.dir).end();
        ended.what = format!("{} {}", program.display(), args.join(" "));
        ended
    }

    /// Runs the command to its end.
    pub fn run(&self, args: &[&str]) -> Ended {
        let mut ended = self.start("command", args).end();
        ended.what = format!("picofarm {}", args.join(" "));
        ended
    }

    /// Runs the command with `--json` to its successful end, and returns the printed document.
    pub fn json(&self, args: &[&str]) -> Value {
        self.run(&[args, &["--json"]].concat()).ok().json()
    }
}

/// How a process ended.
#[derive(Debug, Clone)]
pub struct Ended {
    /// Name of the process.
    pub what: String,
    /// Exit code; `None` if a signal ended it.
    pub code: Option<i32>,
    /// All of stdout.
    pub stdout: String,
    /// All of stderr.
    pub stderr: String,
}

impl Ended {
    /// Checks that the exit code is 0.
    ///
    /// # Panics
    /// If the exit code differs.
    pub fn ok(self) -> Self {
        self.code(0)
    }

    /// Checks that the exit code is `code`.
    ///
    /// # Panics
    /// If the exit code differs.
    pub fn code(self, code: i32) -> Self {
        assert_eq!(
            self.code,
            Some(code),
            "{}\nstdout: {}\nstderr: {}",
            self.what,
            self.stdout,
            self.stderr
        );
        self
    }

    /// Checks that the command failed with `code` and that stderr contains each of `parts`.
    ///
    /// # Panics
    /// If it did not.
    pub fn fails(self, code: i32, parts: &[&str]) -> Self {
        let ended = self.code(code);
        for part in parts {
            assert!(
                ended.stderr.contains(part),
                "{}: expected {part:?} in stderr: {}",
                ended.what,
                ended.stderr
            );
        }
        ended
    }

    /// Returns the JSON document on stdout (on the last line, if there are several).
    ///
    /// # Panics
    /// If there is none.
    pub fn json(&self) -> Value {
        let line = self.stdout.lines().last().unwrap_or_default();
        serde_json::from_str(line)
            .unwrap_or_else(|e| panic!("{}: {e} in {:?}", self.what, self.stdout))
    }

    /// Returns the error that `--json` prints on stderr.
    ///
    /// # Panics
    /// If there is none.
    pub fn error(&self) -> Value {
        self.stderr
            .lines()
            .filter_map(|line| serde_json::from_str::<Value>(line).ok())
            .find_map(|document| document.get("error").cloned())
            .unwrap_or_else(|| panic!("{}: no JSON error in {:?}", self.what, self.stderr))
    }
}
