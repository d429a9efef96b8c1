//! Results in a store, next to its data sets: models, predictions, reconstructions, reports, and
//! the checkpoints of long tasks.

mod checkpoints;
mod collect;
mod held;
mod models;
mod predictions;
mod reconstructions;
mod reports;
mod verdict;

pub use checkpoints::{Checkpoint, Checkpoints, Pieces};
pub use collect::collect_garbage;
pub use held::{Held, Holdings};
pub use models::{
    Dependents, DepthsUsed, Evaluation, Lineage, MODELS, Measurement, ModelCheck, ModelManifest,
    ModelRepair, Models, NewModel, Promoted, Published, Removed, Rung, ShardName, SplitUsed,
    TrainingSpeed, TrialEnd, TrialRecord,
};
pub use predictions::{
    EncodedPredictions, ModelUsed, PinnedDepths, Predicted, PredictionManifest, PredictionSpec,
    Predictions, SceneUsed, TimesUsed,
};
pub use reconstructions::{ReconstructionManifest, Reconstructions};
pub use reports::{REPORTS, ReportManifest, ReportedModel, Reports};
pub use verdict::{GUESS, Verdict};
