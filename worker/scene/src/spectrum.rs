//! Reflectance by wavelength, from a material's spectrum or else from its colour.

use picofarm_settings::WAVELENGTHS_NM;
use serde::{Deserialize, Serialize};

use crate::{Bsdf, Material};

/// The reflectance at one wavelength. Between two points, reflectances are interpolated linearly;
/// beyond the last points, they are constant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpectrumPoint {
    /// The wavelength, nanometres.
    pub nm: f32,
    /// The reflectance of the Lambertian part, or of a conductor alone, in [0, 1].
    pub reflectance: f32,
    /// Reflectance of the conductor of a mix, in [0, 1]; without it that of the material's
    /// [`Bsdf`]. Other materials have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub specular_reflectance: Option<f32>,
}

/// A material at a wavelength.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AtWavelength {
    /// The reflectance of the Lambertian part.
    pub lambertian: f32,
    /// The reflectance of the conductor.
    pub conductor: f32,
    /// For a texture: both reflectances are multiplied by this times the texel's linear RGB, summed
    /// over the channels. The factor is limited so that the larger reflectance is at most 1.
    pub texel: [f32; 3],
}

/// The wavelengths between which a colour determines reflectances, nanometres.
const VISIBLE_NM: (f32, f32) = (400.0, 700.0);
/// The dominant wavelengths of the primaries of linear RGB (ITU-R BT.709), nanometres: blue, green,
/// red.
pub(crate) const PRIMARIES_NM: [f32; 3] = [464.3, 549.1, 611.4];

/// Returns the weights of red, green and blue in a colour's reflectance at a wavelength: 1 at a
/// primary, and linear between two primaries. Returns `None` outside the range of colours.
fn of_colour(nm: f32) -> Option<[f32; 3]> {
    if !(VISIBLE_NM.0..=VISIBLE_NM.1).contains(&nm) {
        return None;
    }
    let [blue, green, red] = PRIMARIES_NM;
    let between = |a: f32, b: f32| ((nm - a) / (b - a)).clamp(0.0, 1.0);
    let (up, down) = (between(blue, green), between(green, red));
    Some([down, up - down, 1.0 - up])
}

impl Material {
    /// What it reflects at a wavelength. Where it states no [`Material::spectrum`], its colour
    /// stands for it from 400 to 700 nm: reflectances are those of its BSDF times the colour there
    /// over the mean of the colour's three channels. Outside they are those of its BSDF.
    pub fn at(&self, nm: f32) -> AtWavelength {
        let plain = match self.bsdf {
            Bsdf::Diffuse { reflectance } => [reflectance, 0.0],
            Bsdf::RoughConductor { reflectance, .. } => [0.0, reflectance],
            Bsdf::Mixed {
                reflectance,
                specular_reflectance,
                ..
            } => [reflectance, specular_reflectance],
            Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => [0.0, 0.0],
        };
        let grey = [1.0 / 3.0; 3];
        let of = |[lambertian, conductor]: [f32; 2], texel| AtWavelength {
            lambertian,
            conductor,
            texel,
        };
        if let Some([reflectance, specular]) = self.stated(nm) {
            let stated = match self.bsdf {
                Bsdf::RoughConductor { .. } => [0.0, reflectance],
                Bsdf::Mixed { .. } => [reflectance, specular],
                _ => [reflectance, 0.0],
            };
            return of(stated, grey);
        }
        let mean = (self.rgb[0] + self.rgb[1] + self.rgb[2]) / 3.0;
        let Some(shares) = of_colour(nm).filter(|_| mean > 0.0) else {
            return of(plain, grey);
        };
        let texel: [f32; 3] = std::array::from_fn(|k| shares[k] * self.rgb[k] / mean);
        match self.texture {
            Some(_) => of(plain, texel),
            None => {
                let factor = texel.iter().sum::<f32>();
                of(plain.map(|r| (r * factor).min(1.0)), grey)
            }
        }
    }

    /// Both reflectances of its spectrum at a wavelength, if it has one.
    fn stated(&self, nm: f32) -> Option<[f32; 2]> {
        let mix = match self.bsdf {
            Bsdf::Mixed {
                specular_reflectance,
                ..
            } => specular_reflectance,
            _ => 0.0,
        };
        interpolated(&self.spectrum, nm, |p| {
            [p.reflectance, p.specular_reflectance.unwrap_or(mix)]
        })
    }

    /// Checks the physical limits of the spectrum; the message names the allowed values.
    pub(crate) fn check_spectrum(&self) -> Result<(), String> {
        match self.spectrum.is_empty() || !self.transmits() {
            true => check_points(&self.spectrum, Some(self.bsdf)),
            false => Err("spectrum: glass takes none; remove it".into()),
        }
    }
}

/// Interpolates rows at a wavelength: linearly between rows, constant beyond the ends. Returns
/// `None` without rows.
pub(crate) fn interpolated<const N: usize>(
    rows: &[SpectrumPoint],
    nm: f32,
    row: impl Fn(&SpectrumPoint) -> [f32; N],
) -> Option<[f32; N]> {
    let after = rows.partition_point(|p| p.nm <= nm);
    match (after.checked_sub(1), rows.get(after)) {
        (None, first) => first.map(row),
        (Some(last), None) => Some(row(&rows[last])),
        (Some(before), Some(b)) => {
            let a = &rows[before];
            let t = (nm - a.nm) / (b.nm - a.nm);
            let (a, b) = (row(a), row(b));
            Some(std::array::from_fn(|k| a[k] + (b[k] - a[k]) * t))
        }
    }
}

