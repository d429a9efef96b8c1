//! Mitsuba's colour parameters: numbers, spectra over wavelengths, bitmaps.
//!
//! A spectrum becomes a material's [`Material::spectrum`](crate::Material::spectrum) unchanged.
//! Beyond its ends, its last values continue (in Mitsuba, it is zero there). The material's `rgb`
//! is the spectrum at the three primaries (611, 549 and 464 nm), by the same rule, so a spectrum
//! outside the visible range is grey. The reflectance is the mean of these three values, as for
//! every other colour in Mitsuba's files. Renders without a wavelength therefore treat a spectrum
//! like the `<rgb>` of the same appearance.
//!
//! If only some parts of a blend have spectra, the others reflect their means at every wavelength.

use std::{path::Path, sync::Arc};

use crate::{
    SpectrumPoint, Texture, Wrap,
    import::{image, quoted, read_file},
    spectrum::{PRIMARIES_NM, check_points, interpolated},
    texture::srgb_byte,
};

use super::{
    Reader,
    node::{Node, Value},
    properties,
    transform::Matrix,
};

/// A colour, by wavelength if the file gives a spectrum; or white with a texture.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Colour {
    pub(super) rgb: [f32; 3],
    /// The spectrum; empty if the file contains only numbers.
    pub(super) spectrum: Vec<SpectrumPoint>,
    pub(super) texture: Option<(Arc<Texture>, Matrix)>,
}

impl Colour {
    pub(super) fn grey(level: f32) -> Self {
        Self {
            rgb: [level; 3],
            spectrum: vec![],
            texture: None,
        }
    }

    pub(super) fn mean(&self) -> f32 {
        (self.rgb[0] + self.rgb[1] + self.rgb[2]) / 3.0
    }

    /// Returns a spectrum with its colour.
    fn by_wavelength(spectrum: Vec<SpectrumPoint>) -> Self {
        let [blue, green, red] = PRIMARIES_NM.map(|nm| reflectance(&spectrum, nm).unwrap_or(0.0));
        Self {
            rgb: [red, green, blue],
            spectrum,
            texture: None,
        }
    }

    /// Returns the reflectance at a wavelength; without a spectrum, the mean.
    fn at(&self, nm: f32) -> f32 {
        reflectance(&self.spectrum, nm).unwrap_or(self.mean())
    }
}

fn reflectance(spectrum: &[SpectrumPoint], nm: f32) -> Option<f32> {
    interpolated(spectrum, nm, |p| [p.reflectance]).map(|[r]| r)
}

/// Returns the mean of colours without textures weighted by their shares, at the wavelengths of
/// all.
pub(super) fn mean_of(all: &[(f64, &Colour)]) -> Colour {
    let sum: f64 = all.iter().map(|(share, _)| share).sum();
    let mean = |of: &dyn Fn(&Colour) -> f32| {
        let weighted = all.iter().map(|(share, c)| share * f64::from(of(c)));
        (weighted.sum::<f64>() / sum) as f32
    };
    let nms = wavelengths(all.iter().map(|(_, c)| *c));
    let row = |nm: f32| SpectrumPoint {
        nm,
        reflectance: mean(&|c| c.at(nm)),
        specular_reflectance: None,
    };
    Colour {
        rgb: std::array::from_fn(|k| mean(&|c| c.rgb[k])),
        spectrum: nms.into_iter().map(row).collect(),
        texture: None,
    }
}

/// Returns the wavelengths of all colours' spectra, ascending.
fn wavelengths<'a>(colours: impl Iterator<Item = &'a Colour>) -> Vec<f32> {
    let mut all: Vec<f32> = colours.flat_map(|c| &c.spectrum).map(|p| p.nm).collect();
    all.sort_by(f32::total_cmp);
    all.dedup();
    all
}

/// Returns the spectrum of a material from those of its parts; for a mix, at the wavelengths of
/// both.
pub(super) fn spectrum_of(
    diffuse: Option<&Colour>,
    conductor: Option<&Colour>,
) -> Vec<SpectrumPoint> {
    let (diffuse, conductor) = match (diffuse, conductor) {
        (Some(diffuse), Some(conductor)) => (diffuse, conductor),
        (one, other) => {
            let part = one.or(other);
            return part.map_or(vec![], |c| c.spectrum.clone());
        }
    };
    let all = wavelengths([diffuse, conductor].into_iter());
    let row = |nm| SpectrumPoint {
        nm,
        reflectance: diffuse.at(nm),
        specular_reflectance: reflectance(&conductor.spectrum, nm),
    };
    all.into_iter().map(row).collect()
}

