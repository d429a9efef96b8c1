//! How good a reconstruction is, against the true scene.

mod mesh;
mod views;

pub use mesh::{Floaters, MeshScore, floaters, mesh_score};
pub use views::{Class, Split, ViewScore, around, score_views};
