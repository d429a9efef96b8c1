//! Materials by `KHR_materials_pbrSpecularGlossiness`. The texture of specular colour and
//! glossiness counts by its means.

use gltf::material::PbrSpecularGlossiness;

use crate::{Material, SceneError, import::image};

use super::{
    Walk,
    material::{Standard, mixed, tinted},
};

/// Specular factors up to this belong to the coat of an ordinary dielectric.
const DIELECTRIC: f32 = 0.08;

impl Walk<'_> {
    pub(super) fn specular_glossiness<'f>(
        &mut self,
        pbr: &PbrSpecularGlossiness<'f>,
        at: &str,
        tint: [f32; 3],
    ) -> Result<Standard<'f>, SceneError> {
        let [r, g, b] = tinted(pbr.diffuse_factor(), tint);
        let (specular, glossiness) = self.gloss(pbr, at)?;
        let most = specular.iter().fold(0.0f32, |a, &b| a.max(b)).min(1.0);
        if most <= DIELECTRIC {
            return Ok(Standard {
                rgb: [r, g, b],
                bsdf: mixed(0.0, 1.0, (r + g + b) / 3.0, 0.0),
                texture: pbr.diffuse_texture(),
            });
        }
        if pbr.diffuse_texture().is_some() {
            self.note(
                "specular_glossiness",
                "diffuse textures scale the specular part too",
            );
        }
        let rough = 1.0 - glossiness;
        let alpha = (rough * rough).max(Material::MIN_ALPHA);
        let share = specular.iter().sum::<f32>() / 3.0 / most;
        let mix = |diffuse: f32, specular: f32| (1.0 - most) * diffuse + specular;
        Ok(Standard {
            rgb: [
                mix(r, specular[0]),
                mix(g, specular[1]),
                mix(b, specular[2]),
            ],
            bsdf: mixed(most, alpha, (r + g + b) / 3.0, share),
            texture: pbr.diffuse_texture(),
        })
    }

    /// Returns the specular colour and the glossiness: factors times the means of their texture.
    fn gloss(
        &mut self,
        pbr: &PbrSpecularGlossiness<'_>,
        at: &str,
    ) -> Result<([f32; 3], f32), SceneError> {
        let (factor, glossiness) = (pbr.specular_factor(), pbr.glossiness_factor());
        let texture = pbr.specular_glossiness_texture().map(|info| info.texture());
        let Some(texture) = texture.filter(|t| !self.is_sourceless(t)) else {
            return Ok((factor, glossiness));
        };
        let read = self.texture(&texture, at).and_then(|colour| {
            let (bytes, _) = self.image_bytes(&texture, at)?;
            let alpha = image::alpha(&bytes)
                .map_err(|what| crate::import::format_error(self.path, what))?;
            Ok((
                colour.mean(),
                alpha.map_or(1.0, |(_, texels)| mean(&texels)),
            ))
        });
        match read {
            Ok((colour, gloss)) => {
                self.note(
                    "specular_glossiness_textures",
                    "replaced by their means over the image",
                );
                let specular = std::array::from_fn(|k| factor[k] * colour[k]);
                Ok((specular, glossiness * gloss))
            }
            // Only the means of such a texture would be used.
            Err(SceneError::Format { what, .. }) => {
                self.note(
                    "specular_glossiness_textures.unread",
                    format!("left out, factors used: {what}"),
                );
                Ok((factor, glossiness))
            }
            Err(other) => Err(other),
        }
    }
}

/// Returns the mean of bytes as a share of 255.
fn mean(bytes: &[u8]) -> f32 {
    let sum: u64 = bytes.iter().map(|b| u64::from(*b)).sum();
    (sum as f64 / bytes.len().max(1) as f64 / 255.0) as f32
}
