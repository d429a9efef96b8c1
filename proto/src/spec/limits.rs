//! Limits on the size of a job and on its failures, and the resources of its workers.

use serde::{Deserialize, Serialize};

use super::{
    bounds,
    spec_error::{SpecError, within},
};

/// Most tasks in one job.
pub const MAX_TASKS: u64 = 100_000_000;
/// Default of `max_interruptions`.
const MAX_INTERRUPTIONS: u32 = 20;
/// Most jobs that one job waits for.
pub(super) const MAX_AFTER: usize = 64;
/// Most stages in one job.
pub const MAX_STAGES: usize = 1_000;

pub(super) fn check_count(field: &str, count: u64) -> Result<(), SpecError> {
    within(field, count, (1, MAX_TASKS), "scenes")
}

/// Limits after which a task, or the job, is given up.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Failures of the task itself after which it is dead.
    pub max_failures: u32,
    /// Losses of the worker during the task after which it is dead.
    pub max_crashes: u32,
    /// Attempts returned half-way by a worker after which the task is dead. A worker returns a task
    /// if it is told to end, or if its machine is in trouble. An attempt at a resumable task does
    /// not count if it made progress.
    #[serde(skip_serializing_if = "is_usual")]
    pub max_interruptions: u32,
    /// Most workers that may run the job at a time; 0 means no limit.
    #[serde(skip_serializing_if = "is_zero")]
    pub max_workers: u32,
    /// Time at which the unfinished job is cancelled (RFC 3339, e.g. `2026-12-01T18:00:00Z`); empty
    /// means never.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub deadline: String,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero(n: &u32) -> bool {
    *n == 0
}

/// Omits the default from the written form of a job, so that its hash matches that of earlier
/// versions.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_usual(n: &u32) -> bool {
    *n == MAX_INTERRUPTIONS
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_failures: 3,
            max_crashes: 3,
            max_interruptions: MAX_INTERRUPTIONS,
            max_workers: 0,
            deadline: String::new(),
        }
    }
}

impl Limits {
    /// Returns the deadline as Unix time, milliseconds.
    ///
    /// # Errors
    /// Returns an error if the text is not a time.
    pub fn deadline_ms(&self) -> Result<Option<i64>, SpecError> {
        if self.deadline.is_empty() {
            return Ok(None);
        }
        let time = humantime::parse_rfc3339(&self.deadline);
        let since = time.map(|t| t.duration_since(std::time::UNIX_EPOCH));
        match since {
            Ok(Ok(since)) => Ok(i64::try_from(since.as_millis()).ok()),
            _ => Err(SpecError::new(
                "limits.deadline",
                format!(
                    "{:?} is no time such as \"2026-12-01T18:00:00Z\"",
                    self.deadline
                ),
            )),
        }
    }

    pub(super) fn check(&self) -> Result<(), SpecError> {
        // More attempts than this amount to an endless loop.
        for (field, value) in [
            ("limits.max_failures", self.max_failures),
            ("limits.max_crashes", self.max_crashes),
            ("limits.max_interruptions", self.max_interruptions),
        ] {
            let unit = "attempts of a task; 1 gives it up at the first";
            within(field, value, (1, 1_000_000), unit)?;
        }
        let unit = "workers at a time; 0 is as many as there are";
        within("limits.max_workers", self.max_workers, (0, 1_000_000), unit)?;
        self.deadline_ms().map(|_| ())
    }
}

/// The resources that a worker must have to run a stage's tasks. A task may use all of them, and
/// several small tasks of a stage share the cores.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Resources {
    /// CPU cores.
    pub cores: u32,
    /// Memory in GiB (2^30 bytes).
    pub memory_gib: f64,
    /// GPUs: 1 for networks to be trained or evaluated on one.
    pub gpus: u32,
    /// Labels that the worker must have.
    pub labels: Vec<String>,
}

impl Resources {
    /// Returns whether there is no requirement.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    pub(super) fn check(&self) -> Result<(), SpecError> {
        within(
            "resources.cores",
            self.cores,
            (0, 65_536),
            "cores of one worker",
        )?;
        let gib = "GiB of one worker; 1 GiB is 1.07 GB";
        within("resources.memory_gib", self.memory_gib, (0.0, 1e6), gib)?;
        within(
            "resources.gpus",
            self.gpus,
            (0, 1),
            "graphics processors: a task computes on one, a training on several by train.processes",
        )?;
        if self.labels.len() > bounds::LIST {
            let what = format!(
                "{} labels; at most {} are allowed",
                self.labels.len(),
                bounds::LIST
            );
            return Err(SpecError::new("resources.labels", what));
        }
        for label in &self.labels {
            check_label(label).map_err(|what| SpecError::new("resources.labels", what))?;
        }
        Ok(())
    }
}

/// Checks a label, which appears in comma-separated lists and in messages.
///
/// # Errors
/// Returns a description of the fault.
pub fn check_label(label: &str) -> Result<(), String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.=".contains(c);
    if label.is_empty() || label.len() > 64 || !label.chars().all(plain) {
        return Err(format!(
            "{label:?} must be up to 64 letters, digits, '-', '_', '.' and '='"
        ));
    }
    Ok(())
}

/// Checks the name of a project, which appears in comma-separated lists and in messages.
///
/// # Errors
/// Returns a description of the fault.
pub fn check_project(name: &str) -> Result<(), String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if name.is_empty() || name.len() > 64 || !name.chars().all(plain) {
        return Err(format!(
            "{name:?} is not the name of a project: expected up to 64 letters, digits, '-', '_' and '.'"
        ));
    }
    Ok(())
}
