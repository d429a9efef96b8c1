//! The transient renderer: turns a scene into time-resolved histograms and ground truth. It does
//! not depend on jobs, stores or files.

mod api;
mod beam;
mod beam_width;
mod bsdf;
mod bvh;
mod by_glass;
mod caustic;
mod contact;
mod ellipsoid;
mod emitter;
mod extent;
mod film;
mod fresnel;
mod glass;
mod lanes;
mod light_vertices;
mod lobes;
mod mirror_images;
mod one_bounce;
mod path_reuse;
mod photo;
mod plan;
mod reflectors;
mod render;
mod rng;
mod segments;
mod sink;
mod spectra;
mod targets;
mod truth;
mod turns;
mod two_bounce;
mod vertex;
mod walk;
mod world;

pub use api::*;
pub use beam::trace_spots;
pub use bvh::{Bvh, Kernel, Stack};
pub use render::{
    ClassVariance, Forecast, Part, PartOf, join_parts, plan, render, render_part, render_within,
    variance,
};
