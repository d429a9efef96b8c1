//! The properties of each plugin. As in Mitsuba, an unused property is an error, so that no
//! statement of a file is lost unnoticed.

use super::{
    Reader,
    node::{Child, Node},
};
use crate::import::quoted;

/// The greatest difference in letters for suggesting a name in hints.
const NEAR: usize = 3;
/// The greatest length of a compared name.
const MAX_COMPARED: usize = 64;

/// The properties of a plugin.
#[derive(Debug, Clone, Copy)]
pub(super) struct Properties {
    /// The properties that are read.
    pub(super) used: &'static [&'static str],
    /// The properties that change neither geometry nor light, which are accepted with a note.
    pub(super) harmless: &'static [&'static str],
    /// The tags of the allowed child plugins.
    pub(super) children: &'static [&'static str],
}

const fn with(
    used: &'static [&'static str],
    harmless: &'static [&'static str],
    children: &'static [&'static str],
) -> Properties {
    Properties {
        used,
        harmless,
        children,
    }
}

const IN_SHAPES: &[&str] = &["bsdf", "emitter", "sensor"];

pub(super) const SCENE: Properties = with(
    &[],
    &["embree_use_robust_intersections"],
    &["shape", "sensor", "emitter", "bsdf", "texture", "film"],
);
pub(super) const MESH_FILE: Properties = with(
    &[
        "filename",
        "to_world",
        "flip_normals",
        "flip_tex_coords",
        // All facets are flat.
        "face_normals",
    ],
    &["max_smooth_angle", "collapse", "load_materials"],
    IN_SHAPES,
);
pub(super) const PRIMITIVE: Properties = with(
    &["to_world", "flip_normals", "face_normals"],
    &[],
    IN_SHAPES,
);
pub(super) const SPHERE: Properties = with(
    &["to_world", "flip_normals", "center", "radius"],
    &[],
    IN_SHAPES,
);
pub(super) const DIFFUSE: Properties = with(&["reflectance"], &[], &[]);
pub(super) const GLASS: Properties = with(
    &[
        "int_ior",
        "ext_ior",
        "specular_reflectance",
        "specular_transmittance",
    ],
    &[],
    &[],
);
pub(super) const ROUGH_GLASS: Properties = with(
    &[
        "int_ior",
        "ext_ior",
        "specular_reflectance",
        "specular_transmittance",
    ],
    &[
        "alpha",
        "alpha_u",
        "alpha_v",
        "distribution",
        "sample_visible",
    ],
    &[],
);
pub(super) const PLASTIC: Properties = with(
    &["diffuse_reflectance"],
    &[
        "specular_reflectance",
        "int_ior",
        "ext_ior",
        "nonlinear",
        "alpha",
        "distribution",
        "sample_visible",
    ],
    &[],
);
pub(super) const PRINCIPLED: Properties = with(
    &["base_color", "metallic", "roughness"],
    &[
        "anisotropic",
        "clearcoat",
        "clearcoat_gloss",
        "diff_trans",
        "eta",
        "flatness",
        "sheen",
        "sheen_tint",
        "spec_tint",
        "spec_trans",
        "specular",
        "diffuse_reflectance_sampling_rate",
        "specular_sampling_rate",
        "clearcoat_sampling_rate",
    ],
    &[],
);
pub(super) const MASK: Properties = with(&["opacity"], &[], &["bsdf"]);
pub(super) const RELIEF: Properties = with(&[], &["scale"], &["bsdf", "texture"]);
pub(super) const CHECKERBOARD: Properties = with(&["color0", "color1"], &["to_uv"], &[]);
pub(super) const SERIALIZED: Properties = with(
    &["filename", "shape_index", "to_world", "flip_normals"],
    &["face_normals"],
    IN_SHAPES,
);
pub(super) const CYLINDER: Properties = with(
    &["p0", "p1", "radius", "to_world", "flip_normals"],
    &[],
    IN_SHAPES,
);
pub(super) const GROUP: Properties = with(&[], &[], &["shape"]);
pub(super) const INSTANCE: Properties = with(&["to_world"], &[], &["shape"]);
pub(super) const CONDUCTOR: Properties =
    with(&["material", "eta", "k", "specular_reflectance"], &[], &[]);
