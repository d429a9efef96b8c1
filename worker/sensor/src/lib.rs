//! The sensor model: stored transients in, photon counts out. It consists of functions on arrays,
//! independent of jobs, stores and files.
//!
//! The steps for each pixel, in this order (the model of the "Sensor model" section of the method's
//! appendix A.5):
//!
//! 1. zones, if requested: the mean of the histograms of a wide pixel;
//! 2. rate = scale · (h ⊛ pulse ⊛ jitter), photons per bin, moved to the detector's own bins if it
//!    has a gate, plus dark counts, plus crosstalk from the neighbours;
//! 3. counts = Poisson(rate), with pile-up and afterpulses, if requested;
//! 4. adjacent bins are summed.
//!
//! Light that the convolution moves out of the gate is dropped and counted. Every random number
//! depends only on (seed, scene, pixel, bin), so neither the number of threads nor the order of the
//! pixels changes the result.

mod afterpulse;
mod alias;
mod bins;
mod chain;
mod convolve;
mod draw;
mod free_running;
mod image;
mod kernel;
mod resample;
mod scale;
mod sense;
mod spots;

pub use bins::{Rebinned, crop, intensity, rebin, rebin_counts, rebin_errors};
pub use draw::{Draws, binomial, poisson};
pub use image::Frame;
pub use kernel::Kernel;
pub use picofarm_settings::{
    Afterpulsing, Crosstalk, DeadTime, Jitter, PS_PER_M, Preset, Pulse, Scale, Sensor, SensorError,
    TimeGate, Zones,
};
pub use resample::{Resampled, Resampler, resample};
pub use sense::{Dropped, Histograms, Sensed, Sensing, Values, narrow, sense, sense_image};
pub use spots::{Multiplex, SPOTS_4_OF_100, SPOTS_25_OF_100, multiplex};

/// Version of the sensed values. Change it whenever any output bit may change.
pub const SENSOR_VERSION: &str = "sensor-2";
