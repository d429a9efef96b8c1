//! The materials of a glTF file: they become Lambertian, conductor, mix and albedo texture, with a
//! note on every other feature.

use std::{borrow::Cow, path::Path};

use gltf::{image::Source, material::AlphaMode, texture::WrappingMode};

use crate::{
    Bsdf, Distribution, Material, SceneError, SpectrumPoint, Texture, Wrap,
    extras::{MaterialExtras, StatedSpectrum, metallic_roughness},
    import::{
        add_note,
        buffers::{Buffers, buffer_file, data_uri},
        format_error, image, read_file,
    },
};

use super::{Walk, keyed, under};

/// The tolerance within which standard parameters count as unchanged from our export, so that our
/// extras apply.
const SAME_FACTOR: f32 = 1e-3;
/// Metalness within this distance of 0 or 1 counts as 0 or 1.
const PURE: f32 = 0.01;
/// The format of a spectrum in extras.
const SPECTRUM: &str = r#"[{"nm": 905, "reflectance": 0.7}, …], by ascending nm"#;
/// Extensions that are used, or noted by name below.
const KNOWN: [&str; 17] = [
    "KHR_node_visibility",
    "EXT_mesh_gpu_instancing",
    "KHR_texture_transform",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_volume",
    "KHR_lights_punctual",
    "KHR_mesh_quantization",
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
    "EXT_texture_webp",
    "KHR_texture_basisu",
];

/// The texture coordinates that a material uses, and their transform: (offset, rotation, scale).
pub(super) struct Coordinates {
    pub(super) set: u32,
    pub(super) transform: Option<([f32; 2], f32, [f32; 2])>,
}

/// A material's parameters, independent of the form in which the file gives them.
pub(super) struct Standard<'a> {
    pub(super) rgb: [f32; 3],
    pub(super) bsdf: Bsdf,
    pub(super) texture: Option<gltf::texture::Info<'a>>,
}

