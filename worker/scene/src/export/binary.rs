//! The binary chunk of a glTF document during its construction: accessors over the meshes' numbers,
//! followed by images.

use serde::Serialize;

use crate::{Mesh, Vec3};

const COMPONENT_F32: u32 = 5126;
const COMPONENT_U32: u32 = 5125;
const TARGET_VERTICES: u32 = 34962;
const TARGET_INDICES: u32 = 34963;

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Accessor {
    buffer_view: usize,
    component_type: u32,
    count: usize,
    r#type: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    min: Option<Vec3>,
    #[serde(skip_serializing_if = "Option::is_none")]
    max: Option<Vec3>,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct BufferView {
    buffer: u32,
    byte_offset: usize,
    byte_length: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    target: Option<u32>,
}

/// The accessors and the binary chunk during their construction.
#[derive(Debug, Default)]
pub(super) struct Binary {
    pub(super) bytes: Vec<u8>,
    pub(super) views: Vec<BufferView>,
    pub(super) accessors: Vec<Accessor>,
}

impl Binary {
    /// Appends bytes as a separate view, and pads to the next word.
    pub(super) fn view(&mut self, bytes: impl Iterator<Item = u8>, target: Option<u32>) -> usize {
        let start = self.bytes.len();
        self.bytes.extend(bytes);
        self.views.push(BufferView {
            buffer: 0,
            byte_offset: start,
            byte_length: self.bytes.len() - start,
            target,
        });
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.len() - 1
    }

    fn push(
        &mut self,
        words: impl Iterator<Item = [u8; 4]>,
        target: u32,
        accessor: Accessor,
    ) -> usize {
        self.view(words.flatten(), Some(target));
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    pub(super) fn positions(&mut self, mesh: &Mesh) -> usize {
        let (min, max) = mesh.bounds().unzip();
        let accessor = Accessor {
            buffer_view: self.views.len(),
            component_type: COMPONENT_F32,
            count: mesh.positions.len(),
            r#type: "VEC3",
            min,
            max,
        };
        let words = mesh.positions.iter().flat_map(|p| [p.x, p.y, p.z]);
        self.push(words.map(f32::to_le_bytes), TARGET_VERTICES, accessor)
    }

    /// Appends unit normals, one a vertex.
    pub(super) fn normals(&mut self, normals: &[Vec3]) -> usize {
        let accessor = Accessor {
            buffer_view: self.views.len(),
            component_type: COMPONENT_F32,
            count: normals.len(),
            r#type: "VEC3",
            min: None,
            max: None,
        };
        let words = normals.iter().flat_map(|n| [n.x, n.y, n.z]);
        self.push(words.map(f32::to_le_bytes), TARGET_VERTICES, accessor)
    }

    /// Appends texture coordinates. Returns `None` for a mesh without them.
    pub(super) fn coordinates(&mut self, mesh: &Mesh) -> Option<usize> {
        let accessor = Accessor {
            buffer_view: self.views.len(),
            component_type: COMPONENT_F32,
            count: mesh.uv.len(),
            r#type: "VEC2",
            min: None,
            max: None,
        };
        let words = mesh.uv.iter().flatten().map(|x| x.to_le_bytes());
        (!mesh.uv.is_empty()).then(|| self.push(words, TARGET_VERTICES, accessor))
    }

    pub(super) fn indices(&mut self, triangles: &[[u32; 3]]) -> usize {
        let accessor = Accessor {
            buffer_view: self.views.len(),
            component_type: COMPONENT_U32,
            count: triangles.len() * 3,
            r#type: "SCALAR",
            min: None,
            max: None,
        };
        let words = triangles.iter().flatten().map(|v| v.to_le_bytes());
        self.push(words, TARGET_INDICES, accessor)
    }
}
