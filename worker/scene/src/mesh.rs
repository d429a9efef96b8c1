//! Triangle meshes with one material index per triangle.

use std::collections::BTreeMap;

use crate::{Material, Vec3};

/// An indexed triangle mesh with flat geometric normals (v1−v0)×(v2−v0).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Mesh {
    /// The name, for people and errors.
    pub name: String,
    /// The vertex positions in the mesh's own frame, metres.
    pub positions: Vec<Vec3>,
    /// The texture coordinates (u, v), one a vertex, v down; empty without textures.
    pub uv: Vec<[f32; 2]>,
    /// The vertex indices, three a triangle.
    pub triangles: Vec<[u32; 3]>,
    /// The index into `materials`, one a triangle.
    pub triangle_material: Vec<u32>,
    /// The materials of this mesh.
    pub materials: Vec<Material>,
}

impl Mesh {
    /// Sorts the mesh into the canonical order on disk: triangles by material, otherwise in their
    /// order. Unused materials are dropped.
    pub(crate) fn make_canonical(&mut self) {
        let mut order: Vec<usize> = (0..self.triangles.len()).collect();
        order.sort_by_key(|&k| self.triangle_material[k]);
        self.triangles = order.iter().map(|&k| self.triangles[k]).collect();

        let mut used: Vec<u32> = self.triangle_material.clone();
        used.sort_unstable();
        used.dedup();
        self.triangle_material = order
            .iter()
            .map(|&k| {
                let slot = used.binary_search(&self.triangle_material[k]);
                slot.expect("every triangle's material is used") as u32
            })
            .collect();
        self.materials = used
            .iter()
            .map(|&m| self.materials[m as usize].clone())
            .collect();
    }

    /// Returns whether the facets of a material have no rim: along every edge, an even number of
    /// facets join, so that they enclose a volume. Vertices at one position count as one.
    pub(crate) fn is_closed(&self, material: u32) -> bool {
        let mut edges: BTreeMap<[[u32; 3]; 2], u32> = BTreeMap::new();
        let facets = self.triangles.iter().zip(&self.triangle_material);
        for (t, _) in facets.filter(|f| *f.1 == material) {
            // −0 equals 0.
            let place =
                |v: u32| <[f32; 3]>::from(self.positions[v as usize]).map(|x| (x + 0.0).to_bits());
            let corners = t.map(place);
            for k in 0..3 {
                let (a, b) = (corners[k], corners[(k + 1) % 3]);
                *edges.entry([a.min(b), a.max(b)]).or_default() += 1;
            }
        }
        edges.values().all(|n| n % 2 == 0)
    }

    /// Returns the smallest and largest coordinates over the vertices, or `None` without vertices.
    pub fn bounds(&self) -> Option<(Vec3, Vec3)> {
        let first = *self.positions.first()?;
        Some(
            self.positions
                .iter()
                .fold((first, first), |(lo, hi), &p| (lo.min(p), hi.max(p))),
        )
    }
}
