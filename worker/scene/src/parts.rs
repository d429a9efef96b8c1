//! Materials that consist of several parts.

use serde::{Deserialize, Serialize};

use crate::{Bsdf, Distribution, Material};

/// The greatest number of parts of a material.
pub const MAX_PARTS: usize = 8;

/// The scattering of a part; see [`Bsdf`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Lobe {
    /// Lambertian.
    Diffuse {
        /// The albedo at the laser's wavelength, in [0, 1].
        reflectance: f32,
    },
    /// Rough conductor.
    RoughConductor {
        /// The roughness α of the microfacet distribution.
        alpha: f32,
        /// The microfacet distribution.
        distribution: Distribution,
        /// The scale of the reflection, in [0, 1].
        reflectance: f32,
    },
}

impl Lobe {
    /// Returns the BSDF of this part alone.
    pub fn bsdf(self) -> Bsdf {
        match self {
            Lobe::Diffuse { reflectance } => Bsdf::Diffuse { reflectance },
            Lobe::RoughConductor {
                alpha,
                distribution,
                reflectance,
            } => Bsdf::RoughConductor {
                alpha,
                distribution,
                reflectance,
            },
        }
    }

    /// Returns the reflectance at the laser's wavelength.
    pub fn reflectance(self) -> f32 {
        match self {
            Lobe::Diffuse { reflectance } | Lobe::RoughConductor { reflectance, .. } => reflectance,
        }
    }

    /// Returns the part with its reflectance multiplied by `factor`.
    fn scaled(mut self, factor: f32) -> Self {
        match &mut self {
            Lobe::Diffuse { reflectance } | Lobe::RoughConductor { reflectance, .. } => {
                *reflectance *= factor;
            }
        }
        self
    }
}

/// A part and its share of the surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Part {
    /// The share in [0, 1]. The sum of all parts' shares is at most 1; the missing share is black.
    pub weight: f32,
    /// The scattering of the part.
    pub lobe: Lobe,
}

/// The parts of a material: 1 to [`MAX_PARTS`].
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(try_from = "Vec<Part>", into = "Vec<Part>")]
pub struct Parts {
    all: [Part; MAX_PARTS],
    count: usize,
}

impl Parts {
    /// Creates the parts of a material.
    ///
    /// # Errors
    /// A message with the allowed number of parts.
    pub fn of(parts: &[Part]) -> Result<Self, String> {
        if !(1..=MAX_PARTS).contains(&parts.len()) {
            return Err(format!(
                "parts: has {}, expected 1 to {MAX_PARTS}",
                parts.len()
            ));
        }
        let black = Part {
            weight: 0.0,
            lobe: Lobe::Diffuse { reflectance: 0.0 },
        };
        let mut all = [black; MAX_PARTS];
        all[..parts.len()].copy_from_slice(parts);
        Ok(Self {
            all,
            count: parts.len(),
        })
    }

    /// Returns all parts.
    pub fn list(&self) -> &[Part] {
        &self.all[..self.count]
    }

    /// Returns the parts with every reflectance multiplied by `factor`.
    pub(crate) fn scaled(mut self, factor: f32) -> Self {
        for part in &mut self.all {
            part.lobe = part.lobe.scaled(factor);
        }
        self
    }

    /// Returns the share of the surface that near-mirrors take.
    pub(crate) fn mirror(&self) -> f32 {
        let near = |p: &&Part| matches!(p.lobe, Lobe::RoughConductor { alpha, .. } if alpha <= Material::SPECULAR_ALPHA);
        self.list().iter().filter(near).map(|p| p.weight).sum()
    }

    /// Returns the share of conductors, and their mean roughness weighted by share; both at most 1.
    pub(crate) fn conductors(&self) -> (f32, f32) {
        let of = |p: &Part| match p.lobe {
            Lobe::RoughConductor { alpha, .. } => (p.weight, p.weight * alpha),
            Lobe::Diffuse { .. } => (0.0, 0.0),
        };
        let all = self.list().iter().map(of);
        let (share, rough) = all.fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
        let alpha = if share > 0.0 { rough / share } else { 1.0 };
        // Sums of shares and their quotients are rounded.
        (share.min(1.0), alpha.min(1.0))
    }

