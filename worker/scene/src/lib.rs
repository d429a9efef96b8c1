//! Scene descriptions: meshes, materials, cameras and laser beams; their sources (generators,
//! import) and their export. The crate is independent of rendering and of the farm.
//!
//! World space is right-handed, metres, +y up. Cameras follow the measurement contract: the camera
//! frame has x right, y **down** (image rows grow with y) and z forward.

mod assets;
mod body;
mod box_view;
mod camera;
pub mod export;
mod extras;
pub mod furnished;
pub mod import;
mod label;
mod laser;
mod layout;
mod material;
mod mesh;
mod model;
pub mod plato;
pub mod primitive;
mod range;
mod rng;
mod shape;
mod spectrum;
mod texture;
mod trace;
mod tree;
mod vec3;
mod view;
mod viewpoint;

pub use assets::{AssetLibrary, Scanned, install, scan};
pub use camera::{Camera, Intrinsics};
pub use label::LABELS;
pub use laser::{Aim, Beam, Laser, Spot};
pub use material::{Bsdf, Distribution, Material};
pub use mesh::Mesh;
pub use model::{Object, Provenance, Scene, SceneError};
pub use range::FittedGate;
pub use spectrum::{AtWavelength, SpectrumPoint};
pub use texture::{Texture, Wrap};
pub use vec3::{Affine, Vec3};
pub use view::{MAX_DEPTH_M, MIN_DEPTH_M};