pub(super) const ROUGH_CONDUCTOR: Properties = with(
    &[
        "alpha",
        "alpha_u",
        "alpha_v",
        "distribution",
        "material",
        "eta",
        "k",
        "specular_reflectance",
        // The sampling of light paths.
        "sample_visible",
    ],
    &[],
    &[],
);
pub(super) const TWO_SIDED: Properties = with(&[], &[], &["bsdf"]);
pub(super) const BLEND: Properties = with(&["weight"], &[], &["bsdf"]);
pub(super) const BITMAP: Properties = with(
    &["filename", "filter_type", "wrap_mode", "raw", "to_uv"],
    &["max_anisotropy", "cache", "format", "accel"],
    &[],
);
pub(super) const PERSPECTIVE: Properties = with(
    &[
        "to_world",
        "fov",
        "fov_axis",
        "focal_length",
        "principal_point_offset_x",
        "principal_point_offset_y",
        // For a pinhole, these have no effect.
        "near_clip",
        "far_clip",
        "focus_distance",
    ],
    &["shutter_open", "shutter_close", "aperture_radius", "srf"],
    &["film"],
);
/// The properties of a film.
pub(super) const FILM: Properties = with(
    &[
        "width",
        "height",
        "crop_offset_x",
        "crop_offset_y",
        "crop_width",
        "crop_height",
        "temporal_bins",
        "bin_width_opl",
        "start_opl",
        // MitsubaToF's names of the gate.
        "min_bound",
        "max_bound",
        "bin_width",
        // The names of the gate in the streak film, mitransient's forerunner.
        "time",
        "exposure_time",
        "time_offset",
    ],
    &[
        "file_format",
        "pixel_format",
        "component_format",
        "sample_border",
        "compensate",
        "high_quality_edges",
        "banner",
        "attach_log",
        "size",
        "tonemap_method",
        "gamma",
        "exposure",
        "key",
        "burn",
        "variable",
        "digits",
        "wl_mean",
        "wl_sigma",
        "temporal_filter",
        "gaussian_stddev",
        "decomposition",
        "channel_names",
        "calibrated_transient",
        "auto_detect_bins",
        "path_min",
        "path_max",
        "path_sample",
    ],
    &[],
);
pub(super) const PROJECTOR: Properties = with(
    // The power of a beam is not read.
    &["to_world", "fov", "irradiance", "scale"],
    &["fov_axis", "sampling_weight"],
    &[],
);
pub(super) const SPOT: Properties = with(
    &["to_world", "cutoff_angle", "intensity"],
    &["beam_width", "texture", "sampling_weight"],
    &[],
);

impl Reader<'_> {
    /// Refuses unused properties of a plugin.
    pub(super) fn only(&mut self, node: &Node, known: &Properties) -> Result<(), String> {
        for name in node.parameters.keys() {
            if known.used.contains(&name.as_str()) {
                continue;
            }
            if !known.harmless.contains(&name.as_str()) {
                return Err(unused(node, name, known));
            }
            self.note(
                &format!("ignored {} {name}", node.kind),
                "this parameter is not used",
            );
        }
        for (name, child) in &node.children {
            let resolved = self.resolved(node, child)?;
            let by_name = !name.is_empty() && known.used.contains(&name.as_str());
            let skipped = super::xml::SKIPPED.contains(&resolved.tag.as_str());
            if known.children.contains(&resolved.tag.as_str()) || by_name || skipped {
                continue;
            }
            if known.harmless.contains(&name.as_str()) {
                self.note(
                    &format!("ignored {} {name}", node.kind),
                    "this parameter is not used",
                );
                continue;
            }
            let place = match child {
                Child::Node(child) => child.at.clone(),
                Child::Reference(id) => format!("its reference to {}", quoted(id)),
            };
            return Err(match name.is_empty() {
                true => node.fail(format!("{place} is not used here; remove it")),
                false => unused(node, name, known),
            });
        }
        Ok(())
    }
}

fn unused(node: &Node, name: &str, known: &Properties) -> String {
    let place = node.places.get(name).map(|p| format!(" ({p})"));
    let words = super::old::name(name);
    // The time of a comparison is the product of both lengths.
    let short = words.len() <= MAX_COMPARED;
    let all = known.used.iter().chain(known.harmless).filter(|_| short);
    let near = all
        .map(|other| (strsim::damerau_levenshtein(other, &words), *other))
        .min()
        .filter(|(distance, other)| *distance <= NEAR.min(other.len() / 2));
    let hint = match near {
        Some((_, other)) => format!("did you mean {other:?}?"),
        None if known.used.is_empty() => "it has no properties; remove it".to_owned(),
        None => format!("use {}, or remove it", known.used.join(", ")),
    };
    let plugin = match node.kind.is_empty() {
        true => node.tag.clone(),
        false => format!("{} {}", node.tag, quoted(&node.kind)),
    };
    node.fail(format!(
        "property {}{} is not used by {plugin}; {hint}",
        quoted(name),
        place.unwrap_or_default()
    ))
}
