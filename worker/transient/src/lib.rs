//! The transient renderer: a scene in, time-resolved histograms and ground truth out. Knows nothing of
//! jobs, stores or files.

mod api;
mod bsdf;
mod bvh;
mod caustic;
mod ellipsoid;
mod emitter;
mod film;
mod lobe;
mod one;
mod photo;
mod plan;
mod pool;
mod render;
mod rng;
pub mod sensor;
mod share;
mod truth;
mod two;
mod walk;
mod world;

pub use api::*;
pub use bvh::{Bvh, Kernel, Stack};
pub use emitter::trace_spots;
pub use render::{Forecast, Part, PartOf, join_parts, plan, render, render_part};
