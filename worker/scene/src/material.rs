//! Materials: the scattering of a surface at the laser's wavelength, and its colour for a camera.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::{SpectrumPoint, Texture};

/// The microfacet normal distribution of a rough conductor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Distribution {
    /// Beckmann (Walter et al. 2007), with its rational G1.
    Beckmann,
    /// GGX, also called Trowbridge-Reitz (Walter et al. 2007), with Smith's exact G1.
    Ggx,
}

/// The scattering at the laser's wavelength. f is the BRDF in 1/sr.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Bsdf {
    /// Lambertian: f = reflectance/π.
    Diffuse {
        /// The albedo at the laser's wavelength, in [0, 1].
        reflectance: f32,
    },
    /// Rough conductor with Fresnel term 1 scaled by `reflectance`: f = reflectance · D(h) G1(i)
    /// G1(o) / (4 cos_i cos_o); separable G1, no multiple-scattering term.
    RoughConductor {
        /// The roughness α > 0 of the microfacet distribution (0.01 = near-mirror).
        alpha: f32,
        /// The microfacet distribution.
        distribution: Distribution,
        /// The scale in [0, 1]; 1 is lossless apart from masking.
        reflectance: f32,
    },
    /// A blend of a Lambertian and a rough conductor (Mitsuba's `blendbsdf` of `diffuse` and
    /// `roughconductor`): f = (1 − weight) · reflectance/π + weight · conductor.
    Mixed {
        /// The albedo of the Lambertian part, in [0, 1].
        reflectance: f32,
        /// The roughness α of the conductor.
        alpha: f32,
        /// The conductor's microfacet distribution.
        distribution: Distribution,
        /// The scale of the conductor, in [0, 1].
        specular_reflectance: f32,
        /// The share of the conductor, in [0, 1].
        weight: f32,
    },
    /// Thin glass: a pane. Light goes straight on through it, or is reflected as by a plane mirror.
    /// A pane lets through T = τ · ½ Σ (1 − r)/(1 + r) and reflects R = ½ Σ (r + τ² r (1 − r)/(1 +
    /// r)). The sums are over the two polarisations, r is Fresnel's reflectance of one face at the
    /// light's angle and τ the `transmittance`: unpolarised light, reflected to and fro between the
    /// faces any number of times. Reflections count as bounces, as at near-mirrors; passing through
    /// does not count. Thin glass is no surface of the ground truth, and no beam makes its spot on
    /// it. A beam goes on straight through, and makes a further spot where what is reflected of it
    /// ends.
    ThinDielectric {
        /// The index of refraction relative to air, in [1, 4]; 1 reflects nothing.
        ior: f32,
        /// The share of the unreflected light that a whole pane transmits: its tint at the laser's
        /// wavelength, in [0, 1].
        transmittance: f32,
        /// Whether the surface is one of the two faces of a pane with a thickness in the mesh. If
        /// so, each face transmits √T. The side of the normal reflects R, for the whole pane; the
        /// other side reflects nothing. If not, a surface is a whole pane, with R on both sides.
        face: bool,
    },
    /// The smooth surface of a body of glass or of a liquid: light is refracted (Snell) and
    /// reflected (Fresnel, unpolarised, without a tint). The body is behind the surface's normal,
    /// and air or vacuum is in front of it. The facets of a material must be closed and face
    /// outwards ([`Scene::validate`](crate::Scene::validate)); those of cavities face inwards.
    /// Bodies must not touch or contain one another. Reflections count as bounces, refraction does
    /// not. A body of glass is a surface of the ground truth, in the specular mask. A beam
    /// continues by refraction, and its reflected part makes a further spot at its end.
    Dielectric {
        /// The index of refraction of the body relative to its surroundings, in [1, 4].
        ior: f32,
        /// The share of the refracted light that each crossing of the surface transmits: its tint
        /// at the laser's wavelength, in [0, 1].
        transmittance: f32,
    },
}

