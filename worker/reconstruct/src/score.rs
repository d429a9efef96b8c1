//! Scores of a reconstruction, relative to the true scene.

mod mesh;
mod views;

pub use mesh::{Floaters, MeshScore, floaters, mesh_score};
pub use views::{Class, Split, ViewScore, around, around_unseen, score_views};
