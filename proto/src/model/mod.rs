//! The checked model: what the coordinator and the agent reason about. Wire types convert into these.

pub mod evaluate;
pub mod explain;
pub mod file;
mod generate;
mod import;
pub mod infer;
pub mod job;
pub mod lease;
pub mod log;
mod refer;
pub mod render;
pub mod report;
pub mod reprocess;
mod scale;
pub mod sensor;
pub mod status;
pub mod sweep;
pub mod task;
mod text;
pub mod train;

pub use evaluate::{EvaluateSettings, EvaluateTask};
pub use explain::{ConnectedWorker, Made, Reason, TaskExplanation, TaskOutput, TaskState};
pub use generate::{GenerateSettings, GenerateTask};
pub use import::{ImportSettings, ImportTask};
pub use infer::{InferSettings, InferTask};
pub use job::{JobSpec, Limits, OutputSettings, Resources, SpecError, StageSpec, check_label};
pub use lease::{
    Abilities, Failure, FailureKind, Finished, Lease, TaskAt, TaskProgress, WorkerHello,
};
pub use log::{LogAllowance, LogLevel, LogLine, TaskLog};
pub use render::{
    Budget, Choice, PartTask, RenderSettings, RenderTask, SceneFile, SceneKind, SceneSource,
};
pub use report::{ReportSettings, ReportTask};
pub use reprocess::{Histogram, ReprocessSettings, ReprocessTask, SourceSettings};
pub use scale::scaled;
pub use sensor::{DeadTimeSettings, JitterSettings, PulseSettings, ScaleSettings, SensorSettings};
pub use status::{
    Event, EventKind, JobPlan, JobState, JobStatus, RunningTask, StagePlan, StageState,
    StageStatus, TaskCounts,
};
pub use sweep::{Halving, PromoteSettings, PromoteTask, Trial};
pub use task::{ExportSettings, ExportTask, SplitTask, TaskSpec};
pub use text::parse_share;
pub use train::{TrainSettings, TrainTask};
