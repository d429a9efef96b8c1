//! A surface point that a ray found.

use picofarm_scene::Vec3;

use crate::{numeric::rng::Rng, scene::surface::Surface};

/// A point on a surface, seen from somewhere.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hit {
    /// Position, render units.
    pub p: Vec3,
    /// Unit geometric normal on the side the ray came from.
    pub n: Vec3,
    /// Triangle index.
    pub triangle: u32,
    /// Scattering; black if the ray hit the back of a one-sided surface.
    pub surface: Surface,
    /// Fraction of light that glass transmits along the ray that found this hit; 1 without glass.
    pub through: f32,
}

impl Hit {
    /// Chooses one part of a mix if one of them is too narrow for pixels to share its vertices, so
    /// that each path uses either a near-mirror's lobe or another. A mix of wide lobes stays, and
    /// its vertices scatter by both.
    #[inline(always)]
    pub fn choose_lobe(&mut self, rng: &mut Rng) {
        if self.surface.is_open() {
            self.settle(rng);
        }
    }

    #[cold]
    fn settle(&mut self, rng: &mut Rng) {
        self.surface = self.surface.lobe(rng.uniform());
    }
}
