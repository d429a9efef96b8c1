//! Where measurements come from.

mod captures;
mod rendered;
mod truth;

pub use captures::{Captures, LIT_THRESHOLD};
pub use rendered::{CaptureProgress, CaptureSettings, captures_of, truth_of};
pub use truth::{Disturbed, from_truth, surface_normals};
