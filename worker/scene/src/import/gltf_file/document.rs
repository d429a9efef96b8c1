//! The JSON of a glTF file. Legal constructs that the `gltf` crate refuses are converted, and data
//! that is not used is removed.

use std::collections::BTreeSet;

use gltf::{
    Semantic,
    json::{self, Index, validation::Checked},
};
use serde::Deserialize;

use super::glb;
use crate::import::quoted;

/// The extensions that a file may require: those that are read, and those that only change the
/// appearance and are noted.
const REQUIRED: [&str; 18] = [
    "CESIUM_RTC",
    "KHR_texture_transform",
    "KHR_lights_punctual",
    "KHR_node_visibility",
    "EXT_mesh_gpu_instancing",
    "KHR_xmp_json_ld",
    "KHR_animation_pointer",
    "KHR_techniques_webgl",
    "EXT_lights_image_based",
    "EXT_mesh_features",
    "EXT_instance_features",
    "EXT_structural_metadata",
    "KHR_mesh_quantization",
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
    "EXT_texture_webp",
    "KHR_texture_basisu",
];

/// A parsed file.
#[derive(Debug)]
pub(in crate::import) struct Parsed {
    pub(in crate::import) root: json::Root,
    /// The binary chunk.
    pub(super) blob: Option<Vec<u8>>,
    /// Facts about the file that the document does not contain.
    pub(super) facts: Facts,
}

/// The corrections and omissions.
#[derive(Debug, Default)]
pub(super) struct Facts {
    /// Whether the file has animations, which are not read.
    pub(super) animated: bool,
    /// The textures without a source.
    pub(super) sourceless: BTreeSet<usize>,
    /// Whether the file has no scene, so that all nodes were taken for one.
    pub(super) sceneless: bool,
    /// Whether a scene lists nodes that others of it contain, which are read there alone.
    pub(super) contained: bool,
    /// Whether there are surfaces without positions, which are left out.
    pub(super) placeless: bool,
    /// The images that are neither a uri nor a view with a type.
    pub(super) damaged_images: BTreeSet<usize>,
    /// The translations of nodes in double precision.
    pub(super) translations: Vec<Option<[f64; 3]>>,
}

/// Parses `.glb` or `.gltf` bytes without validation.
///
/// # Errors
/// The fault of the container or of the JSON.
pub(in crate::import) fn parse(bytes: &[u8]) -> Result<Parsed, String> {
    let mut facts = Facts::default();
    let file = glb::split(bytes)?;
    let root = match serde_json::from_slice(file.json) {
        Ok(root) => root,
        Err(why) => {
            facts.animated = true;
            mended(file.json).ok_or_else(|| why.to_string())?
        }
    };
    let blob = file.bin.map(<[u8]>::to_vec);
    Ok(Parsed { root, blob, facts })
}

/// Returns the JSON without animations, which may contain parts unknown to the crate, with a list
/// of nodes in every scene, and with whole numbers for those that are written with a point.
fn mended(text: &[u8]) -> Option<json::Root> {
    let mut value: serde_json::Value = serde_json::from_slice(text).ok()?;
    let root = value.as_object_mut()?;
    root.remove("animations");
    let scenes = root.get_mut("scenes").and_then(|s| s.as_array_mut());
    for scene in scenes.into_iter().flatten() {
        let nodes = scene.as_object_mut()?.entry("nodes");
        nodes.or_insert_with(|| serde_json::Value::Array(Vec::new()));
    }
    without_points(&mut value);
    let text = serde_json::to_vec(&value).ok()?;
    serde_json::from_slice(&text).ok()
}

/// The numbers below which every whole number is exact.
const EXACT: f64 = (1u64 << 53) as f64;

/// Replaces numbers such as 3.0 by 3.
fn without_points(value: &mut serde_json::Value) {
    match value {
        serde_json::Value::Array(all) => all.iter_mut().for_each(without_points),
        serde_json::Value::Object(all) => all.values_mut().for_each(without_points),
        serde_json::Value::Number(n) if n.is_f64() => {
            if let Some(x) = n.as_f64().filter(|x| x.fract() == 0.0 && x.abs() < EXACT) {
                *n = (x as i64).into();
            }
        }
        _ => {}
    }
}

impl Parsed {
    /// Checks the extensions that the file requires.
    ///
    /// # Errors
    /// The first unsupported one.
    pub(super) fn check(&self) -> Result<(), String> {
        for name in &self.root.extensions_required {
            if !REQUIRED.contains(&name.as_str()) && !name.starts_with("KHR_materials_") {
                return Err(format!(
                    "extensionsRequired: {} is not supported; export the file without it",
                    quoted(name)
                ));
            }
        }
        Ok(())
    }

    /// Returns the validated document.
    ///
    /// # Errors
    /// The fault in the file.
    pub(super) fn document(mut self, bytes: &[u8]) -> Result<(gltf::Document, Facts), String> {
        let (root, facts) = (&mut self.root, &mut self.facts);
        root.extensions_required.clear();
        facts.animated = !root.animations.is_empty() || (facts.animated && has_animations(bytes));
        root.animations.clear();
        facts.sceneless = add_scene(root);
        facts.contained = remove_contained(root);
        facts.placeless = remove_placeless(root);
        for (k, texture) in root.textures.iter_mut().enumerate() {
            if texture.source.value() == u32::MAX as usize
                && let Some(image) = other_image(texture)
            {
                texture.source = Index::new(image);
            }
            if texture.source.value() == u32::MAX as usize {
                facts.sourceless.insert(k);
                texture.source = Index::new(0);
            }
        }
        if !facts.sourceless.is_empty() && root.images.is_empty() {
            root.images.push(json::Image {
                buffer_view: None,
                mime_type: None,
                name: None,
                uri: None,
                extensions: None,
                extras: None,
            });
        }
        let whole = |i: &json::Image| match i.buffer_view {
            Some(_) => i.mime_type.is_some(),
            None => i.uri.is_some(),
        };
        let images = root.images.iter().enumerate();
        facts.damaged_images = images.filter(|(_, i)| !whole(i)).map(|(k, _)| k).collect();
        facts.translations = translations(bytes);
        positions(root)?;
        let document = gltf::Document::from_json(self.root)
            .map_err(|e| format!("is not readable glTF 2.0 ({e}); copy or export it again"))?;
        Ok((document, self.facts))
    }
}

