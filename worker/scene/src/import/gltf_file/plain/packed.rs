//! Views compressed by meshopt, and primitives compressed by Draco.

use std::collections::BTreeMap;

use gltf::{
    Semantic,
    json::{
        self, Index,
        accessor::{ComponentType, Type},
        validation::{Checked, USize64},
    },
};
use serde::Deserialize;

use super::{MAX_BYTES, Plain, component, is_read};
use crate::import::{
    gltf_file::{draco, meshopt},
    quoted,
};

/// Both names of meshopt's extension.
const MESHOPT: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];
const DRACO: &str = "KHR_draco_mesh_compression";

/// The content of meshopt's extension of a view.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Compressed {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: usize,
    count: usize,
    mode: String,
    filter: Option<String>,
}

/// The content of Draco's extension of a primitive.
#[derive(PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Packed {
    buffer_view: usize,
    attributes: BTreeMap<String, u32>,
}

impl Plain<'_> {
    pub(super) fn meshopt_views(&mut self) -> Result<(), String> {
        for k in 0..self.root.buffer_views.len() {
            let extensions = self.root.buffer_views[k].extensions.as_ref();
            let stated = extensions.and_then(|e| MESHOPT.iter().find_map(|n| e.others.get(*n)));
            let Some(stated) = stated.cloned() else {
                continue;
            };
            let fail = |what: String| format!("bufferViews[{k}].extensions.{}: {what}", MESHOPT[0]);
            let stated: Compressed =
                serde_json::from_value(stated).map_err(|e| fail(e.to_string()))?;
            let bytes = self.decompressed(&stated).map_err(fail)?;
            let offset = self.append(&bytes);
            let view = &mut self.root.buffer_views[k];
            view.buffer = Index::new(self.buffer as u32);
            view.byte_offset = Some(USize64::from(offset));
            view.byte_length = USize64::from(bytes.len());
        }
        Ok(())
    }

    fn decompressed(&self, stated: &Compressed) -> Result<Vec<u8>, String> {
        let Compressed {
            count,
            byte_stride: size,
            ..
        } = *stated;
        let data = self.part(stated.buffer, stated.byte_offset, stated.byte_length)?;
        let bytes = self.room(count, size)?;
        if bytes / meshopt::MAX_RATIO > data.len() {
            return Err(format!(
                "{} bytes cannot contain {count} elements",
                data.len()
            ));
        }
        let filter = stated.filter.as_deref().unwrap_or("NONE");
        let mut decoded = match (&*stated.mode, size) {
            ("ATTRIBUTES", 4..=256) if size % 4 == 0 => meshopt::vertices(data, count, size)?,
            ("TRIANGLES", 2 | 4) if count % 3 == 0 => short(meshopt::triangles(data, count)?, size),
            ("INDICES", 2 | 4) => short(meshopt::indices(data, count)?, size),
            (mode, _) => {
                return Err(format!(
                    "mode {mode:?} with {count} elements of {size} bytes; expected ATTRIBUTES of 4 to 256 bytes (a \
                     multiple of 4), or TRIANGLES or INDICES of 2 or 4"
                ));
            }
        };
        match (filter, size) {
            ("NONE", _) => {}
            ("OCTAHEDRAL", 4 | 8) => meshopt::octahedral(&mut decoded, size),
            ("QUATERNION", 8) => meshopt::quaternions(&mut decoded),
            ("EXPONENTIAL", _) => meshopt::exponential(&mut decoded),
            (filter, _) => {
                return Err(format!(
                    "filter {} of {size} bytes is not supported; expected NONE, OCTAHEDRAL, QUATERNION or EXPONENTIAL",
                    quoted(filter)
                ));
            }
        }
        Ok(decoded)
    }

    pub(super) fn draco_primitives(&mut self) -> Result<(), String> {
        // A view may belong to several primitives, and is decoded once.
        let mut decoded: BTreeMap<Packed, BTreeMap<String, u32>> = BTreeMap::new();
        for m in 0..self.root.meshes.len() {
            for p in 0..self.root.meshes[m].primitives.len() {
                let primitive = &self.root.meshes[m].primitives[p];
                let stated = primitive
                    .extensions
                    .as_ref()
                    .and_then(|e| e.others.get(DRACO));
                let Some(stated) = stated.cloned() else {
                    continue;
                };
                let fail = |what: String| {
                    format!("meshes[{m}].primitives[{p}].extensions.{DRACO}: {what}")
                };
                let stated: Packed =
                    serde_json::from_value(stated).map_err(|e| fail(e.to_string()))?;
                let known = match decoded.get(&stated) {
                    Some(known) => known.clone(),
                    None => {
                        let named = self.draco(m, p, &stated).map_err(fail)?;
                        decoded.insert(stated, named.clone());
                        named
                    }
                };
                let primitive = &mut self.root.meshes[m].primitives[p];
                primitive.mode = Checked::Valid(json::mesh::Mode::Triangles);
                primitive.indices = known.get("").map(|k| Index::new(*k));
                for (semantic, accessor) in &mut primitive.attributes {
                    if let Checked::Valid(semantic) = semantic
                        && let Some(own) = known.get(&semantic.to_string())
                    {
                        *accessor = Index::new(*own);
                    }
                }
            }
        }
        Ok(())
    }

    /// Decodes a Draco mesh. Returns the accessors of its attributes by name, and of its indices as
    /// the empty name.
    fn draco(
        &mut self,
        m: usize,
        p: usize,
        stated: &Packed,
    ) -> Result<BTreeMap<String, u32>, String> {
        let left = MAX_BYTES - self.bytes.len();
        let mesh = draco::decode(self.view(stated.buffer_view)?, left)?;
        let mut named = BTreeMap::new();
        let attributes = self.root.meshes[m].primitives[p].attributes.clone();
        for (semantic, accessor) in attributes {
            let Checked::Valid(semantic) = semantic else {
                continue;
            };
            let name = semantic.to_string();
            let Some(id) = stated.attributes.get(&name).filter(|_| is_read(&semantic)) else {
                continue;
            };
            let template = self.root.accessors.get(accessor.value());
            let mut own = template
                .ok_or_else(|| format!("{name}: there is no accessors[{}]", accessor.value()))?
                .clone();
            let values = mesh
                .attribute(*id, own.normalized)
                .ok_or_else(|| format!("{name}: the compressed data has no attribute {id}"))?;
            let joints = matches!(semantic, Semantic::Joints(_));
            let bytes: Vec<u8> = match joints {
                true => values
                    .numbers
                    .iter()
                    .flat_map(|x| (*x as u16).to_le_bytes())
                    .collect(),
                false => values
                    .numbers
                    .iter()
                    .flat_map(|x| x.to_le_bytes())
                    .collect(),
            };
            own.component_type = component(match joints {
                true => ComponentType::U16,
                false => ComponentType::F32,
            });
            own.type_ = Checked::Valid(match values.each {
                1 => Type::Scalar,
                2 => Type::Vec2,
                3 => Type::Vec3,
                4 => Type::Vec4,
                n => {
                    return Err(format!(
                        "{name}: {n} numbers for each vertex; expected 1 to 4"
                    ));
                }
            });
            own.normalized = false;
            named.insert(name, self.add(own, mesh.points, &bytes)?);
        }
        let indices: Vec<u8> = mesh.corners().flat_map(u32::to_le_bytes).collect();
        let own = json::Accessor {
            buffer_view: None,
            byte_offset: None,
            count: USize64(0),
            component_type: component(ComponentType::U32),
            extensions: None,
            extras: Default::default(),
            type_: Checked::Valid(Type::Scalar),
            min: None,
            max: None,
            name: None,
            normalized: false,
            sparse: None,
        };
        named.insert(String::new(), self.add(own, indices.len() / 4, &indices)?);
        Ok(named)
    }

    /// Adds an accessor of `count` packed elements.
    fn add(
        &mut self,
        mut accessor: json::Accessor,
        count: usize,
        bytes: &[u8],
    ) -> Result<u32, String> {
        self.room(bytes.len(), 1)?;
        accessor.buffer_view = Some(self.append_view(bytes));
        accessor.byte_offset = None;
        accessor.count = USize64::from(count);
        accessor.sparse = None;
        self.root.accessors.push(accessor);
        Ok(self.root.accessors.len() as u32 - 1)
    }
}

/// Returns indices of 2 or 4 bytes.
fn short(indices: Vec<u32>, size: usize) -> Vec<u8> {
    match size {
        2 => indices
            .iter()
            .flat_map(|i| (*i as u16).to_le_bytes())
            .collect(),
        _ => indices.iter().flat_map(|i| i.to_le_bytes()).collect(),
    }
}
