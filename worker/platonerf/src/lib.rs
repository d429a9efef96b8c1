//! PlatoNeRF (Klinghoffer et al., CVPR 2024): two small networks that learn the density of one room
//! from light that bounced twice.
//!
//! The crate is a reference for `picofarm-reconstruct`, which does the same in seconds with a grid.
//! It uses the same measurements and the paper's method with its two stages, losses, samples and
//! schedule. Its result is sampled on that crate's grid ([`Fitted::sampled`]), so meshes, files and
//! errors of both are computed by the same code. Sampling loses detail finer than a node;
//! [`Fitted::view`] renders novel views through the network itself, so that the loss can be
//! measured.

mod adam;
mod checkpoint;
mod fitted;
mod loss;
mod network;
mod random;
mod rays;
mod render;
mod sample;
mod settings;
mod training;

#[cfg(test)]
mod tests;

pub use fitted::{Fitted, Ray};
pub use picofarm_settings::{MlpSettings, ShadowLoss};
pub use settings::{Settings, grid};
pub use training::Training;
