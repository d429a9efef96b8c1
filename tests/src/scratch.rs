//! A folder of a test's own. It goes when the test passes; when it fails it stays, and its logs are shown.

use std::path::{Path, PathBuf};

/// The folder. Declare it before the processes that use it, so that they end first.
pub struct Scratch(PathBuf);

impl Scratch {
    /// A new folder for the test `name`.
    ///
    /// # Panics
    /// When the system's temporary folder cannot be used.
    pub fn new(name: &str) -> Self {
        let dir = tempfile::Builder::new()
            .prefix(&format!("picofarm-{name}-"))
            .tempdir()
            .expect("the temporary folder is writable");
        Self(dir.keep())
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// A path in it.
    pub fn join(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            // A folder that stays behind is no reason to fail a test that passed.
            let _ = std::fs::remove_dir_all(&self.0);
            return;
        }
        eprintln!("kept for inspection: {}", self.0.display());
        let mut logs: Vec<PathBuf> = std::fs::read_dir(&self.0)
            .into_iter()
            .flatten()
            .filter_map(|entry| Some(entry.ok()?.path()))
            // Of commands, the failed assertion shows what they said.
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
