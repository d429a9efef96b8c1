//! Several wavelengths in one pass.
//!
//! The path of light does not depend on its wavelength; only its attenuation does. So paths are
//! drawn once, by the greatest reflectance that each lobe has among the wavelengths, and carry
//! *ratios*: for each wavelength the product over the path's vertices of the reflectance there over
//! that greatest one. A ratio is never above 1, so that no wavelength has rarer and brighter paths
//! than the brightest wavelength. A contribution of value v counts v times its ratio in each
//! wavelength's histogram.
//!
//! The first wavelength is the main one, and the errors are stated for it. With one wavelength or
//! none all ratios are 1, and nothing is multiplied by them.

use std::collections::HashMap;

use picofarm_scene::{AtWavelength, Bsdf, Material, Vec3};
use picofarm_settings::MAX_WAVELENGTHS;

use crate::{api::RenderError, bsdf::Surface};

/// Ratios by wavelength; those beyond the render's wavelengths are 1.
pub(crate) type Ratios = [f32; MAX_WAVELENGTHS];

/// Equal ratios for all wavelengths.
pub(crate) const ONES: Ratios = [1.0; MAX_WAVELENGTHS];

/// Light of all wavelengths: `value` times the ratio of each.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Light {
    pub value: f32,
    pub ratios: Ratios,
}

/// Returns the ratios of a path of two parts.
#[inline(always)]
pub(crate) fn times(a: Ratios, b: Ratios) -> Ratios {
    std::array::from_fn(|k| a[k] * b[k])
}

/// Returns the ratios of light with the given amounts from the Lambertian part and the conductor of
/// a mix.
#[inline(always)]
pub(crate) fn mix((lambertian, conductor): (f32, f32), of: &[Ratios; 2]) -> Ratios {
    let whole = lambertian + conductor;
    if whole <= 0.0 {
        return ONES;
    }
    std::array::from_fn(|k| (lambertian * of[0][k] + conductor * of[1][k]) / whole)
}

/// The ratio factors of the surfaces.
#[derive(Debug)]
pub(crate) struct Spectra {
    /// Ratios by [`Surface::spectrum_row`]; the first row is all ones.
    rows: Vec<Ratios>,
    /// Texel factors by surface index; `None` without a texture.
    texels: Vec<Option<Texels>>,
    /// The number of wavelengths.
    count: usize,
}

/// The effect of a texel on a surface's reflectances.
#[derive(Debug, Clone, Copy)]
struct Texels {
    /// Shares of the texel's red, green and blue, by wavelength.
    shares: [[f32; 3]; MAX_WAVELENGTHS],
    /// The largest allowed factor: no surface reflects more than it receives.
    most: f32,
}

impl Texels {
    /// Returns the factors by wavelength, and the greatest of them.
    fn factors(&self, texel: [f32; 3], count: usize) -> (Ratios, f32) {
        let mut factors = ONES;
        let mut greatest = 0.0f32;
        for (factor, shares) in factors.iter_mut().zip(&self.shares).take(count) {
            let sum = shares[0] * texel[0] + shares[1] * texel[1] + shares[2] * texel[2];
            *factor = sum.min(self.most);
            greatest = greatest.max(*factor);
        }
        (factors, greatest)
    }
}

/// Collects the contents of a [`Spectra`] while surfaces are created.
pub(crate) struct Builder<'a> {
    wavelengths_nm: &'a [f64],
    rows: Vec<Ratios>,
    known: HashMap<[u32; 2 * MAX_WAVELENGTHS], u16>,
    texels: Vec<Option<Texels>>,
}

impl<'a> Builder<'a> {
    pub fn new(wavelengths_nm: &'a [f64]) -> Self {
        Self {
            wavelengths_nm,
            rows: vec![ONES],
            known: HashMap::new(),
            texels: vec![],
        }
    }

