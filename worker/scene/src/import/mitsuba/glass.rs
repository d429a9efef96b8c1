//! Converts Mitsuba's glass.

use crate::{Bsdf, Material, import::quoted};

use super::{Reader, bsdf::named, colour::Colour, node::Node, properties};

/// Mitsuba's names of media, with their indices of refraction.
const MEDIA: [(&str, f64); 22] = [
    ("vacuum", 1.0),
    ("helium", 1.000_04),
    ("hydrogen", 1.000_13),
    ("air", 1.000_277),
    ("carbon dioxide", 1.000_45),
    ("water", 1.333),
    ("water ice", 1.31),
    ("acetone", 1.36),
    ("ethanol", 1.361),
    ("fused quartz", 1.458),
    ("carbon tetrachloride", 1.461),
    ("pyrex", 1.47),
    ("glycerol", 1.4729),
    ("acrylic glass", 1.49),
    ("polypropylene", 1.49),
    ("benzene", 1.501),
    ("bk7", 1.5046),
    ("silicone oil", 1.520_45),
    ("sodium chloride", 1.544),
    ("amber", 1.55),
    ("pet", 1.575),
    ("diamond", 2.419),
];

impl Reader<'_> {
    /// Returns a material of glass, thin or solid.
    pub(super) fn glass(&mut self, node: &Node) -> Result<Material, String> {
        if node.kind == "roughdielectric" {
            self.only(node, &properties::ROUGH_GLASS)?;
            self.note("rough_glass", "is smooth");
        } else {
            self.only(node, &properties::GLASS)?;
        }
        let ior = index(node, "int_ior", "bk7")? / index(node, "ext_ior", "air")?;
        if !(1.0..=f64::from(Material::MAX_IOR)).contains(&ior) {
            let hint = match node.kind.as_str() {
                "dielectric" | "roughdielectric" => {
                    "; a cavity belongs into the mesh of the body around it, with facets that face the cavity"
                }
                _ => "; int_ior is that of the glass",
            };
            return Err(node.fail(format!(
                "int_ior / ext_ior = {ior} lies outside [1, 4]{hint}"
            )));
        }
        let plain = |colour: Option<Colour>, name: &str| match colour {
            Some(c) if c.texture.is_some() => {
                Err(node.fail(format!("{name}: textures on glass are not supported")))
            }
            Some(c) if !c.spectrum.is_empty() => Err(node.fail(format!(
                "{name}: spectra on glass are not supported; use rgb"
            ))),
            colour => Ok(colour.unwrap_or(Colour::grey(1.0))),
        };
        let reflected = self.colour(node, "specular_reflectance")?;
        if plain(reflected, "specular_reflectance")?.rgb != [1.0; 3] {
            self.note(
                "glass",
                "specular_reflectance is not used: glass reflects what Fresnel's equations say",
            );
        }
        let tint = self.colour(node, "specular_transmittance")?;
        let tint = plain(tint, "specular_transmittance")?;
        let (ior, transmittance) = (ior as f32, tint.mean());
        let bsdf = match node.kind.as_str() {
            "dielectric" | "roughdielectric" => Bsdf::Dielectric { ior, transmittance },
            _ => Bsdf::ThinDielectric {
                ior,
                transmittance,
                face: false,
            },
        };
        Ok(Material {
            rgb: tint.rgb,
            bsdf,
            ..Material::glass(named(node))
        })
    }

    /// Notes the objects whose glass encloses no volume.
    pub(super) fn note_thinned(&mut self, names: &[String]) {
        let Some(first) = names.first() else { return };
        let others = match names.len() {
            1 => String::new(),
            n => format!(" and {} others", n - 1),
        };
        self.note(
            "glass.open",
            format!(
                "{}{others}: the surface is not closed, so it is thin glass, without refraction; close it for a body",
                quoted(first)
            ),
        );
    }
}

pub(super) fn is_glass(node: &Node) -> bool {
    matches!(
        node.kind.as_str(),
        "dielectric" | "thindielectric" | "roughdielectric"
    )
}

/// Parses an index of refraction: a number, or one of Mitsuba's names.
fn index(node: &Node, name: &str, default: &str) -> Result<f64, String> {
    if let Ok(Some(number)) = node.number(name) {
        return match number.is_finite() && number > 0.0 {
            true => Ok(number),
            false => Err(node.fail(format!("{name}: {number} is no index of refraction"))),
        };
    }
    let medium = node.text(name)?.unwrap_or(default);
    let known = MEDIA.iter().find(|(known, _)| *known == medium);
    known.map(|(_, ior)| *ior).ok_or_else(|| {
        node.fail(format!(
            "{name}: {} is not known; use a number, or one of {}",
            quoted(medium),
            MEDIA.map(|m| m.0).join(", ")
        ))
    })
}
