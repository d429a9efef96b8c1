//! A material ready for use, and its properties.

use std::f32::consts::PI;

use picofarm_scene::{Bsdf, Distribution, Material, Vec3};

/// The scattering models of the renderer. A new model is a variant here, its density, pdf and
/// sampling in `bsdf.rs`, and a variant of [`Bsdf`]. The rest of the renderer queries the
/// properties of a [`Surface`] and does not match on models.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// ρ/π.
    Lambertian,
    /// A rough conductor.
    Conductor,
    /// A weighted sum of a Lambertian and a rough conductor.
    Mixed,
}

/// Flags of a surface, one bit each.
const TWO_SIDED: u8 = 1;
const SPECULAR: u8 = 2;
const GGX: u8 = 4;

/// Roughness from which pixels share a conductor's vertices. From there on, its lobe is wide enough
/// to evaluate light sampled for one pixel at the others; below it, sharing costs more than it
/// gains (measured at 0.12 and 0.2).
const SHARED_ALPHA: f32 = 0.15;

/// A direction drawn by a surface's scattering.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ScatterSample {
    /// Unit direction.
    pub w: Vec3,
    /// f·cos over the density.
    pub weight: f32,
    /// Density per steradian.
    pub pdf: f32,
}

/// A material's scattering, ready for use. Sixteen bytes: every hit carries one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surface {
    pub kind: Kind,
    pub flags: u8,
    /// Lambertian: ρ/π. Conductor, also as a part of a mix: its reflectance times its share. 0 =
    /// black.
    pub strength: f32,
    /// Roughness of a conductor; of others 0.
    pub alpha: f32,
    /// Lambertian part ρ/π of a mix times its share; 0 for other surfaces.
    pub base: f32,
}

const _: () = assert!(size_of::<Surface>() == 16);

impl Surface {
    pub fn new(m: &Material) -> Self {
        let ggx = match m.bsdf {
            Bsdf::RoughConductor { distribution, .. } | Bsdf::Mixed { distribution, .. } => {
                distribution == Distribution::Ggx
            }
            Bsdf::Diffuse { .. } | Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => false,
        };
        let flag = |set: bool, flag: u8| if set { flag } else { 0 };
        let surface = |kind, strength, alpha, base| Self {
            kind,
            flags: flag(m.two_sided, TWO_SIDED)
                | flag(
                    m.is_specular() && !matches!(m.bsdf, Bsdf::Dielectric { .. }),
                    SPECULAR,
                )
                | flag(ggx && kind != Kind::Lambertian, GGX),
            strength,
            alpha,
            base,
        };
        match m.bsdf {
            Bsdf::Diffuse { reflectance } => surface(Kind::Lambertian, reflectance / PI, 0.0, 0.0),
            Bsdf::RoughConductor {
                alpha, reflectance, ..
            } => surface(Kind::Conductor, reflectance, alpha, 0.0),
            Bsdf::Mixed {
                reflectance,
                alpha,
                specular_reflectance,
                weight,
                ..
            } => {
                let strength = weight * specular_reflectance;
                let base = (1.0 - weight) * reflectance / PI;
                // A mix has two parts that scatter; with one such part the surface is pure.
                if base == 0.0 {
                    surface(Kind::Conductor, strength, alpha, 0.0)
                } else if strength == 0.0 {
                    surface(Kind::Lambertian, base, 0.0, 0.0)
                } else {
                    surface(Kind::Mixed, strength, alpha, base)
                }
            }
            // Thin glass is no surface (see `panes`), and bodies of glass do not scatter.
            Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => {
                surface(Kind::Lambertian, 0.0, 0.0, 0.0)
            }
        }
    }

    /// Returns the surface by which directions are drawn at a vertex that pixels share: a mix of
    /// albedo 1 in the proportions of this surface, at least half of it Lambertian.
    pub fn guide(self) -> Self {
        let base = self.base.max(0.5 * self.albedo() / PI);
        let all = 1.0 / (self.strength + base * PI);
        Self {
            kind: Kind::Mixed,
            strength: self.strength * all,
            base: base * all,
            ..self
        }
    }

    /// Returns the share of light that the surface scatters, before masking.
    #[inline]
    pub fn albedo(&self) -> f32 {
        match self.kind {
            Kind::Lambertian => self.strength * PI,
            _ => self.strength + self.base * PI,
        }
    }

    /// Scatters from both sides.
    #[inline(always)]
    pub fn two_sided(&self) -> bool {
        self.flags & TWO_SIDED != 0
    }

