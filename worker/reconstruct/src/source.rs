//! Where measurements come from.

mod captures;
mod truth;

pub use captures::{Captures, LIT_THRESHOLD};
pub use truth::{Disturbed, from_truth, surface_normals};
