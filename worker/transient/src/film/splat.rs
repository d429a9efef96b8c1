//! A contribution to one pixel of the image.

use crate::film::technique::Technique;

/// One light path's contribution to the image.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Splat {
    /// Row-major pixel.
    pub pixel: u32,
    /// Slot of the film.
    pub slot: u32,
    /// Emitter index.
    pub spot: u16,
    /// Radiance averaged over the pixel, render units.
    pub value: f32,
    /// Bounces of the whole path.
    pub bounces: u32,
    pub technique: Technique,
}
