//! One flash taken apart by physics: from a multiplexed histogram, in which the light of all spots
//! is added up, to the depth of each pixel and to which spots light it. Every two-bounce
//! time follows from geometry. Nothing is learnt but the judgement of shadows, which may be left to
//! rules.
//!
//! `docs/one-flash-method.md` explains the steps. This crate knows nothing of jobs or
//! files.

mod capture;
mod demultiplex;
mod error;
mod evidence;
mod fill;
mod forest;
mod geometry;
mod learned;
pub mod learning;
mod light;
mod matching;
mod mirrors;
mod peaks;
mod planes;
mod pulse;
mod residual;
mod scale;
pub mod score;
mod separate;
mod settings;
mod shadows;
mod sweep;
mod unmix;

pub use capture::{Capture, Place, Spot};
pub use demultiplex::{Demultiplexed, demultiplex, shadows_at, with_evidence};
pub use error::DemultiplexError;
pub use evidence::Evidence;
pub use residual::{Residual, residual};
pub use scale::room_factor;
pub use score::{DepthScore, MaskScore, Truth};
pub use separate::{SEPARATE_VERSION, Separate, separate};
pub use settings::{Settings, Shading};
pub use shadows::Ground;

/// Version of the method: changes whenever any bit of a result may change.
pub const VERSION: &str = "demultiplex-6";
