//! Networks that decompose transients: their inputs, layers, training and metrics.
//!
//! The crate is independent of jobs, stores and leases: scenes are read through [`scene::Scenes`],
//! and weights and checkpoints are bytes.

pub mod baseline;
pub mod device;
mod error;
mod evaluate;
pub mod input;
mod kernel;
pub mod memory;
pub mod metric;
mod model;
pub mod net;
pub mod ops;
pub mod parameters;
mod random;
pub mod scene;
pub mod train;
pub mod trial;
pub mod weights;

/// The device that computes networks.
pub use burn::tensor::Device;
pub use device::cpu;
pub use error::ModelError;
pub use evaluate::{Answered, Evaluated, answered, answered_by, answers, evaluate, masks};
pub use kernel::AdamW;
pub use model::Model;
pub use random::Random;

/// The version of all code that determines the bytes of trained weights and the figures of
/// evaluations.
pub const VERSION: &str = "model-6";
