//! Data sets of histograms and ground truth: one Zarr v3 group per data set, and one object per
//! scene and quantity. Objects are published create-only into an object store, and zarr-python and
//! xarray can read them without our code.
//!
//! A scene is published once `manifests/<scene>.json` exists. Objects and manifests are pure
//! functions of the task, so running a task again writes the same bytes.

mod coding;
mod layout;
mod render_group;
mod repair;
mod scenes;
mod verify;

pub use coding::codec::ChunkCodec;
pub use coding::shard;
pub use coding::squareroot::{EncodeError, SATURATED, SquareRoot, photon_scale, whole_photons};
pub use coding::transient::{CodedImage, TransientCodec};
pub use layout::arrays::{INNER_SIDE, Layout, image_codecs, index_codecs};
pub use layout::group::{METADATA, create_metadata, is_predictions, pretty};
pub use layout::manifest::{ENCODER_VERSION, FORMAT_VERSION, Manifest, SubsetCoding};
pub use layout::quantity::{Element, Quantity};
pub use layout::record::{Intrinsics, Provenance, SceneRecord, Spot, SubsetRecord};
pub use layout::spec::{DatasetSpec, Gate, Profile, Subsets, Wavelength};
pub use render_group::read::RenderGroup;
pub use render_group::single::{
    SINGLE_PICTURE, SingleRender, SingleRenderParts, write_single_render,
};
pub use render_group::write::{RenderArray, encode_render_group, write_render_group};
pub use repair::collect::{Collection, MIN_GRACE, Orphan, OrphanCause};
pub use repair::recipe::Recipe;
pub use repair::restore::Restored;
pub use repair::root::{Remains, remains, restore_root};
pub use repair::unfounded::SMALL;
pub use scenes::dataset::{ArrayCodec, Dataset, root_metadata};
pub use scenes::derive::SceneTruth;
pub use scenes::encode::EncodedScene;
pub use scenes::parts::PartName;
pub use scenes::read::Stored;
pub use scenes::snapshot::{Difference, Pinned, Snapshot};
pub use scenes::summary::Summary;
pub use verify::{VerifyOptions, metadata_fault};
