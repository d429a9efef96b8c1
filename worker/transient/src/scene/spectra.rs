//! Surfaces at the laser's wavelength.

use picofarm_scene::{Bsdf, Material};

use crate::scene::surface::Surface;

/// The effect of a texel on a surface's reflectances.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Texels {
    /// Shares of the texel's red, green and blue.
    shares: [f32; 3],
    /// Most that it may multiply by: no surface gives more than it gets.
    most: f32,
}

impl Texels {
    /// The factor of a texel.
    #[inline]
    pub fn factor(&self, texel: [f32; 3]) -> f32 {
        let shares = &self.shares;
        let sum = shares[0] * texel[0] + shares[1] * texel[1] + shares[2] * texel[2];
        sum.min(self.most)
    }
}

/// A material's surface at a wavelength, nanometres, and what a texel does to it.
pub(crate) fn at(m: &Material, nm: f64) -> (Surface, Option<Texels>) {
    let at = m.at(nm as f32);
    let texels = m.texture.is_some().then(|| Texels {
        shares: at.texel,
        most: 1.0 / at.lambertian.max(at.conductor).max(f32::MIN_POSITIVE),
    });
    let there = Material {
        bsdf: with(m.bsdf, (at.lambertian, at.conductor)),
        ..m.clone()
    };
    (Surface::new(&there), texels)
}

/// Returns the same kind of surface with other reflectances.
fn with(bsdf: Bsdf, (lambertian, conductor): (f32, f32)) -> Bsdf {
    match bsdf {
        Bsdf::Diffuse { .. } => Bsdf::Diffuse {
            reflectance: lambertian,
        },
        Bsdf::RoughConductor {
            alpha,
            distribution,
            ..
        } => Bsdf::RoughConductor {
            alpha,
            distribution,
            reflectance: conductor,
        },
        Bsdf::Mixed {
            alpha,
            distribution,
            weight,
            ..
        } => Bsdf::Mixed {
            reflectance: lambertian,
            alpha,
            distribution,
            specular_reflectance: conductor,
            weight,
        },
        glass @ (Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. }) => glass,
    }
}
