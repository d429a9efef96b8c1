//! Histograms and ground truth at rest: one Zarr v3 group a data set, one object a scene and quantity, published
//! create-only into an object store and readable by zarr-python and xarray without our code.
//!
//! A scene counts as published once `manifests/<scene>.json` exists. Objects and manifests are pure functions of the
//! task, so whoever runs a task again writes the same bytes.

mod codec;
mod coding;
mod collect;
mod counts;
mod dataset;
mod derive;
mod encode;
mod error;
mod export;
mod group;
mod held;
pub mod import;
mod layout;
mod listing;
mod manifest;
mod models;
mod objects;
mod parts;
mod predictions;
mod publish;
mod read;
mod recipe;
mod record;
mod render_group;
mod render_read;
mod reports;
mod restore;
mod root;
mod rounding;
mod shard;
mod snapshot;
mod spec;
mod splits;
mod squareroot;
mod store;
mod summary;
mod tiles;
mod transient;
mod values;
mod verify;
mod window;

pub use collect::{Collection, MIN_GRACE, Orphan};
pub use dataset::Dataset;
pub use derive::SceneTruth;
pub use encode::EncodedScene;
pub use error::DatasetError;
pub use export::{ExportFormat, Exported, Exporter};
pub use held::{Held, Holdings};
pub use layout::{INNER_SIDE, Quantity};
pub use manifest::{
    ENCODER_VERSION, FORMAT_VERSION, Manifest, ObjectEntry, SubsetCoding, sha256_hex,
};
pub use models::{
    Checkpoint, Dependents, Evaluation, Lineage, MODELS, ModelCheck, ModelManifest, ModelRepair,
    Models, NewModel, Promoted, Published, Removed, Rung, SplitUsed, TrainingSpeed, TrialEnd,
    TrialRecord,
};
pub use objects::publish_files;
pub use parts::PartName;
pub use predictions::{
    EncodedPredictions, ModelUsed, Predicted, PredictionManifest, PredictionSpec, Predictions,
    SceneUsed, TimesUsed,
};
pub use read::Stored;
pub use recipe::Recipe;
pub use record::{Intrinsics, Provenance, SceneRecord, Spot, SubsetRecord};
pub use render_group::{RenderArray, write_render_group};
pub use render_read::RenderGroup;
pub use reports::{REPORTS, ReportManifest, ReportedModel, Reports};
pub use restore::Restored;
pub use root::{Remains, remains, restore_root};
pub use snapshot::{Difference, Pinned, Snapshot};
pub use spec::{DatasetSpec, Gate, Profile, Subsets};
pub use squareroot::{EncodeError, SATURATED, SquareRoot, photon_scale};
pub use store::{
    Bandwidth, PROBE_WITHIN, Writable, check_location, check_writable, limit_bandwidth,
    local_ground, open_store, probe,
};
pub use summary::Summary;
pub use transient::{CodedImage, TransientCodec};
pub use verify::{Fault, Problem, Verification, VerifyMode, VerifyOptions, Watch};
