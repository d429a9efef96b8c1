//! The transforms of the nodes of a glTF file, and their extras and extensions.

use std::path::Path;

use gltf::{
    Node,
    accessor::{DataType, Dimensions, Iter},
};
use picofarm_settings::Spots;
use serde::Deserialize;

use crate::{
    SceneError, Vec3,
    extras::NodeExtras,
    import::{format_error, mitsuba::Matrix},
};

use super::{MAX_DEPTH, Walk, document::Facts};

/// Returns the world transforms by node; `None` for nodes outside the scene.
pub(super) fn worlds(
    path: &Path,
    document: &gltf::Document,
    root: &gltf::Scene<'_>,
    facts: &Facts,
) -> Result<Vec<Option<Matrix>>, SceneError> {
    let mut worlds = vec![None; document.nodes().len()];
    let mut open: Vec<(Node<'_>, Option<Matrix>, usize)> =
        root.nodes().map(|n| (n, None, 0)).collect();
    while let Some((node, parent, depth)) = open.pop() {
        if depth > MAX_DEPTH {
            let what = format!("nodes[{}]: nested deeper than {MAX_DEPTH}", node.index());
            return Err(format_error(path, what));
        }
        let mut own = of_columns(node.transform().matrix());
        if let Some(Some(exact)) = facts.translations.get(node.index()) {
            for (row, x) in own.0.iter_mut().zip(exact) {
                row[3] = *x;
            }
        }
        let world = parent.map_or(own, |parent: Matrix| parent.after(&own));
        worlds[node.index()] = Some(world);
        open.extend(node.children().map(|c| (c, Some(world), depth + 1)));
    }
    Ok(worlds)
}

/// Converts glTF's column-major matrix.
pub(super) fn of_columns(m: [[f32; 4]; 4]) -> Matrix {
    Matrix(std::array::from_fn(|r| {
        std::array::from_fn(|c| f64::from(m[c][r]))
    }))
}

/// Returns whether `KHR_node_visibility` hides a node and all its descendants.
pub(super) fn is_hidden(node: &Node<'_>) -> bool {
    let extension = node.extension_value("KHR_node_visibility");
    extension.and_then(|e| e.get("visible")) == Some(&serde_json::Value::Bool(false))
}

impl Walk<'_> {
    /// Returns a node's extras. Entries of other programs are ignored: their labels and numbers
    /// have other types.
    pub(super) fn extras(&mut self, node: &Node<'_>) -> Result<NodeExtras, SceneError> {
        #[derive(Deserialize)]
        struct Laser {
            laser_spots: Option<Spots>,
            laser_directions: Option<Vec<Vec3>>,
        }
        let Some(raw) = node.extras() else {
            return Ok(NodeExtras::default());
        };
        let fail = |e: serde_json::Error| {
            let at = format!("nodes[{}].extras", node.index());
            let what = format!("{at}: {e}; expected laser_spots or laser_directions as documented");
            format_error(self.path, what)
        };
        let value: serde_json::Value = serde_json::from_str(raw.get()).map_err(fail)?;
        let Some(fields) = value.as_object() else {
            return Ok(NodeExtras::default());
        };
        let mut extras = NodeExtras::default();
        if fields.contains_key("laser_spots") || fields.contains_key("laser_directions") {
            // Parsed from the text, because a generic JSON value would round numbers twice.
            let laser: Laser = serde_json::from_str(raw.get()).map_err(fail)?;
            (extras.laser_spots, extras.laser_directions) =
                (laser.laser_spots, laser.laser_directions);
        }
        match fields.get("label") {
            None | Some(serde_json::Value::Null) => {}
            Some(serde_json::Value::String(label)) => extras.label = Some(label.clone()),
            Some(_) => self.note("extras.label", "ignored where it is no text"),
        }
        match fields.get("instance") {
            None | Some(serde_json::Value::Null) => {}
            Some(id) => match id.as_u64().and_then(|id| u32::try_from(id).ok()) {
                Some(id) => extras.instance = Some(id),
                None => self.note("extras.instance", "ignored where it is no whole number"),
            },
        }
        Ok(extras)
    }

    /// Returns the transforms of a node's mesh instances relative to the node: those of
    /// `EXT_mesh_gpu_instancing`, or a single one.
    pub(super) fn instances(&mut self, node: &Node<'_>) -> Result<Vec<Matrix>, SceneError> {
        let Some(extension) = node.extension_value("EXT_mesh_gpu_instancing") else {
            return Ok(vec![Matrix::IDENTITY]);
        };
        let at = format!("nodes[{}].extensions.EXT_mesh_gpu_instancing", node.index());
        let path = self.path;
        let fail = |what: String| format_error(path, format!("{at}: {what}"));
        let attributes = extension.get("attributes").and_then(|a| a.as_object());
        let attributes = attributes.ok_or_else(|| fail("needs attributes".into()))?;
        let mut count = None;
        let mut read = |name: &str, dimensions: Dimensions| {
            let Some(index) = attributes.get(name) else {
                return Ok(None);
            };
            let accessor = index
                .as_u64()
                .and_then(|k| self.document.accessors().nth(usize::try_from(k).ok()?))
                .ok_or_else(|| fail(format!("{name}: no such accessor")))?;
            self.buffers
                .check(&accessor, dimensions, &[DataType::F32])
                .map_err(|what| fail(format!("{name}: {what}")))?;
            if *count.get_or_insert(accessor.count()) != accessor.count() {
                return Err(fail(format!("{name}: expected as many as of the others")));
            }
            Ok(Some(accessor))
        };
        let moved = read("TRANSLATION", Dimensions::Vec3)?;
        let turned = read("ROTATION", Dimensions::Vec4)?;
        let scaled = read("SCALE", Dimensions::Vec3)?;
        let buffers = self.buffers;
        let three = |a: Option<gltf::Accessor<'_>>, usual: [f32; 3]| {
            let read = a.and_then(|a| Iter::<[f32; 3]>::new(a, |b| buffers.get(&b)));
            let rest = std::iter::repeat(usual);
            read.into_iter().flatten().chain(rest)
        };
        let quaternions = turned.and_then(|a| Iter::<[f32; 4]>::new(a, |b| buffers.get(&b)));
        let quaternions = quaternions.into_iter().flatten();
        let quaternions = quaternions.chain(std::iter::repeat([0.0, 0.0, 0.0, 1.0]));
        let all = three(moved, [0.0; 3])
            .zip(quaternions)
            .zip(three(scaled, [1.0; 3]));
        let place = |((translation, rotation), scale)| {
            let transform = gltf::scene::Transform::Decomposed {
                translation,
                rotation,
                scale,
            };
            of_columns(transform.matrix())
        };
        Ok(all.take(count.unwrap_or(0)).map(place).collect())
    }
}
