//! The elements of a Mitsuba scene as text, and the extras stored with them. The importer compares
//! its input with these texts to detect edits.

use std::{collections::BTreeMap, fmt::Write as _, sync::Arc};

use serde::{Deserialize, Serialize};

use crate::{
    Affine, Beam, Bsdf, Camera, Distribution, Material, SpectrumPoint, Texture, Vec3, Wrap,
    extras::SceneExtras,
    texture::{linear, srgb_byte},
};

/// The data that Mitsuba cannot represent.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Extras {
    pub(crate) scene: SceneExtras,
    pub(crate) objects: Vec<ObjectExtras>,
    /// The extras of materials, by id of the BSDF.
    pub(crate) materials: BTreeMap<String, MaterialExtras>,
}

#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct ObjectExtras {
    pub(crate) name: String,
    pub(crate) label: String,
    pub(crate) mesh: String,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct MaterialExtras {
    pub(crate) name: String,
    pub(crate) bsdf: Bsdf,
    pub(crate) rgb: [f32; 3],
    pub(crate) two_sided: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) texture: Option<TextureExtras>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) spectrum: Vec<SpectrumPoint>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct TextureExtras {
    /// The path, relative to the scene file.
    pub(crate) file: String,
    pub(crate) name: String,
    pub(crate) wrap: Wrap,
}

/// A BSDF's element, and the images required for it.
pub(crate) struct BsdfText {
    pub(crate) text: String,
    /// The images: (file, texture multiplied by the material's colour).
    pub(crate) images: Vec<(String, Texture)>,
    /// Whether a colour would exceed 1 and was clamped.
    pub(crate) clamped: bool,
    /// Whether the material is glass with a thickness given by the mesh. In Mitsuba, each of its
    /// surfaces is a whole pane.
    pub(crate) whole: bool,
}

/// Returns the `<bsdf>` of a material. Colours are `rgb`, scaled so that their mean is the laser's
/// reflectance. If there is a texture, a copy of it is multiplied by them.
pub(crate) fn bsdf_text(
    id: &str,
    material: &Material,
    texture: Option<&TextureExtras>,
) -> BsdfText {
    let mut out = BsdfText {
        text: String::new(),
        images: Vec::new(),
        clamped: false,
        whole: false,
    };
    let glass = match material.bsdf {
        Bsdf::ThinDielectric {
            ior,
            transmittance,
            face,
        } => Some(("thindielectric", ior, transmittance, face)),
        Bsdf::Dielectric { ior, transmittance } => Some(("dielectric", ior, transmittance, false)),
        _ => None,
    };
    if let Some((kind, ior, transmittance, face)) = glass {
        let tint = colour(
            &mut out,
            "specular_transmittance",
            "",
            material,
            None,
            transmittance,
        );
        out.text = format!(
            "<bsdf type=\"{kind}\"{}><float name=\"int_ior\" value=\"{ior}\"/><float name=\"ext_ior\" value=\"1\"/>{tint}</bsdf>",
            id_attribute(id)
        );
        out.whole = face;
        return out;
    }
    let outer = if material.two_sided { "" } else { id };
    let image = format!("{id}-reflectance");
    let metal_image = format!("{id}-specular_reflectance");
    let body = match material.bsdf {
        Bsdf::Diffuse { reflectance } => {
            diffuse(&mut out, outer, &image, material, texture, reflectance)
        }
        Bsdf::RoughConductor {
            alpha,
            distribution,
            reflectance,
        } => conductor(
            &mut out,
            outer,
            &metal_image,
            material,
            texture,
            (alpha, distribution, reflectance),
        ),
        Bsdf::Mixed {
            reflectance,
            alpha,
            distribution,
            specular_reflectance,
            weight,
        } => {
            let a = diffuse(&mut out, "", &image, material, texture, reflectance);
            let specular = (alpha, distribution, specular_reflectance);
            let b = conductor(&mut out, "", &metal_image, material, texture, specular);
            format!(
                "<bsdf type=\"blendbsdf\"{}><float name=\"weight\" value=\"{weight}\"/>{a}{b}</bsdf>",
                id_attribute(outer)
            )
        }
        Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => {
            unreachable!("glass was written above")
        }
    };
    out.text = if material.two_sided {
        format!("<bsdf type=\"twosided\"{}>{body}</bsdf>", id_attribute(id))
    } else {
        body
    };
    out
}

fn id_attribute(id: &str) -> String {
    if id.is_empty() {
        String::new()
    } else {
        format!(" id=\"{id}\"")
    }
}

fn diffuse(
    out: &mut BsdfText,
    own_id: &str,
    image: &str,
    material: &Material,
    texture: Option<&TextureExtras>,
    reflectance: f32,
) -> String {
    let colour = colour(out, "reflectance", image, material, texture, reflectance);
    format!(
        "<bsdf type=\"diffuse\"{}>{colour}</bsdf>",
        id_attribute(own_id)
    )
}

fn conductor(
    out: &mut BsdfText,
    own_id: &str,
    image: &str,
    material: &Material,
    texture: Option<&TextureExtras>,
    (alpha, distribution, reflectance): (f32, Distribution, f32),
) -> String {
    let colour = colour(
        out,
        "specular_reflectance",
        image,
        material,
        texture,
        reflectance,
    );
    let name = match distribution {
        Distribution::Beckmann => "beckmann",
        Distribution::Ggx => "ggx",
    };
    format!(
        "<bsdf type=\"roughconductor\"{}><string name=\"material\" value=\"none\"/>\
         <string name=\"distribution\" value=\"{name}\"/><float name=\"alpha\" value=\"{alpha}\"/>{colour}</bsdf>",
        id_attribute(own_id)
    )
}

