//! The messages between a Python process and its worker.

use std::{collections::BTreeMap, path::PathBuf};

use serde::Deserialize;
use serde_json::Value;

/// Most bytes of a message.
pub(super) const MESSAGE_BYTES: u64 = 1 << 20;
/// Most metrics of a report.
const METRICS: usize = 256;
/// Most bytes of the name of a metric or an artefact.
const NAME_BYTES: usize = 128;

/// A message of the process.
#[derive(Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Message {
    /// Metrics after a step or an epoch.
    Report(Report),
    /// A file with a checkpoint.
    Checkpoint { step: u64, path: PathBuf },
    /// A file to be published.
    Artifact { name: String, path: PathBuf },
    /// The completed share of the work.
    Progress(f32),
    /// Asks whether to stop.
    Poll {},
    /// The end of the work.
    Done(Done),
}

/// Metrics after a step or an epoch.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Report {
    /// Number of completed steps.
    #[serde(default)]
    pub step: Option<u64>,
    /// Number of completed epochs.
    #[serde(default)]
    pub epoch: Option<u64>,
    /// Numbers by name; `None` = not finite.
    pub metrics: BTreeMap<String, Option<f64>>,
}

/// The end of the work.
#[derive(Debug, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Done {
    /// What the code returned.
    #[serde(default)]
    pub result: Value,
    /// The reason if it ended because it was asked to.
    #[serde(default)]
    pub stopped: Option<String>,
    /// Interpreter, versions and host.
    #[serde(default)]
    pub facts: Value,
}

/// Reads a message.
///
/// # Errors
/// Returns a description of the fault.
pub(super) fn read(line: &[u8]) -> Result<Message, String> {
    serde_json::from_slice(line).map_err(|e| {
        let shown: String = String::from_utf8_lossy(line).chars().take(80).collect();
        format!("{shown:?} is no message ({e}); write to the socket by picofarm.run only")
    })
}

/// Checks a name of a metric or an artefact.
///
/// # Errors
/// Returns a description of the fault.
pub(super) fn check_name(what: &str, name: &str) -> Result<(), String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if (1..=NAME_BYTES).contains(&name.len()) && !name.starts_with('.') && name.chars().all(plain) {
        return Ok(());
    }
    Err(format!(
        "{what} {name:?}: expected up to {NAME_BYTES} letters, digits, '-', '_' and '.', not beginning with '.'"
    ))
}

impl Report {
    /// Checks the number of metrics and their names.
    ///
    /// # Errors
    /// Returns a description of the fault.
    pub(super) fn check(&self) -> Result<(), String> {
        if self.metrics.len() > METRICS {
            let n = self.metrics.len();
            return Err(format!("report: {n} metrics; report at most {METRICS}"));
        }
        let mut names = self.metrics.keys();
        names.try_for_each(|name| check_name("report: metric", name))
    }
}
