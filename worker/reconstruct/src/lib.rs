//! Reconstruction of one scene from light that bounced twice: a density field of a room, fitted to
//! two-bounce times and shadow masks, in seconds on a CPU.
//!
//! The problem is PlatoNeRF's (Klinghoffer et al., CVPR 2024). The method is not a network but a
//! grid with a start from closed-form depth and carving. `closed_form`, `planes`, `start`, `carve`
//! and `optimise` explain the steps in this order; `docs/benchmarks.md` has the figures. This crate
//! is independent of jobs and stores; the caller handles files.

mod agreement;
pub mod baseline;
mod carve;
mod checkpoint;
mod closed_form;
mod error;
pub mod field;
mod measured;
mod mesh;
mod optimise;
mod paths;
mod planes;
mod progress;
mod rays;
mod reconstruction;
pub mod render;
mod rng;
pub mod saved;
mod scale;
pub mod score;
pub mod source;
mod start;
mod unlit;
mod walls;
mod world;

pub use agreement::{Agreement, Verdict};
pub use closed_form::Depth;
pub use error::ReconstructError;
pub use measured::{LeftOut, Measured, MeasuredSpot, NEAR_SPOT_SINE};
pub use mesh::{Surface, surface};
pub use optimise::cast_ray;
pub use picofarm_settings::{GridSettings as Settings, MOST_NODES, Shadows};
pub use planes::Plane;
pub use progress::{Phase, Progress, Unwatched};
pub use reconstruction::{Evidence, Reconstructed, Reconstruction, reconstruct};
pub use world::{Hit, World};

/// The version of the reconstruction, which is part of every task key. Change it whenever any bit
/// of a result may change.
pub const VERSION: &str = "reconstruct-9";
