//! Scene descriptions: meshes, materials, cameras and laser beams; where they come from (generators,
//! import) and how they are written. Knows nothing of rendering or of the farm.
//!
//! World space is right-handed, metres, +y up. Cameras follow the measurement contract: the camera
//! frame has x right, y **down** (image rows grow with y) and z forward.

mod camera;
mod laser;
mod material;
mod mesh;
mod model;
mod vec3;

pub use camera::{Camera, Intrinsics};
pub use laser::{Beam, Laser, LaserGrid, Spot};
pub use material::{Bsdf, Distribution, Material};
pub use mesh::Mesh;
pub use model::{Object, Provenance, Scene, SceneError};
pub use vec3::{Affine, Vec3};
