//! The checked model: what the coordinator and the agent reason about. Wire types convert into these.

pub mod explain;
pub mod job;
pub mod lease;
pub mod reprocess;
pub mod sensor;
pub mod status;
mod text;

pub use explain::{ConnectedWorker, Made, Reason, TaskExplanation, TaskOutput, TaskState};
pub use job::{
    Budget, Choice, JobSpec, Limits, OutputSettings, RenderSettings, SceneFile, SceneKind,
    SceneSource, SpecError,
};
pub use lease::{Failure, FailureKind, Finished, Lease, TaskProgress, WorkerHello};
pub use reprocess::{Histogram, ReprocessSettings, SourceSettings};
pub use sensor::{DeadTimeSettings, JitterSettings, PulseSettings, ScaleSettings, SensorSettings};
pub use status::{Event, EventKind, JobPlan, JobState, JobStatus, RunningTask, TaskCounts};
pub use text::parse_share;