impl Walk<'_> {
    pub(super) fn note(&mut self, key: &str, what: impl Into<String>) {
        add_note(&mut self.notes, key, what.into());
    }

    /// Adds notes on parts of a document that our scenes cannot represent.
    pub(super) fn dropped_parts(&mut self) {
        let document = self.document;
        if self.facts.animated {
            self.note("animation", "ignored; nodes and meshes are at rest");
        }
        if self.facts.sceneless {
            self.note("scenes", "the file has none; all its nodes are read");
        }
        if self.facts.contained {
            self.note(
                "scenes.nodes",
                "nodes that other nodes contain are read there alone",
            );
        }
        if self.facts.placeless {
            self.note("primitives", "without positions left out");
        }
        if document.lights().is_some_and(|l| l.len() > 0) {
            self.note("lights", "ignored; only the laser shines");
        }
        let unknown: Vec<&str> = document
            .extensions_used()
            .filter(|e| !KNOWN.contains(e))
            .collect();
        if !unknown.is_empty() {
            self.note("extensions", format!("ignored: {}", unknown.join(", ")));
        }
    }

    /// Returns the texture coordinates that a material's albedo texture uses.
    pub(super) fn coordinates(&mut self, file: &gltf::Material<'_>) -> Coordinates {
        let Some(info) = albedo_texture(file) else {
            return Coordinates {
                set: 0,
                transform: None,
            };
        };
        let transform = info.texture_transform();
        Coordinates {
            set: transform
                .as_ref()
                .and_then(gltf::texture::TextureTransform::tex_coord)
                .unwrap_or(info.tex_coord()),
            transform: transform.map(|t| (t.offset(), t.rotation(), t.scale())),
        }
    }

    /// Converts a material. `has_uv` is true if the mesh has the material's texture coordinates;
    /// `tint` is the colour of its vertices.
    pub(super) fn material(
        &mut self,
        file: &gltf::Material<'_>,
        has_uv: bool,
        tint: [f32; 3],
    ) -> Result<Material, SceneError> {
        let at = format!("materials[{}]", file.index().unwrap_or(0));
        self.dropped_features(file);
        let standard = match file.pbr_specular_glossiness() {
            Some(pbr) => self.specular_glossiness(&pbr, &at, tint)?,
            None if file.unlit() => unlit(file, tint),
            None => self.metallic_roughness(file, &at, tint)?,
        };
        let mut material =
            Material::diffuse(file.name().unwrap_or("material").to_owned(), standard.rgb);
        material.bsdf = standard.bsdf;
        let exact = self.exact(file, &at, &material)?;
        if let Some(ours) = exact {
            (material.bsdf, material.two_sided) = (ours.bsdf, ours.two_sided);
            material.spectrum = ours.spectrum;
        } else if let Some((tint, bsdf)) = self.glass(file, standard.rgb, &material) {
            (material.rgb, material.bsdf) = (tint, bsdf);
        } else if file.ior().is_some() || file.specular().is_some() {
            self.note(
                "coats",
                "KHR_materials_ior and _specular: opaque dielectrics are Lambertian",
            );
        }
        let mut extras = format!("{at}.extras");
        match self.stated_spectrum(file, &extras)? {
            Some(spectrum) => material.spectrum = spectrum,
            None => extras += ".picofarm",
        }
        material
            .check_spectrum()
            .map_err(|what| format_error(self.path, format!("{extras}.{what}")))?;
        match standard.texture {
            Some(_) if material.transmits() => self.note("glass.textures", "left out"),
            Some(info) if self.is_sourceless(&info.texture()) => {
                self.note("textures.source", "left out: textures without a source");
            }
            Some(info) if has_uv => {
                material.texture = Some(self.texture(&info.texture(), &at)?);
            }
            Some(_) => self.note(
                "textures",
                "left out where a mesh has no texture coordinates",
            ),
            None => {}
        }
        Ok(material)
    }

    /// Returns whether a texture has no image at all. A texture with an image in an unsupported
    /// format has one.
    pub(super) fn is_sourceless(&self, texture: &gltf::Texture<'_>) -> bool {
        self.facts.sourceless.contains(&texture.index())
            && texture.extensions().is_none_or(|all| all.is_empty())
    }

    /// Returns the spectrum that any program may define in a material's extras; unchecked.
    fn stated_spectrum(
        &self,
        file: &gltf::Material<'_>,
        extras: &str,
    ) -> Result<Option<Vec<SpectrumPoint>>, SceneError> {
        let raw = file.extras().as_deref().map(|r| r.get());
        let fail = |e| {
            let what = format!("{extras}.spectrum: {e}; expected {SPECTRUM}");
            format_error(self.path, what)
        };
        let stated: Option<StatedSpectrum> = under(self.path, extras, raw, "spectrum")
            .and_then(|raw| raw.map(serde_json::from_str).transpose().map_err(fail))?;
        Ok(stated.map(|s| s.spectrum))
    }

    /// Returns the material in our own extras if its standard factors are unchanged from our
    /// export.
    fn exact(
        &mut self,
        file: &gltf::Material<'_>,
        at: &str,
        standard: &Material,
    ) -> Result<Option<MaterialExtras>, SceneError> {
        let pbr = file.pbr_metallic_roughness();
        let extras = format!("{at}.extras.picofarm");
        let ours: Option<MaterialExtras> = keyed(
            self.path,
            &extras,
            file.extras().as_deref().map(|r| r.get()),
        )?;
        let Some(ours) = ours else { return Ok(None) };
        // If the file was edited in another program, the standard factors have changed and take
        // precedence.
        let (metallic, roughness) = metallic_roughness(&Material {
            bsdf: ours.bsdf,
            ..standard.clone()
        });
        let same = (metallic - pbr.metallic_factor()).abs() < SAME_FACTOR
            && (roughness - pbr.roughness_factor()).abs() < SAME_FACTOR;
        if !same {
            self.note("materials", "edited since export; standard factors used");
            if !ours.spectrum.is_empty() {
                self.note(
                    "spectra.edited",
                    "left out of materials edited since export",
                );
            }
        }
        Ok(same.then_some(ours))
    }

    /// Returns a material's transmitted light and its BSDF if at least half of the light passes: by
    /// KHR_materials_transmission, or by an opacity below one half.
    fn glass(
        &mut self,
        file: &gltf::Material<'_>,
        [r, g, b]: [f32; 3],
        opaque: &Material,
    ) -> Option<([f32; 3], Bsdf)> {
        let unit = |x: f32| x.clamp(0.0, 1.0);
        let solid = file.volume().filter(|v| v.thickness_factor() > 0.0);
        let [.., opacity] = match file.pbr_specular_glossiness() {
            Some(pbr) => pbr.diffuse_factor(),
            None => file.pbr_metallic_roughness().base_color_factor(),
        };
        let passes = file
            .transmission()
            .map_or(0.0, |t| unit(t.transmission_factor()));
        let metal = matches!(opaque.bsdf, Bsdf::RoughConductor { .. });
        let by_opacity = || match file.alpha_mode() {
            AlphaMode::Blend => Material::by_opacity(opacity, file.ior(), solid.is_some()),
            _ => None,
        };
        let (tint, bsdf) = if passes >= Material::LEAST_GLASS && !metal {
            // The absorption along the path through the glass.
            let absorbed = |k: usize| match &solid {
                Some(v) if v.attenuation_distance().is_finite() => libm::powf(
                    unit(v.attenuation_color()[k]),
                    v.thickness_factor() / v.attenuation_distance().max(1e-9),
                ),
                _ => 1.0,
            };
            let base = [r, g, b];
            let tint: [f32; 3] = std::array::from_fn(|k| unit(passes * base[k] * absorbed(k)));
            let bsdf = Bsdf::ThinDielectric {
                ior: file
                    .ior()
                    .unwrap_or(Material::IOR)
                    .clamp(1.0, Material::MAX_IOR),
                transmittance: (tint[0] + tint[1] + tint[2]) / 3.0,
                face: solid.is_some(),
            };
            (tint, bsdf)
        } else if let Some(bsdf) = by_opacity() {
            ([unit(1.0 - opacity); 3], bsdf)
        } else {
            if passes > 0.0 {
                self.note("transmission", "of less than one half: ignored, opaque");
            }
            let mask = self.strict && file.alpha_mode() == AlphaMode::Mask;
            if file.alpha_mode() != AlphaMode::Opaque && !mask {
                self.note("transparency", "ignored; such materials are opaque");
            }
            return None;
        };
        self.note(
            "glass",
            "thin: light goes straight on or is reflected, what rough glass scatters is left out",
        );
        Some((tint, bsdf))
    }

    fn metallic_roughness<'f>(
        &mut self,
        file: &gltf::Material<'f>,
        at: &str,
        tint: [f32; 3],
    ) -> Result<Standard<'f>, SceneError> {
        let pbr = file.pbr_metallic_roughness();
        let [r, g, b] = tinted(pbr.base_color_factor(), tint);
        let (mut metallic, mut roughness) = (pbr.metallic_factor(), pbr.roughness_factor());
        if let Some(info) = pbr.metallic_roughness_texture() {
            match self.texture(&info.texture(), at) {
                Ok(texture) => {
                    let texels = texture.texels();
                    let mean = |channel: usize| {
                        let sum: f64 = texels.iter().map(|t| f64::from(t[channel])).sum();
                        (sum / texels.len() as f64 / 255.0) as f32
                    };
                    (roughness, metallic) = (roughness * mean(1), metallic * mean(2));
                    self.note(
                        "metallic_roughness_textures",
                        "replaced by their means over the image",
                    );
                }
                // Only the mean of such a texture would be used.
                Err(SceneError::Format { what, .. }) => self.note(
                    "metallic_roughness_textures.unread",
                    format!("left out, factors used: {what}"),
                ),
                Err(other) => return Err(other),
            }
        }
        let mean = (r + g + b) / 3.0;
        // glTF's own BRDF is GGX with α = roughness².
        let alpha = (roughness * roughness).max(Material::MIN_ALPHA);
        let bsdf = mixed(metallic, alpha, mean, mean);
        Ok(Standard {
            rgb: [r, g, b],
            bsdf,
            texture: pbr.base_color_texture(),
        })
    }

    /// Adds notes on features of a material that our model cannot represent.
    fn dropped_features(&mut self, file: &gltf::Material<'_>) {
        if file.emissive_factor() != [0.0; 3] || file.emissive_strength().is_some() {
            self.note("emission", "ignored; only the laser shines");
        }
        if file.normal_texture().is_some() || file.occlusion_texture().is_some() {
            self.note("normal_and_occlusion_textures", "ignored");
        }
        if file.unlit() {
            self.note(
                "unlit",
                "such materials are Lambertian with their base colour",
            );
        }
        let others: Vec<&String> = file
            .extensions()
            .into_iter()
            .flat_map(|e| e.keys())
            .collect();
        for name in others {
            if !KNOWN.contains(&name.as_str()) {
                self.note(&format!("materials.{name}"), "ignored");
            }
        }
    }

    pub(super) fn texture(
        &mut self,
        file: &gltf::Texture<'_>,
        at: &str,
    ) -> Result<std::sync::Arc<Texture>, SceneError> {
        let sampler = file.sampler();
        if sampler.wrap_s() != sampler.wrap_t() {
            self.note("textures.wrap", "wrapT differs from wrapS, which is used");
        }
        if sampler.mag_filter() == Some(gltf::texture::MagFilter::Nearest) {
            self.note("textures.filter", "nearest; bilinear used");
        }
        let wrap = wrap(file);
        let (bytes, name) = self.image_bytes(file, at)?;
        let (path, image) = (self.path, file.source().index());
        self.images
            .get((image, wrap), || image::decode(&name, &bytes, wrap))
            .map_err(|what| format_error(path, format!("{at}: images[{image}]: {what}")))
    }
}

