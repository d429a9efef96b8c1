//! Mitsuba's blends as materials of one or two parts.
//!
//! A blend is (1 − `weight`) of its first BSDF and `weight` of its second, and either may be a
//! blend again. The leaves are read: Lambertians and conductors. The share of a leaf is the
//! product of the weights on the way to it. Lambertians side by side are one Lambertian of their
//! mean, and so are conductors of one roughness and distribution: both scatter in proportion to
//! what they reflect. What remains is one Lambertian, one conductor, or [`Bsdf::Mixed`] of both.
//! Conductors that differ are refused.
//!
//! - **Colour**: a material's `rgb` is the mean of its leaves' colours by their shares, so that the
//!   mean of its three channels is the sum of shares times reflectances. At a stated wavelength
//!   both parts have the hue of this `rgb`. A note says so where hues differ that were joined.
//! - **Texture**: it scales both parts. So all leaves with a share have the same bitmap, or none
//!   has one. Leaves that reflect nothing need none.
//! - **Sides**: a blend is two-sided where both its BSDFs are.

use std::{rc::Rc, sync::Arc};

use crate::{Bsdf, Distribution, Material, SpectrumPoint, Texture};

use super::{
    Reader,
    bsdf::{Look, named},
    colour::{Colour, mean_of, spectrum_of},
    node::Node,
    properties,
    transform::Matrix,
};

/// Hues with a smaller difference are the same.
const SAME_HUE: f32 = 1e-3;
/// Most different leaves of a blend.
const MAX_LEAVES: usize = 64;

/// A leaf of a blend.
#[derive(Debug, PartialEq)]
pub(super) struct Leaf {
    pub(super) colour: Colour,
    /// α and distribution of a conductor; `None` for a Lambertian.
    pub(super) metal: Option<(f32, Distribution)>,
}

impl Leaf {
    /// Returns whether the leaf is a Lambertian that reflects nothing, like the missing share of a
    /// material.
    fn is_black(&self) -> bool {
        let Colour {
            rgb,
            spectrum,
            texture,
        } = &self.colour;
        self.metal.is_none() && *rgb == [0.0; 3] && spectrum.is_empty() && texture.is_none()
    }

    fn has_spectrum(&self) -> bool {
        !self.colour.spectrum.is_empty()
    }

    fn bsdf(&self) -> Bsdf {
        let reflectance = self.colour.mean();
        match self.metal {
            None => Bsdf::Diffuse { reflectance },
            Some((alpha, distribution)) => Bsdf::RoughConductor {
                alpha,
                distribution,
                reflectance,
            },
        }
    }
}

/// A leaf with its share.
type Share = (f64, Rc<Leaf>);
/// Leaves with their shares.
type Leaves = Vec<Share>;

/// A BSDF as a set of leaves without duplicates; their shares sum to 1.
pub(super) struct Mix {
    leaves: Leaves,
    pub(super) two_sided: bool,
}

impl Mix {
    /// Returns a one-sided mix of one leaf.
    pub(super) fn of(leaf: Rc<Leaf>) -> Self {
        Self {
            leaves: vec![(1.0, leaf)],
            two_sided: false,
        }
    }

    /// Returns a mix of `self` and `other`, which has the share `weight`.
    pub(super) fn joined_with(self, other: Self, weight: f64) -> Self {
        let two_sided = self.two_sided && other.two_sided;
        let first = self.leaves.into_iter().map(|l| (l.0 * (1.0 - weight), l.1));
        let second = other.leaves.into_iter().map(|l| (l.0 * weight, l.1));
        let mut leaves = Leaves::new();
        for (share, leaf) in first.chain(second) {
            let alike = |known: &&mut Share| Rc::ptr_eq(&known.1, &leaf) || known.1 == leaf;
            match leaves.iter_mut().find(alike) {
                Some(known) => known.0 += share,
                None => leaves.push((share, leaf)),
            }
        }
        Self { leaves, two_sided }
    }
}

impl Reader<'_> {
    pub(super) fn blend(&mut self, node: &Rc<Node>, depth: usize) -> Result<Mix, String> {
        self.only(node, &properties::BLEND)?;
        let weight = match self.colour(node, "weight")? {
            Some(weight) if weight.texture.is_some() => {
                self.note("blends.weight", "is not read from textures; 0.5 used");
                0.5
            }
            Some(weight) => weight.mean(),
            None => return Err(node.fail("weight: expected a number from 0 to 1")),
        };
        if !(0.0..=1.0).contains(&weight) {
            return Err(node.fail(format!("weight: {weight} lies outside [0, 1]")));
        }
        let inner = self.children(node, "bsdf")?;
        let [a, b] = inner.as_slice() else {
            return Err(node.fail(format!("expected two BSDFs, found {}", inner.len())));
        };
        let (a, b) = (self.mix(a, depth + 1)?, self.mix(b, depth + 1)?);
        if a.two_sided != b.two_sided {
            self.note(
                "blends.sides",
                "of a two-sided and a one-sided BSDF are one-sided",
            );
        }
        let mix = a.joined_with(b, f64::from(weight));
        let count = mix.leaves.iter().filter(|l| has_share(l)).count();
        match count <= MAX_LEAVES {
            true => Ok(mix),
            false => Err(node.fail(format!(
                "has {count} different parts, expected {MAX_LEAVES} at most"
            ))),
        }
    }

    /// Returns the material of a mix.
    pub(super) fn assemble(&mut self, node: &Node, mix: Mix) -> Result<Look, String> {
        let mut leaves = mix.leaves;
        if !is_simple(&leaves) {
            leaves.retain(has_share);
        }
        let texture = texture_of(&leaves).map_err(|what| node.fail(what))?;
        let spectral = leaves.iter().any(|l| l.1.has_spectrum());
        let coloured = |c: &Colour| c.spectrum.is_empty() && c.rgb != [c.rgb[0]; 3];
        if spectral && leaves.iter().any(|l| coloured(&l.1.colour)) {
            self.note(
                "spectra",
                "parts of mixes without one reflect their mean at every wavelength",
            );
        }
        if !is_simple(&leaves) {
            if !spectral && have_several_hues(&leaves) {
                self.note(
                    "blends.hues",
                    "of several parts are that of their mean at stated wavelengths",
                );
            }
            leaves = joined(leaves);
        }
        let (bsdf, rgb, spectrum) = match (leaves.as_slice(), pair(&leaves)) {
            ([(_, one)], _) => (one.bsdf(), one.colour.rgb, one.colour.spectrum.clone()),
            (_, Some((lambertian, metal))) => mixed(&lambertian.1.colour, metal),
            _ => return Err(node.fail(too_many(&leaves))),
        };
        let (texture, to_uv) = texture.map_or((None, Matrix::IDENTITY), |(t, m)| (Some(t), m));
        let mut material = Material::diffuse(named(node), rgb);
        material.bsdf = bsdf;
        material.texture = texture;
        material.spectrum = spectrum;
        material.two_sided = mix.two_sided;
        Ok(Look { material, to_uv })
    }
}