impl Bsdf {
    /// Returns the kind's name in scene files.
    pub fn name(&self) -> &'static str {
        match self {
            Bsdf::Diffuse { .. } => "diffuse",
            Bsdf::RoughConductor { .. } => "rough_conductor",
            Bsdf::Mixed { .. } => "mixed",
            Bsdf::ThinDielectric { .. } => "thin_dielectric",
            Bsdf::Dielectric { .. } => "dielectric",
        }
    }

    /// Returns the surface with every reflectance multiplied by `factor`, e.g. by a texel.
    pub fn scaled(self, factor: f32) -> Self {
        match self {
            Bsdf::Diffuse { reflectance } => Bsdf::Diffuse {
                reflectance: reflectance * factor,
            },
            Bsdf::RoughConductor {
                alpha,
                distribution,
                reflectance,
            } => Bsdf::RoughConductor {
                alpha,
                distribution,
                reflectance: reflectance * factor,
            },
            Bsdf::Mixed {
                reflectance,
                alpha,
                distribution,
                specular_reflectance,
                weight,
            } => Bsdf::Mixed {
                reflectance: reflectance * factor,
                alpha,
                distribution,
                specular_reflectance: specular_reflectance * factor,
                weight,
            },
            glass @ (Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. }) => glass,
        }
    }
}

/// A named surface material.
///
/// With a texture, the albedo at a point is `rgb` times the texel's linear RGB, channel by channel.
/// Every reflectance of `bsdf` is multiplied by the **mean of the texel's three channels**: a
/// texture's value at the laser's wavelength is unknown, so a grey texture has the same effect on
/// the laser as on the image.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// The name, for people.
    pub name: String,
    /// The scattering at the laser's wavelength.
    pub bsdf: Bsdf,
    /// The linear RGB albedo for the companion image, each in [0, 1]. For glass, the transmission
    /// of a pane, or of each crossing of the surface of a body.
    pub rgb: [f32; 3],
    /// A texture that scales the albedo from point to point. It requires a mesh with texture
    /// coordinates.
    pub texture: Option<Arc<Texture>>,
    /// Whether both sides of the facet scatter; if not, the facet is black from behind.
    pub two_sided: bool,
    /// The reflectance by wavelength, ascending; empty if it was not measured. Only renders with a
    /// wavelength use it ([`Material::at`]).
    pub spectrum: Vec<SpectrumPoint>,
}

impl Material {
    /// Returns a two-sided Lambertian with the mean of its linear RGB albedo as its laser
    /// reflectance.
    pub fn diffuse(name: impl Into<String>, rgb: [f32; 3]) -> Self {
        let reflectance = (rgb[0] + rgb[1] + rgb[2]) / 3.0;
        Self {
            name: name.into(),
            bsdf: Bsdf::Diffuse { reflectance },
            rgb,
            texture: None,
            two_sided: true,
            spectrum: vec![],
        }
    }

    /// Returns a two-sided Beckmann near-mirror of roughness `alpha`.
    pub fn mirror(name: impl Into<String>, alpha: f32) -> Self {
        Self {
            name: name.into(),
            bsdf: Bsdf::RoughConductor {
                alpha,
                distribution: Distribution::Beckmann,
                reflectance: 1.0,
            },
            rgb: [1.0; 3],
            texture: None,
            two_sided: true,
            spectrum: vec![],
        }
    }