impl<'a> Walk<'a> {
    /// Returns the bytes of a texture's image, and its name.
    pub(super) fn image_bytes(
        &self,
        file: &gltf::Texture<'_>,
        at: &str,
    ) -> Result<(Cow<'a, [u8]>, String), SceneError> {
        let at = format!("{at}: textures[{}]", file.index());
        if self.facts.sourceless.contains(&file.index()) {
            let names = file.extensions().into_iter().flat_map(|all| all.keys());
            let names: Vec<&str> = names.map(String::as_str).collect();
            let what = match names.is_empty() {
                true => "has no source; state an image".to_owned(),
                false => format!(
                    "has an image by {} alone, which is not supported; export it as PNG or JPEG",
                    names.join(", ")
                ),
            };
            return Err(format_error(self.path, format!("{at}: {what}")));
        }
        let image = file.source();
        let at = format!("{at}: images[{}]", image.index());
        let fail = |what: String| format_error(self.path, format!("{at}: {what}"));
        if self.facts.damaged_images.contains(&image.index()) {
            return Err(fail(
                "needs a uri, or a bufferView with mimeType; export the file again".into(),
            ));
        }
        let external = match image.source() {
            Source::Uri { uri, .. } => buffer_file(self.path, uri)?,
            Source::View { .. } => None,
        };
        let buffers: &'a Buffers = self.buffers;
        let bytes: Cow<'a, [u8]> = match (&external, image.source()) {
            (Some(file), _) => read_file(self.files, file)?.into(),
            (None, Source::View { view, .. }) => buffers.view(&view).map_err(fail)?.into(),
            (None, Source::Uri { uri, .. }) => data_uri(uri)
                .map_err(|why| fail(format!("data URI cannot be read ({why})")))?
                .into(),
        };
        let stem = external.as_deref().and_then(Path::file_stem);
        let name = match (image.name(), stem) {
            (Some(name), _) => name.to_owned(),
            (None, Some(stem)) => stem.to_string_lossy().into_owned(),
            (None, None) => format!("image{}", image.index()),
        };
        Ok((bytes, name))
    }
}

