//! Checks a measured capture and corrects its calibration: t0, laser, spots, camera, pixels, pulse.
//!
//! A pixel has one depth, and each spot that lights it gives a time of two-bounce light:
//!
//! > path = |L − x_l| + |x − L| + |x|
//!
//! with the laser x_l, the spot L and the surface x on the pixel's ray, in the camera's frame. The
//! times of three and more spots agree on one depth only if t0, laser, spots and camera are right.
//! [`check`] works in these steps:
//!
//! 1. `pixels`: dead and hot pixels, clipped counts, pile-up, background;
//! 2. `pulse`, `observe`, `times`: returns of one bounce, the pulse, and the time of each pixel's
//!    first peak to a fraction of a bin;
//! 3. `hypotheses`: mirrored images, spots in another order, another unit of time;
//! 4. `fit`: t0, laser, bin width and focal length by robust least squares, with the depth of each
//!    pixel eliminated; `spots`: single spots that are elsewhere;
//! 5. `masks`: the order of stated masks;
//! 6. `evidence`, `unexplained`: whether the times can show a fault at all, and whether any
//!    calibration explains them;
//! 7. `causes`: what was found, with figures and a verdict; `correct`: the corrected capture.
//!
//! t0 refers to the peak of the pulse. This crate knows nothing of jobs or files.

mod assign;
mod causes;
mod check;
mod correct;
mod counting;
mod cut;
mod evidence;
mod fit;
mod flash;
mod geometry;
mod hypotheses;
mod masks;
mod measurement;
mod model;
mod normal;
mod numeric;
mod observe;
mod pixels;
mod pulse;
mod report;
mod spots;
mod times;
mod unexplained;
mod wide;

pub use assign::assign;
pub use check::{Checked, Pictures, check};
pub use correct::Corrected;
pub use geometry::geometry;
pub use hypotheses::Turn;
pub use measurement::{CalibrateError, Measurement};
pub use pulse::Pulse;
pub use report::{Agreement, Cause, Evidence, Fault, PulseFound, Report, SpotResidual, Verdict};

/// Version of the method: changes whenever any bit of a result may change.
pub const VERSION: &str = "calibrate-4";
