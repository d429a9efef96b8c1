//! The messages of coordinator, workers and clients in checked form. Wire types convert into them.

pub mod audit;
pub mod examine;
pub mod explain;
pub mod lease;
pub mod log;
pub mod status;
pub mod usage;

pub use audit::{Act, AuditEntry, Outcome};
pub use examine::{Check, Examine, Examined, ExaminedWorker, Verdict};
pub use explain::{ConnectedWorker, Made, Reason, TaskExplanation, TaskOutput, TaskState};
pub use lease::{
    Abilities, Failure, FailureKind, Finished, Lease, TaskAt, TaskProgress, WorkerHello,
};
pub use log::{LogAllowance, LogLevel, LogLine, TaskLog};
pub use status::{
    Estimate, Event, EventKind, JobPlan, JobState, JobStatus, JobSummary, RunningTask, StagePlan,
    StageState, StageStatus, TaskCounts,
};
pub use usage::{Usage, UsageBy, UsageRow};
