//! The sources of measurements.

mod captures;
mod counted;
mod expected;
mod flash;
mod given;
mod rendered;
mod truth;

pub use captures::{Captures, LIT_THRESHOLD};
pub use flash::{Certainty, from_flash, weigh};
pub use given::{Given, Times, given};
pub use rendered::{CaptureProgress, CaptureSettings, captures_of, truth_of};
pub use truth::{Disturbed, from_truth, surface_normals};