/// Returns the parameters of a material without shading: its colour is taken for a reflectance.
fn unlit<'f>(file: &gltf::Material<'f>, tint: [f32; 3]) -> Standard<'f> {
    let pbr = file.pbr_metallic_roughness();
    let [r, g, b] = tinted(pbr.base_color_factor(), tint);
    Standard {
        rgb: [r, g, b],
        bsdf: mixed(0.0, 1.0, (r + g + b) / 3.0, 0.0),
        texture: pbr.base_color_texture(),
    }
}

/// Returns a factor times the colour of vertices. Factors that rounding has put just above 1 are 1.
pub(super) fn tinted([r, g, b, _]: [f32; 4], tint: [f32; 3]) -> [f32; 3] {
    let rounded = |x: f32| {
        if (1.0..1.0 + 1e-5).contains(&x) {
            1.0
        } else {
            x
        }
    };
    [r * tint[0], g * tint[1], b * tint[2]].map(rounded)
}

/// Returns how a texture continues beyond its image, along u.
pub(super) fn wrap(file: &gltf::Texture<'_>) -> Wrap {
    match file.sampler().wrap_s() {
        WrappingMode::ClampToEdge => Wrap::Clamp,
        WrappingMode::MirroredRepeat => Wrap::Mirror,
        WrappingMode::Repeat => Wrap::Repeat,
    }
}

pub(super) fn albedo_texture<'a>(file: &gltf::Material<'a>) -> Option<gltf::texture::Info<'a>> {
    match file.pbr_specular_glossiness() {
        Some(pbr) => pbr.diffuse_texture(),
        None => file.pbr_metallic_roughness().base_color_texture(),
    }
}

/// Returns a GGX mix, or a pure material near either end.
pub(super) fn mixed(weight: f32, alpha: f32, reflectance: f32, specular_reflectance: f32) -> Bsdf {
    let distribution = Distribution::Ggx;
    if weight < PURE {
        Bsdf::Diffuse { reflectance }
    } else if weight > 1.0 - PURE {
        Bsdf::RoughConductor {
            alpha,
            distribution,
            reflectance: specular_reflectance,
        }
    } else {
        Bsdf::Mixed {
            reflectance,
            alpha,
            distribution,
            specular_reflectance,
            weight,
        }
    }
}
