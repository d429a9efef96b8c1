//! Materials: how a surface scatters at the laser's wavelength, and what colour a camera sees.

use serde::{Deserialize, Serialize};

/// Microfacet normal distribution of a rough conductor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Distribution {
    /// Beckmann (Walter et al. 2007), with its rational G1.
    Beckmann,
}

/// Scattering at the laser's wavelength. f is the BRDF in 1/sr.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Bsdf {
    /// Lambertian: f = reflectance/π.
    Diffuse {
        /// Albedo at the laser's wavelength, in [0, 1].
        reflectance: f32,
    },
    /// Rough conductor with Fresnel term 1 scaled by `reflectance`:
    /// f = reflectance · D(h) G1(i) G1(o) / (4 cos_i cos_o); separable G1, no multiple-scattering term.
    RoughConductor {
        /// Roughness α > 0 of the microfacet distribution (0.01 = near-mirror).
        alpha: f32,
        /// The microfacet distribution.
        distribution: Distribution,
        /// Scale in [0, 1]; 1 is lossless apart from masking.
        reflectance: f32,
    },
}

/// A named surface material.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Material {
    /// Name, for people.
    pub name: String,
    /// Scattering at the laser's wavelength.
    pub bsdf: Bsdf,
    /// Linear RGB albedo for the companion image, each in [0, 1].
    pub rgb: [f32; 3],
    /// Scatters on both sides of the facet; otherwise black from behind.
    pub two_sided: bool,
}

impl Material {
    /// A two-sided Lambertian whose laser reflectance is the mean of its linear RGB albedo.
    pub fn diffuse(name: impl Into<String>, rgb: [f32; 3]) -> Self {
        let reflectance = (rgb[0] + rgb[1] + rgb[2]) / 3.0;
        Self {
            name: name.into(),
            bsdf: Bsdf::Diffuse { reflectance },
            rgb,
            two_sided: true,
        }
    }

    /// A two-sided Beckmann near-mirror of roughness `alpha`.
    pub fn mirror(name: impl Into<String>, alpha: f32) -> Self {
        Self {
            name: name.into(),
            bsdf: Bsdf::RoughConductor {
                alpha,
                distribution: Distribution::Beckmann,
                reflectance: 1.0,
            },
            rgb: [1.0; 3],
            two_sided: true,
        }
    }

    /// True for surfaces in the specular mask: rough conductors with α ≤ [`Material::SPECULAR_ALPHA`].
    pub fn is_specular(&self) -> bool {
        matches!(self.bsdf, Bsdf::RoughConductor { alpha, .. } if alpha <= Self::SPECULAR_ALPHA)
    }

    /// Roughness up to which a conductor counts as a mirror for masks and for aiming beams.
    pub const SPECULAR_ALPHA: f32 = 0.1;

    /// Physical limits; the message says what was expected.
    pub(crate) fn check(&self) -> Result<(), String> {
        let unit = |name: &str, v: f32| {
            if (0.0..=1.0).contains(&v) {
                Ok(())
            } else {
                Err(format!("{name} = {v} lies outside [0, 1]"))
            }
        };
        match self.bsdf {
            Bsdf::Diffuse { reflectance } => unit("reflectance", reflectance)?,
            Bsdf::RoughConductor {
                alpha, reflectance, ..
            } => {
                if !(1e-3..=1.0).contains(&alpha) {
                    return Err(format!("alpha = {alpha} lies outside [0.001, 1]"));
                }
                unit("reflectance", reflectance)?;
            }
        }
        self.rgb.iter().try_for_each(|&v| unit("rgb", v))
    }
}
