//! Single tasks: what they made, and how they failed.

use picofarm_proto::ids::{Epoch, StageRef};

use crate::range::Range;

/// A committed result.
#[derive(Debug, Clone, PartialEq)]
pub struct Output {
    /// The stage under which it was committed; its result set owns the output.
    pub stage: StageRef,
    /// Task index.
    pub task: u64,
    /// SHA-256 of the manifest.
    pub manifest: [u8; 32],
    /// Bytes published.
    pub bytes: u64,
    /// Seconds it took.
    pub seconds: f64,
    /// The lease's epoch.
    pub epoch: Epoch,
    /// Found in the store and not computed.
    pub adopted: bool,
    /// The store was found to hold this manifest.
    pub checked: bool,
}

/// A task that failed or was interrupted at least once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exception {
    /// The stage.
    pub stage: StageRef,
    /// Task index.
    pub task: u64,
    /// Failures of the task's own.
    pub failures: u32,
    /// Workers lost while they ran it.
    pub crashes: u32,
    /// Attempts that a worker gave back half-way.
    pub interruptions: u32,
    /// The longest attempt that did not end, milliseconds.
    pub longest_ms: u64,
    /// Given up.
    pub dead: bool,
    /// The last failure, in words.
    pub last_error: String,
}

/// All that is known of one task.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TaskRecord {
    /// The range that has it; `None` where its job was stopped.
    pub range: Option<Range>,
    /// Its failures.
    pub exception: Option<Exception>,
    /// Its result.
    pub output: Option<Output>,
}
