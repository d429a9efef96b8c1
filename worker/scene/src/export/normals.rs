//! Normals at the vertices of a mesh, for viewers.

use crate::{Mesh, Vec3};

/// The normals that viewers use for shading a mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Normals {
    /// Flat facets: no normals are written.
    Flat,
    /// A normal at each vertex.
    Smooth,
}

/// The normal of a vertex that has only facets without area: glTF requires unit length.
const UP: Vec3 = Vec3::new(0.0, 1.0, 0.0);
/// Sums shorter than this have no direction, m².
const SHORTEST: f32 = 1e-12;

impl Normals {
    /// Returns unit normals, one a vertex: the mean of its facets' normals, weighted by their
    /// areas.
    pub(super) fn of(self, mesh: &Mesh) -> Option<Vec<Vec3>> {
        if self == Self::Flat {
            return None;
        }
        let mut sums = vec![Vec3::ZERO; mesh.positions.len()];
        for t in &mesh.triangles {
            let [a, b, c] = t.map(|v| mesh.positions[v as usize]);
            // The vector's length is twice the area.
            let normal = (b - a).cross(c - a);
            for v in t {
                sums[*v as usize] += normal;
            }
        }
        let unit = |sum: Vec3| {
            let length = sum.length();
            match length.is_finite() && length > SHORTEST {
                true => sum / length,
                false => UP,
            }
        };
        Some(sums.into_iter().map(unit).collect())
    }
}