type Assembled = (Bsdf, [f32; 3], Vec<SpectrumPoint>);

/// Returns whether a share is above zero in single precision.
fn has_share((share, _): &Share) -> bool {
    *share as f32 > 0.0
}

/// Returns one Lambertian and one conductor, in this order.
fn pair(leaves: &[Share]) -> Option<(&Share, &Share)> {
    match leaves {
        [a, b] if a.1.metal.is_none() && b.1.metal.is_some() => Some((a, b)),
        [a, b] if a.1.metal.is_some() && b.1.metal.is_none() => Some((b, a)),
        _ => None,
    }
}

/// Returns whether there is one leaf, or one Lambertian and one conductor.
fn is_simple(leaves: &[Share]) -> bool {
    leaves.len() == 1 || pair(leaves).is_some()
}

/// Returns the texture that scales all leaves.
fn texture_of(leaves: &[Share]) -> Result<Option<(Arc<Texture>, Matrix)>, &'static str> {
    let mut all = leaves.iter().filter(|l| !l.1.is_black());
    let Some((_, first)) = all.next() else {
        return Ok(None);
    };
    let texture = &first.colour.texture;
    match all.all(|l| l.1.colour.texture == *texture) {
        true => Ok(texture.clone()),
        false => Err("a texture scales all parts of a blend: give all the same bitmap"),
    }
}

/// The same with all Lambertians as one, and conductors that differ in colour alone, each in the
/// place of the first.
fn joined(leaves: Leaves) -> Leaves {
    let mut all: Vec<Leaves> = vec![];
    for leaf in leaves {
        match all
            .iter_mut()
            .find(|group| group[0].1.metal == leaf.1.metal)
        {
            Some(group) => group.push(leaf),
            None => all.push(vec![leaf]),
        }
    }
    let join = |group: Leaves| -> Share {
        if let [one] = group.as_slice() {
            return one.clone();
        }
        let colours: Vec<(f64, &Colour)> = group.iter().map(|l| (l.0, &l.1.colour)).collect();
        let texture = group.iter().find_map(|l| l.1.colour.texture.clone());
        let leaf = Leaf {
            colour: Colour {
                texture,
                ..mean_of(&colours)
            },
            metal: group[0].1.metal,
        };
        (group.iter().map(|l| l.0).sum(), Rc::new(leaf))
    };
    all.into_iter().map(join).collect()
}

/// Why leaves that were joined are no material.
fn too_many(leaves: &[Share]) -> String {
    let metals = leaves.iter().filter_map(|l| l.1.metal);
    let metals: Vec<String> = metals
        .map(|(alpha, distribution)| {
            let name = match distribution {
                Distribution::Beckmann => "beckmann",
                Distribution::Ggx => "ggx",
            };
            format!("alpha {alpha} ({name})")
        })
        .collect();
    format!(
        "has conductors of {}, expected one roughness in a material; give all roughconductor parts of the blend one alpha \
         and distribution, or leave the smaller part out",
        metals.join(", ")
    )
}

/// Returns a mix of a Lambertian and a conductor with its share.
fn mixed(d: &Colour, (share, metal): &Share) -> Assembled {
    let (s, w) = (&metal.colour, *share as f32);
    let (alpha, distribution) = metal.metal.unwrap_or((1.0, Distribution::Beckmann));
    let rgb = std::array::from_fn(|k| (1.0 - w) * d.rgb[k] + w * s.rgb[k]);
    let bsdf = Bsdf::Mixed {
        reflectance: d.mean(),
        alpha,
        distribution,
        specular_reflectance: s.mean(),
        weight: w,
    };
    (bsdf, rgb, spectrum_of(Some(d), Some(s)))
}

/// True where colours differ by more than their brightness.
fn have_several_hues(leaves: &[Share]) -> bool {
    let colours = leaves.iter().map(|l| &l.1.colour);
    let mut hues = colours
        .filter(|c| c.mean() > 0.0)
        .map(|c| c.rgb.map(|x| x / c.mean()));
    let Some(first) = hues.next() else {
        return false;
    };
    let differs = |other: [f32; 3]| (0..3).any(|k| (other[k] - first[k]).abs() > SAME_HUE);
    hues.any(differs)
}
