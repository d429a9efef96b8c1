//! The sensor model: stored transients in, photon counts out. Functions on arrays; knows nothing of jobs, stores or files.
//!
//! In this order, for each pixel (the model of the "Sensor model" section of the method's appendix A.5):
//!
//! 1. rate = scale · (h ⊛ pulse ⊛ jitter) + dark, photons a bin;
//! 2. pile-up, where asked for: at most one photon a pulse is seen;
//! 3. counts = Poisson(rate);
//! 4. adjacent bins are summed.
//!
//! What the convolution pushes out of the gate is dropped and counted. Every random number depends on
//! (seed, scene, pixel, bin) alone: the number of threads changes nothing, nor does the order of the pixels.

mod alias;
mod bins;
mod convolve;
mod draw;
mod kernel;
mod sense;
mod spots;

pub use bins::{Rebinned, crop, intensity, rebin, rebin_counts, rebin_errors};
pub use draw::{Draws, binomial, poisson};
pub use kernel::Kernel;
pub use picofarm_settings::{DeadTime, Jitter, PS_PER_M, Pulse, Scale, Sensor, SensorError};
pub use sense::{Dropped, Histograms, Sensed, Sensing, Values, narrow, sense};
pub use spots::{Multiplex, SPOTS_4_OF_100, SPOTS_25_OF_100, multiplex};

/// Version of the sensed values: change it whenever any output bit may change.
pub const SENSOR_VERSION: &str = "sensor-2";
