//! Storage of histograms and ground truth: one Zarr v3 group per data set, and one object per scene
//! and quantity. Objects are published create-only into an object store, and zarr-python and xarray
//! can read them without our code.
//!
//! A scene is published once `manifests/<scene>.json` exists. Objects and manifests are pure
//! functions of the task, so running a task again writes the same bytes.

mod checkpoints;
mod coding;
mod error;
mod export;
pub mod import;
mod layout;
mod models;
mod predictions;
mod reconstructions;
mod render_group;
mod repair;
mod reports;
mod scenes;
mod store;
mod verdict;
mod verify;

/// The message of a program built without the feature `formats`, and how to build one with it.
#[cfg(not(feature = "formats"))]
const WITHOUT_FORMATS: &str = "this picofarm was built without OpenEXR and HDF5";
#[cfg(not(feature = "formats"))]
const BUILD_WITH_FORMATS: &str = "build it with `cargo build --release --features formats`, or with `--features full` for everything";

pub use checkpoints::{Checkpoint, Checkpoints, Pieces};
pub use coding::squareroot::{EncodeError, SATURATED, SquareRoot, photon_scale};
pub use coding::transient::{CodedImage, TransientCodec};
pub use error::DatasetError;
pub use export::{ExportFormat, Exported, Exporter};
pub use layout::arrays::INNER_SIDE;
pub use layout::manifest::{
    ENCODER_VERSION, FORMAT_VERSION, Manifest, ObjectEntry, SubsetCoding, sha256_hex,
};
pub use layout::quantity::Quantity;
pub use layout::record::{Intrinsics, Provenance, SceneRecord, Spot, SubsetRecord};
pub use layout::spec::{DatasetSpec, Gate, Profile, Subsets, Wavelength};
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
pub use render_group::read::RenderGroup;
pub use render_group::write::{RenderArray, encode_render_group, write_render_group};
pub use repair::collect::{Collection, MIN_GRACE, Orphan};
pub use repair::held::{Held, Holdings};
pub use repair::recipe::Recipe;
pub use repair::restore::Restored;
pub use repair::root::{Remains, remains, restore_root};
pub use reports::{REPORTS, ReportManifest, ReportedModel, Reports};
pub use scenes::dataset::Dataset;
pub use scenes::derive::SceneTruth;
pub use scenes::encode::EncodedScene;
pub use scenes::parts::PartName;
pub use scenes::read::Stored;
pub use scenes::snapshot::{Difference, Pinned, Snapshot};
pub use scenes::summary::Summary;
pub use store::folder::check_own_folder;
pub use store::objects::publish_files;
pub use store::{
    Bandwidth, PROBE_WITHIN, Writable, check_identity, check_location, check_writable,
    expect_identity, identify_store, limit_bandwidth, local_ground, open_store, probe,
    store_identity,
};
pub use verdict::{GUESS, Verdict};
pub use verify::{Fault, Problem, Verification, VerifyMode, VerifyOptions, Watch};
