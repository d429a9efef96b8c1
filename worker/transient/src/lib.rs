//! The transient renderer: turns a scene into time-resolved histograms and ground truth. It does
//! not depend on jobs, stores or files.

mod api;
mod film;
mod light;
mod numeric;
mod paths;
mod render;
mod scene;
mod truth;

pub use api::*;
pub use light::beam::trace_spots;
pub use render::{
    driver::{plan, render, render_within},
    forecast::Forecast,
    part::{Part, PartOf, join_parts, render_part},
    variance::{ClassVariance, variance},
};
pub use scene::bvh::{
    nodes::Kernel,
    tree::{Bvh, Stack},
};
