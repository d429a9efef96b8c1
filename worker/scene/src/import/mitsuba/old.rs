//! Converts files of Mitsuba before version 2 to the current names, as Mitsuba itself does.

use crate::import::quoted;

use super::{
    node::{Node, Value},
    transform::Matrix,
};

/// Returns whether a version is before 2. A file without a version is current.
///
/// # Errors
/// An invalid version.
pub(super) fn is_old(version: Option<&str>) -> Result<bool, String> {
    let Some(version) = version else {
        return Ok(false);
    };
    let parts: Option<Vec<u32>> = version.trim().split('.').map(|p| p.parse().ok()).collect();
    match parts.as_deref() {
        Some([major, ..]) => Ok(*major < 2),
        _ => Err(format!(
            "<scene version={}>: expected a version such as 3.0.0",
            quoted(version)
        )),
    }
}

/// Converts a name in camelCase to words with underscores: `toWorld` to `to_world`, `intIOR` to
/// `int_ior`.
pub(super) fn name(camel: &str) -> String {
    let mut out = String::with_capacity(camel.len() + 4);
    let mut lower = false;
    for c in camel.chars() {
        match (c.is_ascii_uppercase(), lower) {
            (true, true) => {
                out.push('_');
                out.push(c.to_ascii_lowercase());
            }
            // Consecutive capitals form one word.
            (true, false) if !out.is_empty() => out.push(c.to_ascii_lowercase()),
            _ => out.push(c),
        }
        lower = c.is_ascii_lowercase();
    }
    out
}

/// Renames old parameters, and converts the four that became a transform.
///
/// # Errors
/// A parameter given in both forms.
pub(super) fn upgrade(node: &mut Node) -> Result<(), String> {
    if node.kind == "diffuse" {
        rename(node, "diffuse_reflectance", "reflectance")?;
    }
    let mut place = None;
    let mut taken = |node: &mut Node, names: [&str; 2], usual: f64| {
        let known = names.into_iter().find(|n| node.parameters.contains_key(*n));
        let Some(name) = known else { return Ok(usual) };
        let number = node.number(name)?.unwrap_or(usual);
        node.parameters.remove(name);
        place = node.places.remove(name);
        Ok::<f64, String>(number)
    };
    let shift = [
        taken(node, ["uoffset", "u_offset"], 0.0)?,
        taken(node, ["voffset", "v_offset"], 0.0)?,
        0.0,
    ];
    let scale = [
        taken(node, ["uscale", "u_scale"], 1.0)?,
        taken(node, ["vscale", "v_scale"], 1.0)?,
        1.0,
    ];
    match place {
        None => Ok(()),
        Some(place) => {
            let to_uv = Matrix::translation(shift).after(&Matrix::scale(scale));
            node.set("to_uv".into(), Value::Transform(to_uv), place)
        }
    }
}

fn rename(node: &mut Node, from: &str, to: &str) -> Result<(), String> {
    for child in &mut node.children {
        if child.0 == from {
            child.0 = to.to_owned();
        }
    }
    match (node.parameters.remove(from), node.places.remove(from)) {
        (Some(value), Some(place)) => node.set(to.into(), value, place),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn camel_case_becomes_words() {
        for (camel, words) in [
            ("toWorld", "to_world"),
            ("fovAxis", "fov_axis"),
            ("intIOR", "int_ior"),
            ("extIOR", "ext_ior"),
            ("toUV", "to_uv"),
            ("uOffset", "u_offset"),
            ("uoffset", "uoffset"),
            ("specularReflectance", "specular_reflectance"),
            ("flipTexCoords", "flip_tex_coords"),
            ("to_world", "to_world"),
            ("principalPointOffsetX", "principal_point_offset_x"),
            ("", ""),
        ] {
            assert_eq!(name(camel), words);
        }
    }

    #[test]
    fn versions_before_two_are_old() {
        for (version, old) in [
            (Some("0.5.0"), true),
            (Some("0.6.0"), true),
            (Some("2.0.0"), false),
            (Some("3.0.0"), false),
            (Some("3"), false),
            (None, false),
        ] {
            assert_eq!(is_old(version), Ok(old));
        }
        assert!(is_old(Some("new")).is_err());
    }
}
