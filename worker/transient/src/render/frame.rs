//! What all tiles of a render share.

use crate::{
    film::slots::Film,
    paths::{
        glass::technique::ByGlass, path_reuse::effort::Effort, tracer::Walk, two_bounce::Sampling,
    },
};

/// Returns the factor from render units to metres: every path has one 1/d² left over.
pub(crate) fn unit(frame: &Frame) -> f64 {
    f64::from(frame.walk.world.scale) * f64::from(frame.walk.world.scale)
}

/// The shared inputs of all tiles.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frame<'a> {
    pub walk: Walk<'a>,
    /// Glass that turns light, if there is any.
    pub glass: Option<&'a ByGlass>,
    pub film: &'a Film,
    pub sampling: &'a Sampling,
    pub effort: Effort,
    pub seed: u64,
    pub width: u32,
    pub height: u32,
    /// Whether the parts are requested.
    pub split: bool,
}
