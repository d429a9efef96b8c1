//! A vertex that the gather points of a tile share.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::scene::{hit::Hit, surface::Surface};

/// A vertex that all gather points of a tile share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shared {
    pub hit: Hit,
    /// The number of candidates that it represents.
    pub counts: f32,
    /// The expected number of such candidates per area, from the spots' side and in a narrow gate's
    /// shells.
    pub light: f32,
    /// The range of its arrivals.
    pub first: usize,
    pub end: usize,
    /// The scattering of a surface other than Lambertian. Its arrivals are those of a white
    /// Lambertian surface at the same place.
    pub rough: Option<Surface>,
}

/// Guides the drawing of light at a rough vertex: by its scattering towards one of the gather
/// points, at least half of it as a Lambertian surface scatters, so that no direction is rare. The
/// contributions are carried as for a white Lambertian surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Guide {
    pub surface: Surface,
    pub n: Vec3,
    /// Unit direction to the gather point.
    pub to: Vec3,
}

impl Guide {
    /// Returns the ratio of a white Lambertian surface's light to the guide's, from direction `w`.
    #[inline]
    pub fn share(&self, w: Vec3) -> f32 {
        let guided = self.surface.scatter(self.n, self.to, w);
        if guided > 0.0 {
            self.n.dot(w) / (PI * guided)
        } else {
            0.0
        }
    }
}

impl Shared {
    /// Returns a shared vertex, or `None` if the hit cannot be shared.
    pub fn new(mut hit: Hit) -> Option<Self> {
        if !hit.surface.is_shared() || hit.surface.is_black() {
            return None;
        }
        let rough = (!hit.surface.diffuse()).then_some(hit.surface);
        if rough.is_some() {
            hit.surface = hit.surface.white();
        }
        Some(Self {
            hit,
            counts: 1.0,
            light: 0.0,
            first: 0,
            end: 0,
            rough,
        })
    }
}
