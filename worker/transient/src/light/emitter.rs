//! A spot as a light source that scatters the laser's light into the scene.

use picofarm_scene::{Spot, Vec3};

use crate::{
    light::clearance,
    scene::{bvh::tree::Stack, intersection::lift, surface::Surface, world::World},
};

/// A spot as a point source: unit power arrives along the beam and is scattered by the BRDF.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Emitter {
    /// Index of the beam.
    pub beam: usize,
    /// Position, render units.
    pub p: Vec3,
    /// Normal on the lit side.
    pub n: Vec3,
    /// Unit direction back along the beam.
    pub back: Vec3,
    /// Optical path from the laser, metres.
    pub path_m: f64,
    /// Scattering on the lit side (black behind a one-sided surface), times the source's share of
    /// the beam after transmission by glass.
    pub surface: Surface,
    /// Whether glass reflected this light off the beam, so that the source is not the beam's own
    /// spot.
    pub aside: bool,
}

impl Emitter {
    pub fn new(
        world: &World,
        stack: &mut Stack,
        (beam, share): (usize, f32),
        spot: &Spot,
        material: u32,
    ) -> Self {
        let surface = world.surfaces[material as usize];
        let p = world.inward(spot.point);
        let p = clearance::clear(world, stack, p, spot.normal, -spot.arriving);
        // The spot does not store whether its side is the facet's front, so look at the facet
        // beneath it.
        let beneath = world.closest(stack, lift(p, spot.normal), -spot.normal);
        // The facet also provides the texture there.
        let beneath = beneath.filter(|h| (h.p - p).length() < 1e-3);
        let surface = match beneath {
            Some(h) if !surface.two_sided() && h.surface.is_black() => surface.black(),
            Some(h) if material == world.surface[h.triangle as usize] => h.surface,
            _ => surface,
        };
        let surface = match share == 1.0 {
            true => surface,
            false => surface.scaled(share),
        };
        Self {
            beam,
            p,
            n: spot.normal,
            back: -spot.arriving,
            path_m: f64::from(spot.path_m),
            surface,
            aside: false,
        }
    }

    /// Returns the radiant intensity per unit power towards the unit direction `w`: f·cos.
    #[inline]
    pub fn intensity(&self, w: Vec3) -> f32 {
        self.surface.scatter(self.n, self.back, w)
    }
}
