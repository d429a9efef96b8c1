//! The values that all tiles of a render share.

use crate::{
    film::slots::Film,
    light::splat_source::SplatSource,
    paths::{
        path_reuse::effort::{Effort, PassContext},
        tracer::Tracer,
        two_bounce::Sampling,
    },
    tuning::Tuning,
};

/// Returns the factor from render units to metres: every path has one 1/d² left over.
pub(crate) fn unit(frame: &Frame) -> f64 {
    f64::from(frame.tracer.world.scale) * f64::from(frame.tracer.world.scale)
}

/// The shared inputs of all tiles.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frame<'a> {
    pub tracer: Tracer<'a>,
    /// The techniques that draw into the image outside the tiles.
    pub sources: &'a [&'a dyn SplatSource],
    pub film: &'a Film,
    pub sampling: &'a Sampling,
    pub effort: Effort,
    pub seed: u64,
    pub width: u32,
    pub height: u32,
    /// Whether the parts are requested.
    pub split: bool,
}

impl<'a> Frame<'a> {
    /// Returns what passes over tiles are made with.
    pub fn pass_context(&self) -> PassContext<'_> {
        PassContext {
            tracer: &self.tracer,
            film: self.film,
            effort: &self.effort,
        }
    }

    /// Returns the numbers that the techniques are tuned by.
    pub fn tuning(&self) -> &'a Tuning {
        self.tracer.tuning
    }
}
