//! The checked model used by the coordinator and the agent. Wire types convert into these types.

pub mod audit;
pub mod bounds;
mod destination;
pub mod domain;
pub mod explain;
pub mod file;
pub mod job;
pub mod kinds;
pub mod lease;
pub mod limits;
pub mod log;
pub mod matrix;
pub mod memory;
pub mod places;
mod refer;
mod scale;
mod spec_error;
pub mod stage;
pub mod status;
pub mod stop;
mod substitute;
pub mod sweep;
mod texts;
pub mod trial;

pub use audit::{Act, AuditEntry, Outcome};
pub use destination::{Destination, Place};
pub use domain::{Domain, Interval};
// Types shared by jobs, data sets, the renderer and the networks.
pub use explain::{ConnectedWorker, Made, Reason, TaskExplanation, TaskOutput, TaskState};
pub use job::JobSpec;
pub use kinds::{
    EvaluateShardTask, EvaluateTask, ExportSettings, ExportTask, GenerateTask, ImportTask,
    InferTask, PartTask, PromoteSettings, PromoteTask, RenderTask, ReportTask, ReprocessTask,
    SplitTask, TaskKind, TaskSpec, TrainTask,
    evaluate::{self, EvaluateSettings},
    generate::GenerateSettings,
    import::ImportSettings,
    infer::{self, InferSettings},
    render::{self, RenderSettings, parse_share},
    report::{self, ReportSettings},
    reprocess::{self, Histogram, ReprocessSettings},
    scenes::{SceneFile, SceneKind, SceneSource},
    train::{self, TrainSettings},
};
pub use lease::{
    Abilities, Failure, FailureKind, Finished, Lease, TaskAt, TaskProgress, WorkerHello,
};
pub use limits::{Limits, Resources, check_label, check_project};
pub use log::{LogAllowance, LogLevel, LogLine, TaskLog};
pub use picofarm_settings::{Budget, Choice, PrimitiveRooms, Sensor, Spots, Strategy};
pub use places::{OutputSettings, SourceSettings};
pub use scale::scaled;
pub use spec_error::SpecError;
pub use stage::StageSpec;
pub use status::{
    Estimate, Event, EventKind, JobPlan, JobState, JobStatus, JobSummary, RunningTask, StagePlan,
    StageState, StageStatus, TaskCounts,
};
pub use stop::{Halving, Median, Stop};
pub use trial::Trial;
