//! Single tasks: their outputs and failures.

use picofarm_proto::ids::{Epoch, StageRef};

use crate::range::Range;

/// A committed result.
#[derive(Debug, Clone, PartialEq)]
pub struct Output {
    /// The stage under which it was committed; its result set has the output.
    pub stage: StageRef,
    /// Task index.
    pub task: u64,
    /// SHA-256 of the manifest.
    pub manifest: [u8; 32],
    /// Size of the published objects in bytes.
    pub bytes: u64,
    /// Duration of the task in seconds.
    pub seconds: f64,
    /// The lease's epoch.
    pub epoch: Epoch,
    /// Whether it was found in the store instead of computed.
    pub adopted: bool,
    /// Whether the store is known to have this manifest.
    pub checked: bool,
}

/// A task that failed or was interrupted at least once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exception {
    /// The stage.
    pub stage: StageRef,
    /// Task index.
    pub task: u64,
    /// Number of failures of the task itself.
    pub failures: u32,
    /// Number of workers lost while they ran it.
    pub crashes: u32,
    /// Number of unfinished attempts that workers gave back.
    pub interruptions: u32,
    /// Duration of the longest unfinished attempt in milliseconds.
    pub longest_ms: u64,
    /// Whether the task was given up.
    pub dead: bool,
    /// Message of the last failure.
    pub last_error: String,
}

/// The record of one task.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TaskRecord {
    /// The range with the task; `None` if its job was cancelled.
    pub range: Option<Range>,
    /// The task's failures.
    pub exception: Option<Exception>,
    /// The task's result.
    pub output: Option<Output>,
}
