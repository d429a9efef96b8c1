//! The sources of light that is drawn into the image outside the tiles.

use crate::{
    film::{pass_fraction::PassFraction, splat::Splat},
    light::splat_source::{SplatPass, SplatSource},
    render::{frame::Frame, watch::RoundProgress},
};

/// The sources of a scene.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sources<'a>(&'a [&'a dyn SplatSource]);

impl<'a> Sources<'a> {
    /// Returns the sources of a scene, or `None` if it needs none.
    pub fn new(frame: &Frame<'a>) -> Option<Self> {
        (!frame.sources.is_empty()).then_some(Self(frame.sources))
    }

    /// Returns the contributions of a pass and the number of rays traced for it.
    pub fn pass(
        &self,
        frame: &Frame,
        (pass, watch): (u32, &RoundProgress),
        fraction: PassFraction,
    ) -> (Vec<Splat>, u64) {
        let pass = SplatPass {
            context: frame.tracer.surroundings(),
            film: frame.film,
            seed: frame.seed,
            width: frame.width,
            height: frame.height,
            pass,
            fraction,
            go_on: &|| watch.go_on(),
        };
        let mut all = vec![];
        let rays = self.0.iter().map(|s| s.splats(&pass, &mut all)).sum();
        (all, rays)
    }
}