    /// Adds the next surface. If a material has several parts, they are added to `several`.
    ///
    /// # Errors
    /// Returns [`RenderError::Invalid`] if materials have more spectra, or more materials have
    /// several parts, than indices can represent.
    pub fn surface(
        &mut self,
        m: &Material,
        several: &mut Vec<Vec<Surface>>,
    ) -> Result<Surface, RenderError> {
        let Bsdf::Several { parts } = m.bsdf else {
            let (surface, texels) = self.part(m)?;
            self.texels.push(texels);
            return Ok(surface);
        };
        let (mut all, mut of_all): (Vec<Surface>, Option<Texels>) = (vec![], None);
        for part in parts.list() {
            let (surface, texels) = self.part(&m.part(part))?;
            all.push(surface.scaled(part.weight));
            of_all = match (of_all, texels) {
                (Some(a), Some(b)) if a.most <= b.most => Some(a),
                (_, texels) => texels,
            };
        }
        self.texels.push(of_all);
        let index = u16::try_from(several.len()).map_err(|_| RenderError::Invalid {
            field: "objects".into(),
            what: "have more than 65,536 materials of several parts; let meshes share them".into(),
        })?;
        let all = self.joined(all)?;
        let surface = Surface::several(m, &all, index);
        several.push(all);
        Ok(surface)
    }

    /// Joins parts so that few remain to choose from. The Lambertian parts become one, combined
    /// with each conductor wide enough for shared vertices, in proportion to its
    /// reflectance.
    fn joined(&mut self, parts: Vec<Surface>) -> Result<Vec<Surface>, RenderError> {
        let (lambertians, conductors): (Vec<Surface>, Vec<Surface>) = parts
            .into_iter()
            .filter(|s| !s.is_black())
            .partition(Surface::diffuse);
        let (wide, mut all): (Vec<Surface>, Vec<Surface>) =
            conductors.into_iter().partition(Surface::is_shared);
        let Some(first) = lambertians.first() else {
            all.extend(wide);
            return Ok(all);
        };
        let mut sums = [0.0; MAX_WAVELENGTHS];
        for s in &lambertians {
            let ratios = &self.rows[usize::from(s.spectrum_row())];
            for (sum, ratio) in sums.iter_mut().zip(ratios) {
                *sum += s.lambertian() * ratio;
            }
        }
        let count = self.wavelengths_nm.len().max(1);
        let (base, ratios) = greatest(sums.into_iter().take(count));
        if wide.is_empty() {
            let lambertian = first.scaled(base / first.lambertian());
            all.push(lambertian.with_spectrum(self.row(ratios, ONES)?));
            return Ok(all);
        }
        let reflected: f32 = wide.iter().map(Surface::albedo).sum();
        for s in wide {
            let conductor = self.rows[usize::from(s.spectrum_row())];
            let row = self.row(ratios, conductor)?;
            all.push(s.mixed_with(base * s.albedo() / reflected, row));
        }
        Ok(all)
    }

    /// Returns a material of one part, or a mix, and its texel factors.
    fn part(&mut self, m: &Material) -> Result<(Surface, Option<Texels>), RenderError> {
        if self.wavelengths_nm.is_empty() {
            return Ok((Surface::new(m), None));
        }
        let at: Vec<AtWavelength> = self
            .wavelengths_nm
            .iter()
            .map(|&nm| m.at(nm as f32))
            .collect();
        let (lambertian, first) = greatest(at.iter().map(|a| a.lambertian));
        let (conductor, second) = greatest(at.iter().map(|a| a.conductor));
        let texels = m.texture.is_some().then(|| {
            let mut shares = [[0.0; 3]; MAX_WAVELENGTHS];
            for (to, from) in shares.iter_mut().zip(&at) {
                *to = from.texel;
            }
            let most = 1.0 / lambertian.max(conductor).max(f32::MIN_POSITIVE);
            Texels { shares, most }
        });
        let brightest = Material {
            bsdf: with(m.bsdf, (lambertian, conductor)),
            ..m.clone()
        };
        let row = self.row(first, second)?;
        Ok((Surface::new(&brightest).with_spectrum(row), texels))
    }

