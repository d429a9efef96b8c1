//! Converts Mitsuba's BSDFs to materials.

use std::rc::Rc;

use crate::{
    Bsdf, Distribution, Material, SpectrumPoint,
    export::mitsuba::text::{MaterialExtras, bsdf_text},
    import::quoted,
    spectrum::{PRIMARIES_NM, interpolated},
};

use super::{
    Reader,
    blend::{Leaf, Mix},
    colour::Colour,
    glass::is_glass,
    metal,
    node::{Node, Value},
    properties,
    transform::Matrix,
};

/// The deepest nesting of BSDFs, references included.
const MAX_DEPTH: usize = 8;
const SUBSET: &str = "use diffuse, plastic, roughplastic, principled, roughconductor, conductor, or twosided, mask, bumpmap, \
                      normalmap or blendbsdf of these, or dielectric, roughdielectric or thindielectric by itself";
/// The text in exports of thin glass from the time when its reflections were not rendered.
const UNREFLECTED: &str = r#"<rgb name="specular_reflectance" value="0 0 0"/>"#;

/// A material, and the transform that its textures apply to texture coordinates.
#[derive(Debug, Clone)]
pub(super) struct Look {
    pub(super) material: Material,
    pub(super) to_uv: Matrix,
}

impl Reader<'_> {
    /// Returns the material of a BSDF. If its text is unchanged from our export, the exact material
    /// is returned.
    pub(super) fn look(&mut self, node: &Rc<Node>) -> Result<Look, String> {
        let key = Rc::as_ptr(node).addr();
        if let Some(known) = self.looks.get(&key) {
            return Ok(known.clone());
        }
        let look = match self.exact(node)? {
            Some(material) => Look {
                material,
                to_uv: Matrix::IDENTITY,
            },
            None => {
                let bare = self.bare(node)?;
                match is_glass(&bare) {
                    true => Look {
                        material: self.glass(&bare)?,
                        to_uv: Matrix::IDENTITY,
                    },
                    false => {
                        let mix = self.mix(node, 0)?;
                        self.assemble(node, mix)?
                    }
                }
            }
        };
        self.looks.insert(key, look.clone());
        Ok(look)
    }

    fn exact(&mut self, node: &Node) -> Result<Option<Material>, String> {
        let known = self.extras.as_ref().and_then(|e| e.materials.get(&node.id));
        let Some(known) = known.cloned() else {
            return Ok(None);
        };
        let MaterialExtras {
            name,
            bsdf,
            rgb,
            two_sided,
            texture,
            spectrum,
        } = &known;
        let texture = match texture {
            None => None,
            Some(t) => {
                let file = self.named(node, &t.file)?;
                Some(self.image(node, &file, &t.name, t.wrap, false)?)
            }
        };
        let material = Material {
            name: name.clone(),
            bsdf: *bsdf,
            rgb: *rgb,
            texture,
            two_sided: *two_sided,
            spectrum: spectrum.clone(),
        };
        let text = match bsdf {
            Bsdf::ThinDielectric { .. } => &node.text.replacen(UNREFLECTED, "", 1),
            _ => &node.text,
        };
        if bsdf_text(&node.id, &material, known.texture.as_ref()).text == *text {
            let checked = material.check_spectrum();
            checked.map_err(|what| node.fail(format!("comment picofarm: {what}")))?;
            return Ok(Some(material));
        }
        self.note("materials", "edited since export; standard parameters used");
        if !spectrum.is_empty() {
            self.note(
                "spectra.edited",
                "left out of materials edited since export",
            );
        }
        Ok(None)
    }

    /// Returns the parts of a BSDF.
    pub(super) fn mix(&mut self, node: &Rc<Node>, depth: usize) -> Result<Mix, String> {
        if depth > MAX_DEPTH {
            return Err(node.fail(format!("nested deeper than {MAX_DEPTH}")));
        }
        match node.kind.as_str() {
            "diffuse" | "roughconductor" | "conductor" => Ok(Mix::of(self.leaf(node)?)),
            "twosided" => {
                self.only(node, &properties::TWO_SIDED)?;
                let inner = self.children(node, "bsdf")?;
                let [inner] = inner.as_slice() else {
                    return Err(node.fail(format!(
                        "expected one BSDF for both sides, found {}",
                        inner.len()
                    )));
                };
                let mut mix = self.mix(inner, depth + 1)?;
                mix.two_sided = true;
                Ok(mix)
            }
            "blendbsdf" => self.blend(node, depth),
            "plastic" | "roughplastic" | "pplastic" => {
                self.only(node, &properties::PLASTIC)?;
                self.note("plastics", "are Lambertian: their gloss is left out");
                let colour = self.colour(node, "diffuse_reflectance")?;
                Ok(Mix::of(Rc::new(Leaf {
                    colour: colour.unwrap_or(Colour::grey(0.5)),
                    metal: None,
                })))
            }
            "principled" | "principledthin" => self.principled(node),
            "mask" | "bumpmap" | "normalmap" => {
                let inner = self.inner(node)?;
                self.mix(&inner, depth + 1)
            }
            // Their properties describe measurements or fibres, so no colour can be read from them.
            kind @ ("measured" | "measured_polarized" | "hair") => {
                self.note(
                    &format!("bsdf.{kind}"),
                    "replaced by a Lambertian of reflectance 0.5",
                );
                Ok(Mix::of(Rc::new(Leaf {
                    colour: Colour::grey(0.5),
                    metal: None,
                })))
            }
            other => Err(node.fail(format!("bsdf {} is not supported; {SUBSET}", quoted(other)))),
        }
    }

    /// Returns the BSDF inside of one that changes only its shading.
    fn inner(&mut self, node: &Node) -> Result<Rc<Node>, String> {
        match node.kind.as_str() {
            "mask" => {
                self.only(node, &properties::MASK)?;
                if node
                    .number("opacity")
                    .ok()
                    .flatten()
                    .is_none_or(|o| o < 1.0)
                {
                    self.note("masks", "are opaque: holes and transparency are left out");
                }
            }
            _ => {
                self.only(node, &properties::RELIEF)?;
                self.note("relief", "of bump maps and normal maps is left out");
            }
        }
        match self.children(node, "bsdf")?.as_slice() {
            [inner] => Ok(inner.clone()),
            other => Err(node.fail(format!("expected one BSDF, found {}", other.len()))),
        }
    }

    /// Returns the BSDF below all that change only its shading.
    fn bare(&mut self, node: &Rc<Node>) -> Result<Rc<Node>, String> {
        let mut bare = node.clone();
        for _ in 0..=MAX_DEPTH {
            if !matches!(bare.kind.as_str(), "mask" | "bumpmap" | "normalmap") {
                return Ok(bare);
            }
            bare = self.inner(&bare)?;
        }
        Err(node.fail(format!("nested deeper than {MAX_DEPTH}")))
    }

    /// Returns Disney's BSDF as the materials of glTF: a Lambertian and a GGX conductor of
    /// α = roughness², with the share `metallic`.
    fn principled(&mut self, node: &Node) -> Result<Mix, String> {
        self.only(node, &properties::PRINCIPLED)?;
        let colour = self.colour(node, "base_color")?;
        let colour = colour.unwrap_or(Colour::grey(0.5));
        let mut scalar = |name: &str, usual: f32| {
            let known = self.colour(node, name)?;
            if known.as_ref().is_some_and(|c| c.texture.is_some()) {
                self.note(
                    &format!("textures.{name}"),
                    format!("is not read from textures; {usual} used"),
                );
                return Ok(usual);
            }
            Ok::<f32, String>(known.map_or(usual, |c| c.mean()))
        };
        let metallic = scalar("metallic", 0.0)?.clamp(0.0, 1.0);
        let roughness = scalar("roughness", 0.5)?;
        let alpha = (roughness * roughness).clamp(Material::MIN_ALPHA, 1.0);
        let lambertian = Mix::of(Rc::new(Leaf {
            colour: colour.clone(),
            metal: None,
        }));
        let metal = Mix::of(Rc::new(Leaf {
            colour,
            metal: Some((alpha, Distribution::Ggx)),
        }));
        let mut mix = match metallic {
            0.0 => lambertian,
            1.0 => metal,
            share => lambertian.joined_with(metal, f64::from(share)),
        };
        mix.two_sided = node.kind == "principledthin";
        Ok(mix)
    }

    /// Returns a Lambertian or a conductor, which is read once even if several blends refer to it.
    fn leaf(&mut self, node: &Rc<Node>) -> Result<Rc<Leaf>, String> {
        let key = Rc::as_ptr(node).addr();
        if let Some(known) = self.leaves.get(&key) {
            return Ok(known.clone());
        }
        let leaf = Rc::new(if node.kind == "diffuse" {
            self.only(node, &properties::DIFFUSE)?;
            let colour = self.colour(node, "reflectance")?;
            Leaf {
                colour: colour.unwrap_or(Colour::grey(0.5)),
                metal: None,
            }
        } else {
            let (colour, alpha, distribution) = self.conductor(node)?;
            Leaf {
                colour,
                metal: Some((alpha, distribution)),
            }
        });
        self.leaves.insert(key, leaf.clone());
        Ok(leaf)
    }

    fn conductor(&mut self, node: &Node) -> Result<(Colour, f32, Distribution), String> {
        let smooth = node.kind == "conductor";
        self.only(
            node,
            if smooth {
                &properties::CONDUCTOR
            } else {
                &properties::ROUGH_CONDUCTOR
            },
        )?;
        let alpha = if smooth {
            self.note(
                "smooth_conductors",
                format!("are rough ones of α = {}", Material::MIN_ALPHA),
            );
            Material::MIN_ALPHA
        } else {
            let mut roughness = |name: &str| {
                let known = self.colour(node, name)?;
                if known.as_ref().is_some_and(|c| c.texture.is_some()) {
                    self.note("alpha", "is not read from textures; 0.1 used");
                    return Ok(Some(0.1));
                }
                Ok::<Option<f32>, String>(known.map(|c| c.mean()))
            };
            let (u, v) = (roughness("alpha_u")?, roughness("alpha_v")?);
            let alpha = roughness("alpha")?;
            let alpha = match (alpha, u, v) {
                (Some(alpha), _, _) => alpha,
                (None, None, None) => 0.1,
                (None, u, v) => {
                    let (u, v) = (u.unwrap_or(0.1), v.unwrap_or(0.1));
                    if u != v {
                        self.note(
                            "anisotropy",
                            "is left out: the geometric mean of alpha_u and alpha_v used",
                        );
                    }
                    (u * v).sqrt()
                }
            };
            if alpha < Material::MIN_ALPHA {
                self.note(
                    "alpha",
                    format!("below {0} raised to {0}", Material::MIN_ALPHA),
                );
            }
            alpha.max(Material::MIN_ALPHA)
        };
        let distribution = match node.text("distribution")?.unwrap_or("beckmann") {
            "beckmann" => Distribution::Beckmann,
            "ggx" => Distribution::Ggx,
            other => {
                return Err(node.fail(format!(
                    "distribution: {}; use beckmann or ggx",
                    quoted(other)
                )));
            }
        };
        let stated = self.fresnel_of_index(node)?;
        let fresnel = match (node.text("material")?, stated) {
            (None, Some(stated)) => stated,
            (Some("none"), _) => [1.0; 3],
            (name, _) => {
                let name = name.unwrap_or("Cu");
                let Some(reflectance) = metal::reflectance(name) else {
                    return Err(node.fail(format!(
                        "material: {} is not known; use \"none\" with specular_reflectance, or one of {}",
                        quoted(name),
                        metal::names().join(", ")
                    )));
                };
                self.note("metals", "Fresnel reflectance at normal incidence used");
                reflectance
            }
        };
        let mut colour = self
            .colour(node, "specular_reflectance")?
            .unwrap_or(Colour::grey(1.0));
        if !colour.spectrum.is_empty() && fresnel != [1.0; 3] {
            return Err(node.fail(
                "specular_reflectance: a spectrum needs material \"none\"; of metals only three colours are known",
            ));
        }
        for (c, f) in colour.rgb.iter_mut().zip(fresnel) {
            *c *= f;
        }
        Ok((colour, alpha, distribution))
    }
}