/// Writes a colour parameter with the mean `reflectance`. If it scales a texture, `image` is the
/// name of its file.
fn colour(
    out: &mut BsdfText,
    name: &str,
    image: &str,
    material: &Material,
    texture: Option<&TextureExtras>,
    reflectance: f32,
) -> String {
    let rgb = material.rgb;
    let mean = (rgb[0] + rgb[1] + rgb[2]) / 3.0;
    let scaled = if (mean - reflectance).abs() < 1e-6 {
        rgb
    } else if mean > 0.0 {
        rgb.map(|c| c * (reflectance / mean))
    } else {
        [reflectance; 3]
    };
    let [r, g, b] = scaled.map(|c| c.min(1.0));
    out.clamped |= scaled.iter().any(|&c| c > 1.0);
    let (Some(known), Some(texture)) = (texture, &material.texture) else {
        return format!("<rgb name=\"{name}\" value=\"{r} {g} {b}\"/>");
    };
    let mut file = known.file.clone();
    if [r, g, b] != [1.0; 3] {
        file = format!("textures/{image}.png");
        if out.images.iter().all(|known| known.0 != file) {
            out.images.push((file.clone(), tinted(texture, [r, g, b])));
        }
    }
    let wrap = match texture.wrap() {
        Wrap::Repeat => "repeat",
        Wrap::Mirror => "mirror",
        Wrap::Clamp => "clamp",
    };
    format!(
        "<texture type=\"bitmap\" name=\"{name}\"><string name=\"filename\" value=\"{file}\"/>\
         <string name=\"wrap_mode\" value=\"{wrap}\"/></texture>"
    )
}

fn tinted(texture: &Arc<Texture>, tint: [f32; 3]) -> Texture {
    let tables: [Vec<u8>; 3] = tint.map(|t| (0..=255).map(|b| srgb_byte(linear(b) * t)).collect());
    let texel = |t: &[u8; 3]| std::array::from_fn(|k| tables[k][usize::from(t[k])]);
    let texels = texture.texels().iter().map(texel).collect();
    let (width, height) = (texture.width(), texture.height());
    Texture::new(texture.name(), width, height, texels, texture.wrap())
        .expect("the size of a texture that exists")
}

/// Returns the `<sensor>` of a camera.
pub(crate) fn sensor_text(camera: &Camera) -> String {
    let i = &camera.intrinsics;
    let fov = 2.0 * libm::atan(f64::from(i.width) * 0.5 / f64::from(i.fx)).to_degrees();
    let mut offsets = String::new();
    for (axis, c, size) in [("x", i.cx, i.width), ("y", i.cy, i.height)] {
        let offset = 0.5 - f64::from(c) / f64::from(size);
        if offset != 0.0 {
            write!(
                offsets,
                "<float name=\"principal_point_offset_{axis}\" value=\"{offset}\"/>"
            )
            .expect("strings take every text");
        }
    }
    format!(
        "<sensor type=\"perspective\"><float name=\"fov\" value=\"{fov}\"/><string name=\"fov_axis\" value=\"x\"/>{offsets}\
         <transform name=\"to_world\"><matrix value=\"{}\"/></transform>\
         <film type=\"hdrfilm\"><integer name=\"width\" value=\"{}\"/><integer name=\"height\" value=\"{}\"/>\
         <string name=\"pixel_format\" value=\"rgb\"/><rfilter type=\"box\"/></film></sensor>",
        matrix_text(&pose(
            -camera.right,
            -camera.down,
            camera.forward,
            camera.origin
        )),
        i.width,
        i.height
    )
}

/// Returns the `<emitter>` of beam `k`.
pub(crate) fn beam_text(k: usize, origin: Vec3, beam: &Beam) -> String {
    let d = beam.direction;
    // Any frame around the beam is valid (Duff et al., JCGT 2017).
    let sign = 1.0f32.copysign(d.z);
    let a = -1.0 / (sign + d.z);
    let b = d.x * d.y * a;
    let x = Vec3::new(1.0 + sign * d.x * d.x * a, sign * b, -sign * d.x);
    let y = Vec3::new(b, sign + d.y * d.y * a, -d.y);
    format!(
        "<emitter type=\"projector\" id=\"beam{k}\"><rgb name=\"irradiance\" value=\"1\"/>\
         <float name=\"fov\" value=\"0.1\"/><transform name=\"to_world\"><matrix value=\"{}\"/></transform></emitter>",
        matrix_text(&pose(x, y, d, origin))
    )
}

fn pose(x: Vec3, y: Vec3, z: Vec3, origin: Vec3) -> Affine {
    let row = |k: usize| Vec3::new(x[k], y[k], z[k]);
    Affine {
        linear: [row(0), row(1), row(2)],
        translation: origin,
    }
}

/// Returns a map as Mitsuba's 16 numbers by rows.
pub(crate) fn matrix_text(a: &Affine) -> String {
    let mut out = String::new();
    for (r, row) in a.linear.iter().enumerate() {
        let t = a.translation[r];
        write!(out, "{} {} {} {t} ", row.x, row.y, row.z).expect("strings take every text");
    }
    out + "0 0 0 1"
}
