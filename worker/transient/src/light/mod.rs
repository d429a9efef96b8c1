//! The laser: its beams and spots as sources, and the light paths that start at them.

pub(crate) mod beam;
pub(crate) mod beam_width;
pub(crate) mod caustics;
pub(crate) mod clearance;
pub(crate) mod columns;
pub(crate) mod contacts;
pub(crate) mod direct_light;
pub(crate) mod emitter;
pub(crate) mod emitters;
pub(crate) mod light_context;
pub(crate) mod light_vertices;
pub(crate) mod mirror_images;
pub(crate) mod reflectors;
pub(crate) mod splat;
pub(crate) mod targets;