/// Adds a scene of all nodes to a file without one. Returns whether it did.
fn add_scene(root: &mut json::Root) -> bool {
    if !root.scenes.is_empty() || root.nodes.is_empty() {
        return false;
    }
    let children = children(root);
    let tops = (0..root.nodes.len()).filter(|k| !children.contains(k));
    let nodes = tops.map(|k| Index::new(k as u32)).collect();
    root.scenes.push(json::Scene {
        extensions: None,
        extras: Default::default(),
        name: None,
        nodes,
    });
    true
}

/// Removes nodes from the list of a scene that others of its nodes contain, because they would be
/// read twice. Returns whether there were any.
fn remove_contained(root: &mut json::Root) -> bool {
    let mut removed = false;
    for scene in &mut root.scenes {
        let inside = inside(&root.nodes, &scene.nodes);
        let before = scene.nodes.len();
        scene.nodes.retain(|n| !inside.contains(&n.value()));
        removed |= scene.nodes.len() < before;
    }
    removed
}

/// Returns all nodes below the given ones.
fn inside(nodes: &[json::Node], tops: &[Index<json::Node>]) -> BTreeSet<usize> {
    let mut open: Vec<usize> = tops.iter().map(Index::value).collect();
    let mut found = BTreeSet::new();
    while let Some(node) = open.pop() {
        let below = nodes.get(node).and_then(|n| n.children.as_ref());
        let below = below.into_iter().flatten().map(Index::value);
        open.extend(below.filter(|child| found.insert(*child)));
    }
    found
}

fn children(root: &json::Root) -> BTreeSet<usize> {
    let children = root.nodes.iter().flat_map(|n| n.children.iter().flatten());
    children.map(Index::value).collect()
}

/// Removes surfaces without positions. Returns whether there were any.
fn remove_placeless(root: &mut json::Root) -> bool {
    let position = Checked::Valid(Semantic::Positions);
    let mut removed = false;
    for mesh in &mut root.meshes {
        let before = mesh.primitives.len();
        mesh.primitives
            .retain(|p| p.attributes.contains_key(&position));
        removed |= mesh.primitives.len() < before;
    }
    removed
}

/// Returns the image of a texture whose format an extension allows: WebP or KTX2.
fn other_image(texture: &json::Texture) -> Option<u32> {
    let extensions = &texture.extensions.as_ref()?.others;
    let named = ["EXT_texture_webp", "KHR_texture_basisu"].map(|name| extensions.get(name));
    let source = named
        .into_iter()
        .flatten()
        .next()?
        .get("source")?
        .as_u64()?;
    u32::try_from(source).ok()
}

/// Checks the accessors of positions, on which the crate relies before it validates them.
fn positions(root: &json::Root) -> Result<(), String> {
    let position = Checked::Valid(Semantic::Positions);
    for (m, mesh) in root.meshes.iter().enumerate() {
        for (p, primitive) in mesh.primitives.iter().enumerate() {
            let accessor = primitive.attributes.get(&position);
            if accessor.is_some_and(|a| a.value() >= root.accessors.len()) {
                return Err(format!(
                    "meshes[{m}].primitives[{p}].attributes.POSITION: no such accessor; export the file again"
                ));
            }
        }
    }
    Ok(())
}

/// Returns whether a file that cannot be parsed is of version 1.
pub(super) fn is_version_1(bytes: &[u8]) -> bool {
    if bytes.starts_with(b"glTF") {
        return bytes.get(4..8) == Some(&1u32.to_le_bytes());
    }
    let value = serde_json::from_slice::<serde_json::Value>(bytes).unwrap_or_default();
    // Its lists are objects, and it may leave out its version.
    value["meshes"].is_object()
        && value["asset"]["version"]
            .as_str()
            .is_none_or(|v| v.starts_with('1'))
}

fn has_animations(bytes: &[u8]) -> bool {
    #[derive(Deserialize)]
    struct Root {
        #[serde(default)]
        animations: Vec<serde::de::IgnoredAny>,
    }
    glb::split(bytes).is_ok_and(|file| {
        serde_json::from_slice::<Root>(file.json).is_ok_and(|r| !r.animations.is_empty())
    })
}

/// Returns the translations of nodes with all digits, because the crate stores single precision.
/// Empty if a node has no such numbers.
fn translations(bytes: &[u8]) -> Vec<Option<[f64; 3]>> {
    #[derive(Deserialize)]
    struct Root {
        #[serde(default)]
        nodes: Vec<Node>,
    }
    #[derive(Deserialize)]
    struct Node {
        translation: Option<[f64; 3]>,
        matrix: Option<[f64; 16]>,
    }
    let place = |n: Node| match n.matrix {
        Some(m) => Some([m[12], m[13], m[14]]),
        None => n.translation,
    };
    let json = glb::split(bytes).map_or(&[][..], |file| file.json);
    serde_json::from_slice::<Root>(json)
        .map(|root| root.nodes.into_iter().map(place).collect())
        .unwrap_or_default()
}
