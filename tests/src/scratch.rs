//! A folder for a single test. It is deleted if the test passes. If the test fails, the folder is
//! retained and its logs are shown.

use std::path::{Path, PathBuf};

/// The folder. Declare it before the processes that use it, so that they end first.
pub struct Scratch(PathBuf);

impl Scratch {
    /// Creates a new folder for the test `name`.
    ///
    /// # Panics
    /// If the system's temporary folder cannot be used.
    pub fn new(name: &str) -> Self {
        let dir = tempfile::Builder::new()
            .prefix(&format!("picofarm-{name}-"))
            .tempdir()
            .expect("the temporary folder is writable");
        Self(dir.keep())
    }

    /// Returns its path.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Returns a path in it.
    pub fn join(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            // A test that passed must not fail because its folder cannot be deleted.
            let _ = std::fs::remove_dir_all(&self.0);
            return;
        }
        eprintln!("kept for inspection: {}", self.0.display());
        let mut logs: Vec<PathBuf> = std::fs::read_dir(&self.0)
            .into_iter()
            .flatten()
            .filter_map(|entry| Some(entry.ok()?.path()))
            // The output of commands is omitted, because the failed assertion shows it.
            .filter(|path| {
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                name.ends_with(".stderr") && !name.ends_with("-command.stderr")
            })
            .collect();
        logs.sort();
        for path in logs {
            let text = std::fs::read_to_string(&path).unwrap_or_default();
            let lines: Vec<&str> = text.lines().collect();
            eprintln!("--- end of {}", path.display());
            for line in &lines[lines.len().saturating_sub(25)..] {
                eprintln!("{line}");
            }
        }
    }
}