    /// Returns a clear pane of window glass, index of refraction 1.5: 92 % of the light passes at a
    /// right angle.
    pub fn glass(name: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            bsdf: Bsdf::ThinDielectric {
                ior: Self::IOR,
                transmittance: 1.0,
                face: false,
            },
            rgb: [1.0; 3],
            texture: None,
            two_sided: true,
            spectrum: vec![],
        }
    }

    /// Returns a body of clear glass, index of refraction 1.5.
    pub fn solid_glass(name: impl Into<String>) -> Self {
        Self {
            bsdf: Bsdf::Dielectric {
                ior: Self::IOR,
                transmittance: 1.0,
            },
            ..Self::glass(name)
        }
    }

    /// Returns whether the material is thin glass, which is not a surface but transmits light.
    pub fn is_glass(&self) -> bool {
        matches!(self.bsdf, Bsdf::ThinDielectric { .. })
    }

    /// Returns whether the material is glass of either kind, which has neither texture nor
    /// spectrum.
    pub(crate) fn transmits(&self) -> bool {
        matches!(
            self.bsdf,
            Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. }
        )
    }

    /// Returns the factors of the albedo at a point of texture space: those of `rgb`, and that of
    /// the reflectances (the mean of the three). Without a texture, all are 1.
    pub fn factors(&self, uv: [f32; 2]) -> ([f32; 3], f32) {
        match &self.texture {
            None => ([1.0; 3], 1.0),
            Some(texture) => {
                let [r, g, b] = texture.at(uv);
                ([r, g, b], (r + g + b) / 3.0)
            }
        }
    }

    /// True for surfaces in the specular mask, at which beams are not spots but fold: bodies of
    /// glass, and rough conductors with α ≤ [`Material::SPECULAR_ALPHA`], also as half or more of a
    /// mix. A mix below that scatters enough by its Lambertian part to make a spot.
    ///
    /// # Examples
    /// ```
    /// use picofarm_scene::Material;
    ///
    /// assert!(Material::mirror("mirror", 0.01).is_specular());
    /// assert!(!Material::diffuse("wall", [0.8; 3]).is_specular());
    /// ```
    pub fn is_specular(&self) -> bool {
        match self.bsdf {
            Bsdf::Diffuse { .. } | Bsdf::ThinDielectric { .. } => false,
            Bsdf::Dielectric { .. } => true,
            Bsdf::RoughConductor { alpha, .. } => alpha <= Self::SPECULAR_ALPHA,
            Bsdf::Mixed { alpha, weight, .. } => weight >= 0.5 && alpha <= Self::SPECULAR_ALPHA,
        }
    }

    /// The roughness up to which a conductor counts as a mirror for masks and for aiming beams.
    pub const SPECULAR_ALPHA: f32 = 0.1;

    /// Returns thin glass for a material described only by its opacity, or `None` if it covers more
    /// than half of the background. If the file has no index of refraction, that of window glass is
    /// used.
    pub(crate) fn by_opacity(opacity: f32, ior: Option<f32>, face: bool) -> Option<Bsdf> {
        let transmittance = (1.0 - opacity).clamp(0.0, 1.0);
        let ior = ior.filter(|ior| *ior > 1.0).unwrap_or(Self::IOR);
        (transmittance >= Self::LEAST_GLASS).then_some(Bsdf::ThinDielectric {
            ior: ior.min(Self::MAX_IOR),
            transmittance,
            face,
        })
    }

    /// The least share of transmitted light for a file's material to count as glass.
    pub(crate) const LEAST_GLASS: f32 = 0.5;
    /// The index of refraction of window glass.
    pub(crate) const IOR: f32 = 1.5;

    /// The largest index of refraction of glass.
    pub const MAX_IOR: f32 = 4.0;

    /// The smallest roughness of a conductor.
    pub const MIN_ALPHA: f32 = 1e-3;

    /// Checks physical limits; the message names the allowed values.
    pub(crate) fn check(&self) -> Result<(), String> {
        let unit = |name: &str, v: f32| {
            if (0.0..=1.0).contains(&v) {
                Ok(())
            } else {
                Err(format!("{name} = {v} lies outside [0, 1]"))
            }
        };
        let rough = |alpha: f32| {
            if (Self::MIN_ALPHA..=1.0).contains(&alpha) {
                Ok(())
            } else {
                Err(format!("alpha = {alpha} lies outside [0.001, 1]"))
            }
        };
        match self.bsdf {
            Bsdf::Diffuse { reflectance } => unit("reflectance", reflectance)?,
            Bsdf::RoughConductor {
                alpha, reflectance, ..
            } => {
                rough(alpha)?;
                unit("reflectance", reflectance)?;
            }
            Bsdf::Mixed {
                reflectance,
                alpha,
                specular_reflectance,
                weight,
                ..
            } => {
                rough(alpha)?;
                unit("reflectance", reflectance)?;
                unit("specular_reflectance", specular_reflectance)?;
                unit("weight", weight)?;
            }
            Bsdf::ThinDielectric {
                ior, transmittance, ..
            }
            | Bsdf::Dielectric { ior, transmittance } => {
                if !(1.0..=Self::MAX_IOR).contains(&ior) {
                    return Err(format!(
                        "ior = {ior} lies outside [1, 4]; state the index of glass over that of air"
                    ));
                }
                unit("transmittance", transmittance)?;
                if self.texture.is_some() {
                    return Err("glass takes no texture; remove it".into());
                }
            }
        }
        self.check_spectrum()?;
        self.rgb.iter().try_for_each(|&v| unit("rgb", v))
    }
}
