//! Surfaces at the laser's wavelength.

use picofarm_scene::{Bsdf, Material};

use crate::{api::RenderError, bsdf::Surface};

/// What a texel does to a surface's reflectances.
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

/// Makes surfaces of materials.
pub(crate) struct Builder {
    wavelength_nm: Option<f64>,
    /// By surface, in their order; empty without a wavelength.
    pub texels: Vec<Option<Texels>>,
}

impl Builder {
    pub fn new(wavelength_nm: Option<f64>) -> Self {
        Self {
            wavelength_nm,
            texels: vec![],
        }
    }

    /// The next surface. Parts of a material of several are added to `several`.
    ///
    /// # Errors
    /// [`RenderError::Invalid`] where more materials have several parts than can be told apart.
    pub fn surface(
        &mut self,
        m: &Material,
        several: &mut Vec<Vec<Surface>>,
    ) -> Result<Surface, RenderError> {
        let (surface, texels) = match m.bsdf {
            Bsdf::Several { parts } => {
                let (mut all, mut of_all): (Vec<Surface>, Option<Texels>) = (vec![], None);
                for part in parts.list() {
                    let (surface, texels) = self.part(&m.part(part));
                    all.push(surface.scaled(part.weight));
                    of_all = match (of_all, texels) {
                        (Some(a), Some(b)) if a.most <= b.most => Some(a),
                        (_, texels) => texels,
                    };
                }
                let index = u16::try_from(several.len()).map_err(|_| RenderError::Invalid {
                    field: "objects".into(),
                    what: "have more than 65,536 materials of several parts; let meshes share them"
                        .into(),
                })?;
                let all = joined(all);
                let surface = Surface::several(m, &all, index);
                several.push(all);
                (surface, of_all)
            }
            _ => self.part(m),
        };
        if self.wavelength_nm.is_some() {
            self.texels.push(texels);
        }
        Ok(surface)
    }

    /// A material of one part, or a mix; and what a texel does to it.
    fn part(&self, m: &Material) -> (Surface, Option<Texels>) {
        let Some(nm) = self.wavelength_nm else {
            return (Surface::new(m), None);
        };
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
}

/// Parts of which few remain to choose from: the Lambertians are one, and beside each conductor whose vertices pixels share, in
/// proportion to what it reflects.
fn joined(parts: Vec<Surface>) -> Vec<Surface> {
    let (lambertians, conductors): (Vec<Surface>, Vec<Surface>) = parts
        .into_iter()
        .filter(|s| !s.is_black())
        .partition(Surface::diffuse);
    let (wide, mut all): (Vec<Surface>, Vec<Surface>) =
        conductors.into_iter().partition(Surface::is_shared);
    let Some(first) = lambertians.first() else {
        all.extend(wide);
        return all;
    };
    let mut base = 0.0;
    for s in &lambertians {
        base += s.lambertian();
    }
    if wide.is_empty() {
        all.push(first.scaled(base / first.lambertian()));
        return all;
    }
    let reflected: f32 = wide.iter().map(Surface::albedo).sum();
    for s in wide {
        all.push(s.mixed_with(base * s.albedo() / reflected));
    }
    all
}

/// The same kind of surface with other reflectances.
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
        other @ (Bsdf::Several { .. } | Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. }) => {
            other
        }
    }
}
