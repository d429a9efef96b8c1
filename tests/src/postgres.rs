//! A Postgres server of a test's own, that may be killed.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// A running server; stopped when dropped.
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
    /// Starts one; `None`, having said so, where tests/run has not seen to it that Postgres is installed.
    ///
    /// # Panics
    /// When it does not start.
    pub fn start(name: &str) -> Option<Self> {
        if std::env::var_os("PICOFARM_TEST_POSTGRES").is_none() {
            eprintln!("SKIPPED: tests/run sets PICOFARM_TEST_POSTGRES where Postgres is installed");
            return None;
        }
        // Its user must be able to enter the folder, and a socket's path is short.
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
    /// When it does not start.
    pub fn up(&mut self) {
        let started = script(&["start", &self.dir.display().to_string()]);
        let error = String::from_utf8_lossy(&started.stderr);
        assert!(started.status.success(), "{error}");
        String::from_utf8_lossy(&started.stdout)
            .trim()
            .clone_into(&mut self.url);
    }

    /// Ends it in order: connections break, what was committed stays.
    pub fn down(&self) {
        script(&["stop", &self.dir.display().to_string()]);
    }

    /// Ends it without a word to anyone and starts it again: it recovers what was committed.
    ///
    /// # Panics
    /// When it does not come back.
    pub fn crash(&mut self) {
        script(&["stop", &self.dir.display().to_string(), "immediate"]);
        self.up();
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        script(&["stop", &self.dir.display().to_string(), "immediate"]);
        // What is left over is in the system's folder for such things.
        let _ = std::fs::remove_dir_all(&self.dir);
    }
}
