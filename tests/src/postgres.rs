//! A Postgres server for a single test, which may be killed.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// A running server, stopped on drop.
pub struct Postgres {
    dir: PathBuf,
    /// Its URL.
    pub url: String,
}

fn script(args: &[&str]) -> std::process::Output {
    let script = Path::new(&crate::package()).join("services/postgres.sh");
    Command::new(script)
        .args(args)
        .output()
        .expect("the script runs")
}

impl Postgres {
    /// Starts a server. Prints a message and returns `None` if tests/run has not set up Postgres.
    ///
    /// # Panics
    /// If it does not start.
    pub fn start(name: &str) -> Option<Self> {
        if std::env::var_os("PICOFARM_TEST_POSTGRES").is_none() {
            eprintln!("SKIPPED: tests/run sets PICOFARM_TEST_POSTGRES where Postgres is installed");
            return None;
        }
        // The user of the server must be able to enter the folder, and the path of a socket must be
        // short.
        let dir = std::env::temp_dir().join(format!("pf-{name}-{}", std::process::id()));
        let mut server = Self {
            dir,
            url: String::new(),
        };
        server.up();
        Some(server)
    }

    /// Starts it again.
    ///
    /// # Panics
    /// If it does not start.
    pub fn up(&mut self) {
        let started = script(&["start", &self.dir.display().to_string()]);
        let error = String::from_utf8_lossy(&started.stderr);
        assert!(started.status.success(), "{error}");
        String::from_utf8_lossy(&started.stdout)
            .trim()
            .clone_into(&mut self.url);
    }

    /// Stops it in order: connections break, committed data remain.
    pub fn down(&self) {
        script(&["stop", &self.dir.display().to_string()]);
    }

    /// Kills it and starts it again. It recovers the committed data.
    ///
    /// # Panics
    /// If it does not restart.
    pub fn crash(&mut self) {
        script(&["stop", &self.dir.display().to_string(), "immediate"]);
        self.up();
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        script(&["stop", &self.dir.display().to_string(), "immediate"]);
        // Files that remain are in the system's temporary folder.
        let _ = std::fs::remove_dir_all(&self.dir);
    }
}