/// Checks the physical limits of rows, of a material or of a part alone; the message names the
/// allowed values.
pub(crate) fn check_points(rows: &[SpectrumPoint], bsdf: Option<Bsdf>) -> Result<(), String> {
    let unit = 0.0..=1.0;
    let (least, most) = WAVELENGTHS_NM;
    for (k, p) in rows.iter().enumerate() {
        let fail = |what: String| Err(format!("spectrum[{k}].{what}"));
        if !(least..=most).contains(&f64::from(p.nm)) {
            return fail(format!("nm = {} lies outside [{least}, {most}]", p.nm));
        }
        if k > 0 && p.nm <= rows[k - 1].nm {
            return fail(format!("nm = {} does not ascend", p.nm));
        }
        if !unit.contains(&p.reflectance) {
            return fail(format!(
                "reflectance = {} lies outside [0, 1]",
                p.reflectance
            ));
        }
        match (p.specular_reflectance, bsdf) {
            (None, _) => {}
            (Some(r), Some(Bsdf::Mixed { .. })) if unit.contains(&r) => {}
            (Some(r), Some(Bsdf::Mixed { .. })) => {
                return fail(format!("specular_reflectance = {r} lies outside [0, 1]"));
            }
            (Some(_), _) => {
                return fail(
                    "specular_reflectance is of mixed materials alone; give reflectance".into(),
                );
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::Distribution;

    fn point(nm: f32, reflectance: f32) -> SpectrumPoint {
        SpectrumPoint {
            nm,
            reflectance,
            specular_reflectance: None,
        }
    }

    #[test]
    fn a_stated_spectrum_is_interpolated_and_stays_beyond_its_ends() {
        let mut m = Material::diffuse("wall", [0.9, 0.1, 0.1]);
        m.spectrum = vec![point(500.0, 0.2), point(600.0, 0.6), point(900.0, 0.3)];
        for (nm, r) in [
            (400.0, 0.2),
            (500.0, 0.2),
            (550.0, 0.4),
            (600.0, 0.6),
            (800.0, 0.4),
            (1550.0, 0.3),
        ] {
            assert!((m.at(nm).lambertian - r).abs() < 1e-6, "{nm}");
        }
        assert_eq!(m.check_spectrum(), Ok(()));
    }

    #[test]
    fn a_colour_stands_for_reflectances_where_it_is_visible_and_nowhere_else() {
        let m = Material::diffuse("wall", [0.8, 0.4, 0.2]);
        for (nm, r) in [
            (450.0, 0.2),
            (549.1, 0.4),
            (632.8, 0.8),
            (580.25, 0.6),
            (905.0, 1.4 / 3.0),
            (1550.0, 1.4 / 3.0),
        ] {
            let found = m.at(nm).lambertian;
            assert!((found - r).abs() < 1e-5, "{nm}: {found}");
        }
        let black = Material::diffuse("hole", [0.0; 3]);
        assert_eq!(black.at(532.0).lambertian, 0.0);
    }

    #[test]
    fn parts_of_a_mix_have_reflectances_of_their_own() {
        let mut m = Material::diffuse("paint", [0.5; 3]);
        m.bsdf = Bsdf::Mixed {
            reflectance: 0.5,
            alpha: 0.2,
            distribution: Distribution::Ggx,
            specular_reflectance: 0.7,
            weight: 0.3,
        };
        m.spectrum = vec![SpectrumPoint {
            specular_reflectance: Some(0.9),
            ..point(905.0, 0.8)
        }];
        let at = m.at(905.0);
        assert_eq!((at.lambertian, at.conductor), (0.8, 0.9));
        m.spectrum = vec![point(905.0, 0.8)];
        assert_eq!(m.at(905.0).conductor, 0.7);
    }

    #[test]
    fn a_spectrum_that_cannot_be_is_refused_with_its_row() {
        let of = |spectrum: Vec<SpectrumPoint>| {
            let mut m = Material::diffuse("wall", [0.5; 3]);
            m.spectrum = spectrum;
            m.check_spectrum().unwrap_err()
        };
        assert!(of(vec![point(f32::NAN, 0.5)]).starts_with("spectrum[0].nm"));
        assert!(of(vec![point(50.0, 0.5)]).contains("[200, 20000]"));
        assert!(of(vec![point(500.0, 0.5), point(500.0, 0.5)]).starts_with("spectrum[1].nm"));
        assert!(of(vec![point(500.0, 1.5)]).contains("reflectance = 1.5"));
        let specular = SpectrumPoint {
            specular_reflectance: Some(0.5),
            ..point(500.0, 0.5)
        };
        assert!(of(vec![specular]).contains("mixed"));
        for mut glass in [Material::glass("pane"), Material::solid_glass("ball")] {
            glass.spectrum = vec![point(500.0, 0.5)];
            assert!(glass.check_spectrum().unwrap_err().contains("glass"));
        }
    }

    proptest! {
        #[test]
        fn no_wavelength_makes_a_surface_that_gives_more_than_it_gets(
            rgb in prop::array::uniform3(0.0f32..=1.0),
            reflectance in 0.0f32..=1.0,
            nm in 200.0f32..20_000.0,
        ) {
            let mut m = Material::diffuse("wall", rgb);
            prop_assert!((0.0..=1.0).contains(&m.at(nm).lambertian));
            m.bsdf = Bsdf::Diffuse { reflectance };
            prop_assert!((0.0..=1.0).contains(&m.at(nm).lambertian));
        }

        #[test]
        fn the_mean_over_a_colours_primaries_is_the_material_itself(rgb in prop::array::uniform3(0.0f32..=1.0)) {
            let m = Material::diffuse("wall", rgb);
            let mean = PRIMARIES_NM.map(|nm| m.at(nm).lambertian).iter().sum::<f32>() / 3.0;
            let Bsdf::Diffuse { reflectance } = m.bsdf else { unreachable!() };
            prop_assert!((mean - reflectance).abs() < 1e-5);
        }
    }
}
