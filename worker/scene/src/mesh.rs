//! Triangle meshes with one material index per triangle.

use crate::{Material, Vec3};

/// An indexed triangle mesh with flat geometric normals (v1−v0)×(v2−v0).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Mesh {
    /// Name, for people and errors.
    pub name: String,
    /// Vertex positions in the mesh's own frame, metres.
    pub positions: Vec<Vec3>,
    /// Vertex indices, three a triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Index into `materials`, one a triangle.
    pub triangle_material: Vec<u32>,
    /// The materials of this mesh.
    pub materials: Vec<Material>,
}