    /// Returns whether the surface counts as a mirror (specular mask).
    #[inline(always)]
    pub fn specular(&self) -> bool {
        self.flags & SPECULAR != 0
    }

    /// Returns the same surface without any scattering.
    pub fn black(self) -> Self {
        self.scaled(0.0)
    }

    /// Returns the same surface with its scattering multiplied by `factor`.
    #[inline(always)]
    pub fn scaled(self, factor: f32) -> Self {
        let scaled = Self {
            strength: self.strength * factor,
            base: self.base * factor,
            ..self
        };
        if scaled.base == 0.0 {
            scaled.gloss()
        } else {
            scaled
        }
    }

    /// Returns whether pixels may share its vertices: for a Lambertian, or a sufficiently rough
    /// conductor.
    #[inline(always)]
    pub fn is_shared(&self) -> bool {
        self.diffuse() || self.alpha >= SHARED_ALPHA
    }

    /// Returns a Lambertian of albedo 1 with the same sides.
    #[inline]
    pub fn white(self) -> Self {
        Self {
            kind: Kind::Lambertian,
            flags: self.flags & TWO_SIDED,
            strength: 1.0 / PI,
            alpha: 0.0,
            base: 0.0,
        }
    }

    /// Returns whether the surface scatters nothing.
    #[inline(always)]
    pub fn is_black(&self) -> bool {
        self.strength == 0.0
    }

    /// Returns whether the surface is Lambertian.
    #[inline(always)]
    pub fn diffuse(&self) -> bool {
        matches!(self.kind, Kind::Lambertian)
    }

    /// Returns whether the surface is a mix of two parts; [`Surface::lobe`] chooses one of them.
    #[inline(always)]
    pub fn is_mixed(&self) -> bool {
        matches!(self.kind, Kind::Mixed)
    }

    /// Returns whether a path must choose one part of this mix. If pixels share its vertices, both
    /// lobes are wide, and a vertex scatters by both.
    #[inline(always)]
    pub fn is_open(&self) -> bool {
        match self.kind {
            Kind::Mixed => !self.is_shared(),
            Kind::Lambertian | Kind::Conductor => false,
        }
    }

    /// Returns the BRDF of a Lambertian surface, ρ/π.
    #[inline(always)]
    pub fn lambertian(&self) -> f32 {
        self.strength
    }

    /// Returns the roughness α of its conductor, 0 without one.
    #[inline(always)]
    pub fn alpha(&self) -> f32 {
        self.alpha
    }

    /// Returns whether its conductor, if it has one, is GGX.
    #[inline(always)]
    pub fn ggx(&self) -> bool {
        self.flags & GGX != 0
    }

    /// Returns whether the surface has a conductor, alone or in a mix, smooth enough for a mirror.
    #[inline(always)]
    pub fn has_mirror(&self) -> bool {
        !self.diffuse() && !self.is_rough() && !self.is_black()
    }

    /// Returns whether the surface has a conductor too rough for a mirror.
    #[inline(always)]
    pub fn is_rough(&self) -> bool {
        self.alpha > Material::SPECULAR_ALPHA
    }

    /// Returns one part of a mix, chosen by `u` in [0, 1) in proportion to the parts' albedos and
    /// divided by the probability of that choice, with `specular` as for the part alone. A pure
    /// surface returns itself.
    #[inline]
    pub fn lobe(&self, u: f32) -> Surface {
        if !self.is_mixed() {
            return *self;
        }
        let total = self.strength + self.base * PI;
        if u * total < self.strength {
            let mirror = self.alpha <= Material::SPECULAR_ALPHA;
            return Self {
                kind: Kind::Conductor,
                flags: self.flags & !SPECULAR | if mirror { SPECULAR } else { 0 },
                strength: total,
                base: 0.0,
                ..*self
            };
        }
        Self {
            kind: Kind::Lambertian,
            flags: self.flags & TWO_SIDED,
            strength: total / PI,
            alpha: 0.0,
            base: 0.0,
        }
    }

    /// Returns the conductor of a mix, with its share. A pure surface returns itself.
    #[inline(always)]
    pub fn gloss(self) -> Self {
        match self.kind {
            Kind::Mixed => Self {
                kind: Kind::Conductor,
                base: 0.0,
                ..self
            },
            Kind::Lambertian | Kind::Conductor => self,
        }
    }

    /// Returns the probability that [`Surface::sample`] draws from the conductor of a mix.
    #[inline(always)]
    pub fn share(&self) -> f32 {
        self.strength / (self.strength + self.base * PI)
    }
}
