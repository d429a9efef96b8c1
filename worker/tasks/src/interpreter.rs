//! The Python that runs code of jobs.

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

/// Oldest version that runs the worker's own files.
const OLDEST: [u32; 2] = [3, 10];
/// Prints the version, and what else an environment depends on.
const ASKED: &str = "import sys, sysconfig
print('.'.join(map(str, sys.version_info[:3])))
print(sys.version, sys.implementation.cache_tag, sys.abiflags, sysconfig.get_platform(), sys.base_prefix)";

/// The Python that runs tasks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Interpreter {
    path: PathBuf,
    version: String,
    build: String,
}

impl Interpreter {
    /// Starts the interpreter once, to learn its version.
    ///
    /// # Errors
    /// Returns a description of the fault.
    pub(crate) fn find(path: &Path) -> Result<Self, String> {
        let path = match path.components().count() {
            // A name is looked for in PATH, also in the folder of a task.
            1 => path.to_owned(),
            _ => std::path::absolute(path).map_err(|e| format!("{}: {e}", path.display()))?,
        };
        let ran = Command::new(&path)
            .args(["-I", "-c", ASKED])
            .stdin(Stdio::null())
            .output()
            .map_err(|e| format!("cannot start {}: {e}; name a Python", path.display()))?;
        let told = String::from_utf8_lossy(&ran.stdout);
        let (version, build) = told.trim().split_once('\n').unwrap_or((told.trim(), ""));
        let numbers: Vec<u32> = version.split('.').filter_map(|n| n.parse().ok()).collect();
        if !ran.status.success() || numbers.len() != 3 {
            let what = format!("{} is no Python; name one", path.display());
            return Err(what);
        }
        if numbers[..2] < OLDEST[..] {
            let what = format!("{} is Python {version}; name one from 3.10", path.display());
            return Err(what);
        }
        Ok(Self {
            path,
            version: version.to_owned(),
            build: build.to_owned(),
        })
    }

    /// The path of the program.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The version, as 3.12.1.
    pub(crate) fn version(&self) -> &str {
        &self.version
    }

    /// Version, platform and folder of the installation. Interpreters with an equal build can
    /// share the packages of a virtual environment.
    pub(crate) fn build(&self) -> &str {
        &self.build
    }
}