impl Reader<'_> {
    /// Reads a colour parameter: numbers, a spectrum, or a bitmap.
    pub(super) fn colour(&mut self, node: &Node, name: &str) -> Result<Option<Colour>, String> {
        let rgb = match node.parameters.get(name) {
            Some(Value::Colour(rgb)) => Some(*rgb),
            Some(Value::Number(x)) => Some([*x as f32; 3]),
            Some(Value::Vector(v)) => Some(v.map(|x| x as f32)),
            Some(Value::Spectrum(spectrum)) => {
                let checked = check_points(spectrum, None);
                checked.map_err(|what| node.fail(format!("{name}: {what}")))?;
                return Ok(Some(Colour::by_wavelength(spectrum.clone())));
            }
            Some(_) => return Err(node.fail(format!("{name}: expected a colour"))),
            None => None,
        };
        if let Some(rgb) = rgb {
            return Ok(Some(Colour {
                rgb,
                ..Colour::grey(1.0)
            }));
        }
        match self.children_named(node, name)?.as_slice() {
            [] => Ok(None),
            [texture] if texture.kind == "checkerboard" => {
                self.only(texture, &properties::CHECKERBOARD)?;
                self.note(
                    "textures.checkerboard",
                    "replaced by the mean of both colours",
                );
                let one = self.colour(texture, "color0")?.unwrap_or(Colour::grey(0.4));
                let other = self.colour(texture, "color1")?.unwrap_or(Colour::grey(0.2));
                match (&one.texture, &other.texture) {
                    (None, None) => Ok(Some(mean_of(&[(0.5, &one), (0.5, &other)]))),
                    _ => Err(texture.fail("color0 and color1: expected colours, no textures")),
                }
            }
            [texture] if texture.kind == "mesh_attribute" => {
                self.note(
                    "textures.mesh_attribute",
                    "left out; a reflectance of 0.5 used",
                );
                Ok(Some(Colour::grey(0.5)))
            }
            [texture] => {
                let texture = self.bitmap(&texture.clone())?;
                Ok(Some(Colour {
                    texture: Some(texture),
                    ..Colour::grey(1.0)
                }))
            }
            _ => Err(node.fail(format!("{name}: stated twice"))),
        }
    }

    fn bitmap(&mut self, node: &Node) -> Result<(Arc<Texture>, Matrix), String> {
        if node.kind != "bitmap" {
            return Err(node.fail(format!(
                "texture {} is not supported; use bitmap or checkerboard",
                quoted(&node.kind)
            )));
        }
        self.only(node, &properties::BITMAP)?;
        let filename = node
            .text("filename")?
            .ok_or_else(|| node.fail("needs a filename"))?;
        let wrap = match node.text("wrap_mode")?.unwrap_or("repeat") {
            "repeat" => Wrap::Repeat,
            "mirror" => Wrap::Mirror,
            "clamp" => Wrap::Clamp,
            other => {
                return Err(node.fail(format!(
                    "wrap_mode: {}; use repeat, mirror or clamp",
                    quoted(other)
                )));
            }
        };
        match node.text("filter_type")?.unwrap_or("bilinear") {
            "bilinear" => {}
            other @ ("nearest" | "trilinear" | "ewa") => {
                self.note("textures.filter", format!("{other}; bilinear used"));
            }
            other => {
                let what = format!("filter_type: {}; use bilinear or nearest", quoted(other));
                return Err(node.fail(what));
            }
        }
        let file = self.named(node, filename)?;
        let stem = file.file_stem().unwrap_or_default().to_string_lossy();
        let raw = node.switch("raw")?.unwrap_or(false);
        let texture = self.image(node, &file, &stem, wrap, raw)?;
        Ok((texture, node.transform("to_uv")?))
    }

    pub(super) fn image(
        &mut self,
        node: &Node,
        file: &Path,
        name: &str,
        wrap: Wrap,
        raw: bool,
    ) -> Result<Arc<Texture>, String> {
        let files = self.files;
        let decode = || {
            let bytes = read_file(files, file).map_err(|e| e.to_string())?;
            let texture = image::decode(name, &bytes, wrap)?;
            if !raw {
                return Ok(texture);
            }
            // `raw` texels are already linear; ours are sRGB-encoded.
            let encoded = |t: &[u8; 3]| t.map(|c| srgb_byte(f32::from(c) / 255.0));
            let texels = texture.texels().iter().map(encoded).collect();
            Texture::new(name, texture.width(), texture.height(), texels, wrap)
        };
        self.images
            .get((file.to_path_buf(), wrap, raw), decode)
            .map_err(|e| node.fail(e))
    }
}
