//! Measurements of other renderers, as written by tests/lab/peers.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use picofarm_cli::error::{CliError, Result, io};

/// A file with the measurements of one tool.
#[derive(Debug, Clone, Deserialize)]
pub struct Peer {
    /// Name and version.
    pub tool: String,
    pub runs: Vec<PeerRun>,
}

/// One scene, rendered in one way.
#[derive(Debug, Clone, Deserialize)]
pub struct PeerRun {
    /// Name of the scene.
    pub scene: String,
    /// How the tool was used.
    pub mode: String,
    pub width: u32,
    pub height: u32,
    pub bins: u32,
    pub rungs: Vec<PeerRung>,
}

/// One budget.
#[derive(Debug, Clone, Copy, Deserialize, Serialize)]
pub struct PeerRung {
    pub samples: u32,
    /// CPU seconds, user and system, over all threads.
    pub cpu_seconds: f64,
    /// Median over pixels of the relative error, as in [`super::deviation`].
    pub error: f64,
}

/// Reads the files.
///
/// # Errors
/// Fails if a file cannot be read or has another format.
pub fn read(paths: &[PathBuf]) -> Result<Vec<Peer>> {
    let one = |path: &PathBuf| {
        let what = || format!("--peer {}", path.display());
        let bytes = std::fs::read(path).map_err(|e| io(what(), &e))?;
        serde_json::from_slice(&bytes).map_err(|e| {
            CliError::input(format!("{}: {e}", what()))
                .hint("tests/lab/peers/mitransient.sh writes such files")
        })
    };
    paths.iter().map(one).collect()
}