    /// Checks physical limits; the message names the allowed values.
    pub(crate) fn check(&self) -> Result<(), String> {
        let unit = |k: usize, name: &str, v: f32| match (0.0..=1.0).contains(&v) {
            true => Ok(()),
            false => Err(format!("parts[{k}].{name} = {v} lies outside [0, 1]")),
        };
        let mut sum = 0.0;
        for (k, part) in self.list().iter().enumerate() {
            unit(k, "weight", part.weight)?;
            sum += part.weight;
            match part.lobe {
                Lobe::Diffuse { reflectance } => unit(k, "reflectance", reflectance)?,
                Lobe::RoughConductor {
                    alpha, reflectance, ..
                } => {
                    unit(k, "reflectance", reflectance)?;
                    if !(Material::MIN_ALPHA..=1.0).contains(&alpha) {
                        return Err(format!(
                            "parts[{k}].alpha = {alpha} lies outside [0.001, 1]"
                        ));
                    }
                }
            }
        }
        // The tolerance allows for rounding of weights that sum to 1.
        match sum <= 1.0 + 1e-5 {
            true => Ok(()),
            false => Err(format!(
                "parts: weights sum to {sum}, expected 1 at most; divide each by that"
            )),
        }
    }
}

impl PartialEq for Parts {
    fn eq(&self, other: &Self) -> bool {
        self.list() == other.list()
    }
}

impl TryFrom<Vec<Part>> for Parts {
    type Error = String;

    fn try_from(parts: Vec<Part>) -> Result<Self, String> {
        Self::of(&parts)
    }
}

impl From<Parts> for Vec<Part> {
    fn from(parts: Parts) -> Self {
        parts.list().to_vec()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn diffuse(weight: f32, reflectance: f32) -> Part {
        Part {
            weight,
            lobe: Lobe::Diffuse { reflectance },
        }
    }

    fn metal(weight: f32, alpha: f32) -> Part {
        Part {
            weight,
            lobe: Lobe::RoughConductor {
                alpha,
                distribution: Distribution::Ggx,
                reflectance: 0.9,
            },
        }
    }

    #[test]
    fn parts_that_cannot_be_are_refused_by_their_place() {
        let of = |parts: &[Part]| Parts::of(parts).and_then(|p| p.check());
        assert_eq!(
            of(&[diffuse(0.5, 0.5), metal(0.3, 0.1), metal(0.2, 0.4)]),
            Ok(())
        );
        assert!(of(&[]).unwrap_err().contains("expected 1 to 8"));
        assert!(of(&[diffuse(0.1, 0.5); 9]).unwrap_err().contains("has 9"));
        assert!(
            of(&[diffuse(0.5, 1.5)])
                .unwrap_err()
                .starts_with("parts[0].reflectance")
        );
        assert!(
            of(&[metal(0.5, 0.1), metal(0.5, 0.0)])
                .unwrap_err()
                .starts_with("parts[1].alpha")
        );
        assert!(
            of(&[metal(f32::NAN, 0.1)])
                .unwrap_err()
                .starts_with("parts[0].weight")
        );
        assert!(
            of(&[metal(0.8, 0.1), diffuse(0.3, 0.5)])
                .unwrap_err()
                .contains("sum to 1.1")
        );
    }

    #[test]
    fn parts_are_written_as_a_list_and_read_back() {
        let parts = Parts::of(&[diffuse(0.5, 0.25), metal(0.5, 0.125)]).unwrap();
        let text = serde_json::to_string(&Bsdf::Several { parts }).unwrap();
        assert_eq!(
            text,
            r#"{"type":"several","parts":[{"weight":0.5,"lobe":{"type":"diffuse","reflectance":0.25}},{"weight":0.5,"lobe":{"type":"rough_conductor","alpha":0.125,"distribution":"ggx","reflectance":0.9}}]}"#
        );
        let read: Bsdf = serde_json::from_str(&text).unwrap();
        assert_eq!(read, Bsdf::Several { parts });
        assert_eq!(parts.conductors(), (0.5, 0.125));
        assert_eq!(parts.mirror(), 0.0);
    }
}
