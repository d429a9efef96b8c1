//! A contribution of a camera path.

use crate::film::{slots::Film, splat::Splat, technique::Technique};

/// A contribution of a camera path.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Found {
    /// Radiance.
    pub value: f32,
    /// Optical path, metres.
    pub path_m: f64,
    /// Emitter index.
    pub spot: usize,
    pub bounces: u32,
    pub technique: Technique,
}

/// Adds what was found.
pub(crate) fn add(film: &Film, (pixel, found): (u32, Found), out: &mut Vec<Splat>) {
    out.push(Splat {
        pixel,
        slot: film.slot(found.path_m) as u32,
        spot: found.spot as u16,
        value: found.value,
        bounces: found.bounces,
        technique: found.technique,
    });
}
