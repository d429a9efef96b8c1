//! Networks that take transients apart: what they see, what they are made of, training, metrics.
//!
//! Knows nothing of jobs, stores or leases: scenes come through [`scene::Scenes`], weights and checkpoints go as bytes.

pub mod baseline;
mod error;
mod evaluate;
pub mod input;
mod kernel;
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
pub use error::ModelError;
pub use evaluate::{Answered, Evaluated, answered, answers, evaluate, masks};
pub use kernel::AdamW;
pub use model::Model;
pub use random::Random;

/// Version of everything that decides the bytes of trained weights and the figures of evaluations.
pub const VERSION: &str = "model-5";

/// Whether this program was built to use graphics processors.
pub const HAS_GPUS: bool = cfg!(feature = "cuda");

/// A graphics processor: the first there is.
///
/// # Errors
/// [`ModelError::Invalid`] where the program was built without the feature `cuda`, or finds no driver or no processor.
#[cfg(feature = "cuda")]
pub fn gpu() -> Result<Device, ModelError> {
    use burn::tensor::Tensor;
    // What opens the driver panics where there is none.
    let opened = std::panic::catch_unwind(|| {
        let device = Device::cuda(0);
        let one = Tensor::<1>::ones([1], &device).into_scalar::<f32>();
        (one == 1.0).then_some(device)
    });
    opened.ok().flatten().ok_or_else(|| {
        ModelError::invalid(
            "gpus",
            "no graphics processor answers: is its driver (libcuda.so) installed, and may this process use it?",
        )
    })
}

/// A graphics processor.
///
/// # Errors
/// [`ModelError::Invalid`]: this program was built without them.
#[cfg(not(feature = "cuda"))]
pub fn gpu() -> Result<Device, ModelError> {
    Err(ModelError::invalid(
        "gpus",
        "this program was built without graphics processors: build it with --features cuda",
    ))
}

/// The CPU.
pub fn cpu() -> Device {
    Device::flex()
}
