//! What a job asks for: stages, kinds of task, their settings and limits, and the memory that they
//! need. Everything here is checked; job files and wire types convert into it.

pub mod bounds;
mod destination;
pub mod domain;
pub mod file;
pub mod job;
pub mod kinds;
pub mod limits;
pub mod matrix;
pub mod memory;
pub mod places;
mod refer;
mod scale;
mod spec_error;
pub mod stage;
pub mod stop;
mod substitute;
pub mod sweep;
mod texts;
pub mod trial;

pub use destination::{Destination, Place};
pub use domain::{Domain, Interval};
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
    scenes::{FileView, SceneFile, SceneKind, SceneSource},
    train::{self, TrainSettings},
};
pub use limits::{Limits, Resources, check_label, check_project};
// Types shared by jobs, data sets, the renderer and the networks.
pub use picofarm_settings::{Budget, Choice, PrimitiveRooms, Sensor, Spots, Strategy};
pub use places::{OutputSettings, SourceSettings};
pub use scale::scaled;
pub use spec_error::SpecError;
pub use stage::StageSpec;
pub use stop::{Halving, Median, Stop};
pub use trial::Trial;