    /// Returns the row of the ratios of two lobes. If no wavelengths are requested, it is the row
    /// of ones.
    fn row(&mut self, lambertian: Ratios, conductor: Ratios) -> Result<u16, RenderError> {
        if self.wavelengths_nm.is_empty() {
            return Ok(0);
        }
        let mut bits = [0u32; 2 * MAX_WAVELENGTHS];
        for (bits, x) in bits.iter_mut().zip(lambertian.iter().chain(&conductor)) {
            *bits = x.to_bits();
        }
        if let Some(&row) = self.known.get(&bits) {
            return Ok(row);
        }
        let row = u16::try_from(self.rows.len() + 1).map_err(|_| RenderError::Invalid {
            field: "wavelengths_nm".into(),
            what: "the scene's materials have more than 32,767 different spectra; make some of them alike".into(),
        })? - 1;
        self.rows.extend([lambertian, conductor]);
        self.known.insert(bits, row);
        Ok(row)
    }

    /// Returns the collected spectra, or `None` if no wavelengths are requested.
    pub fn done(self) -> Option<Spectra> {
        let count = self.wavelengths_nm.len();
        (count > 0).then_some(Spectra {
            rows: self.rows,
            texels: self.texels,
            count,
        })
    }
}

/// Returns the greatest of the reflectances, and each reflectance as a fraction of it.
fn greatest(all: impl Iterator<Item = f32> + Clone) -> (f32, Ratios) {
    let most = all.clone().fold(0.0f32, f32::max);
    let mut ratios = ONES;
    if most > 0.0 {
        for (to, r) in ratios.iter_mut().zip(all) {
            *to = r / most;
        }
    }
    (most, ratios)
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
        other @ (Bsdf::Several { .. } | Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. }) => {
            other
        }
    }
}

impl Spectra {
    /// Returns whether ratios can differ from 1. With one wavelength, all light is of that
    /// wavelength.
    #[inline(always)]
    pub fn is_spectral(&self) -> bool {
        self.count > 1
    }

    /// Returns the ratios with which a surface scatters from `i` to `o`, without its texture.
    #[inline]
    pub fn scattered(&self, s: &Surface, n: Vec3, i: Vec3, o: Vec3) -> Ratios {
        let row = usize::from(s.spectrum_row());
        if !s.is_mixed() || row == 0 {
            return self.rows[row];
        }
        mix(s.parts(n, i, o), &[self.rows[row], self.rows[row + 1]])
    }

    /// Returns the ratios of the Lambertian part and of the conductor of a mix. Other surfaces
    /// return their own ratios twice.
    pub fn lobes(&self, s: &Surface) -> [Ratios; 2] {
        let row = usize::from(s.spectrum_row());
        let second = row + usize::from(s.is_mixed() && row != 0);
        [self.rows[row], self.rows[second]]
    }

    /// Returns the factor of the brightest wavelength's reflectances at a texel of a surface.
    #[inline]
    pub fn brightest(&self, surface: usize, texel: [f32; 3]) -> f32 {
        match &self.texels[surface] {
            Some(texels) => texels.factors(texel, self.count).1,
            None => 1.0,
        }
    }

    /// Returns the ratios of a texel of a surface.
    #[inline]
    pub fn texel(&self, surface: usize, texel: [f32; 3]) -> Ratios {
        match &self.texels[surface] {
            Some(texels) => match texels.factors(texel, self.count) {
                (_, 0.0) => ONES,
                (factors, most) => {
                    let mut ratios = ONES;
                    for (to, f) in ratios.iter_mut().zip(factors).take(self.count) {
                        *to = f / most;
                    }
                    ratios
                }
            },
            None => ONES,
        }
    }
}
