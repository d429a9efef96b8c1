//! Networks that take transients apart: what they see, what they are made of, training, metrics.
//!
//! Knows nothing of jobs, stores or leases: scenes come through [`scene::Scenes`], weights and checkpoints go as bytes.

mod error;
pub mod input;
mod kernel;
pub mod metric;
pub mod net;
pub mod ops;
pub mod parameters;
mod random;
pub mod scene;
pub mod train;
pub mod trial;
pub mod weights;

pub use error::ModelError;
pub use kernel::AdamW;
pub use random::Random;
