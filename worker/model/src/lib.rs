//! Networks that take transients apart: what they see, what they are made of, training, metrics.
//!
//! Knows nothing of jobs, stores or leases: scenes come through [`scene::Scenes`], weights and checkpoints go as bytes.

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
pub mod report;
pub mod scene;
pub mod train;
pub mod trial;
pub mod weights;

/// Where networks are computed.
pub use burn::tensor::Device;
pub use device::cpu;
pub use error::ModelError;
pub use evaluate::{Answered, Evaluated, answered, answers, evaluate, masks};
pub use kernel::AdamW;
pub use model::Model;
pub use random::Random;

/// Version of everything that decides the bytes of trained weights and the figures of evaluations.
pub const VERSION: &str = "model-6";