impl Reader<'_> {
    /// Returns the reflectance at normal incidence of the complex index of refraction `eta` + i
    /// `k`, if the file states it in numbers.
    fn fresnel_of_index(&mut self, node: &Node) -> Result<Option<[f32; 3]>, String> {
        let (Some(eta), Some(k)) = (self.index(node, "eta")?, self.index(node, "k")?) else {
            return Ok(None);
        };
        self.note("metals", "Fresnel reflectance at normal incidence used");
        Ok(Some(std::array::from_fn(|c| metal::fresnel(eta[c], k[c]))))
    }

    /// Returns a part of a complex index of refraction at red, green and blue. Unlike a
    /// reflectance, it may exceed 1.
    fn index(&mut self, node: &Node, name: &str) -> Result<Option<[f32; 3]>, String> {
        let Some(Value::Spectrum(points)) = node.parameters.get(name) else {
            return Ok(self.colour(node, name)?.map(|colour| colour.rgb));
        };
        let ascending = points.windows(2).all(|w| w[0].nm < w[1].nm);
        let valid = |p: &SpectrumPoint| p.reflectance.is_finite() && p.reflectance >= 0.0;
        if !ascending || !points.iter().all(valid) {
            return Err(node.fail(format!(
                "{name}: expected values from 0 at ascending wavelengths"
            )));
        }
        let [blue, green, red] =
            PRIMARIES_NM.map(|nm| interpolated(points, nm, |p| [p.reflectance]));
        Ok(match (red, green, blue) {
            (Some([r]), Some([g]), Some([b])) => Some([r, g, b]),
            _ => None,
        })
    }
}

/// Returns the name of a material.
pub(super) fn named(node: &Node) -> String {
    match node.id.is_empty() {
        true => node.kind.clone(),
        false => node.id.clone(),
    }
}
