//! The surface of a density field as triangles.
//!
//! The surface is defined as the points where a ray at a right angle to it has lost half its light
//! (T = 0.5): the logit [`surface_logit`]. Naive surface nets (Gibson 1998; crate
//! `fast-surface-nets`) give one vertex for each cell that the surface crosses, at the mean of its
//! crossings; Newton steps along the gradient then move it onto the surface between the nodes. The
//! surface is open at the ends of the grid.

mod glb;

use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use ndshape::{RuntimeShape, Shape};
use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::field::{Field, surface_logit};

/// The number of Newton steps of a vertex.
const STEPS: usize = 3;
/// The greatest distance of a vertex from its position in the surface nets, voxels.
const FARTHEST: f32 = 0.7;

/// A triangle mesh in metres, in the scene's axes. Facets are counter-clockwise seen from empty
/// space.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Surface {
    /// The vertices.
    pub positions: Vec<Vec3>,
    /// The vertex indices.
    pub triangles: Vec<[u32; 3]>,
}

/// Returns the surface of a field.
pub fn surface(field: &Field) -> Surface {
    let level = surface_logit();
    let shape = RuntimeShape::<u32, 3>::new(field.nodes.map(|n| n as u32));
    // Negative inside: the library's sign.
    let values: Vec<f32> = field.logit.par_iter().map(|u| level - u).collect();
    let mut out = SurfaceNetsBuffer::default();
    let last = shape.as_array().map(|n| n - 1);
    surface_nets(&values, &shape, [0; 3], last, &mut out);
    let positions = out.positions.par_iter().map(|p| {
        let start = Vec3::from(*p);
        field.origin + settled(field, start, level) * field.spacing
    });
    Surface {
        positions: positions.collect(),
        triangles: out.indices.as_chunks::<3>().0.to_vec(),
    }
}

/// Moves a vertex in grid coordinates onto the level along the gradient.
fn settled(field: &Field, start: Vec3, level: f32) -> Vec3 {
    let mut p = start;
    for _ in 0..STEPS {
        let Some((u, g)) = value_and_gradient(field, p) else {
            break;
        };
        let square = g.dot(g);
        if square < 1e-6 {
            break;
        }
        p = p - g * ((u - level) / square);
        let way = p - start;
        if way.length() > FARTHEST {
            p = start + way.normalized() * FARTHEST;
        }
    }
    if p.is_finite() { p } else { start }
}

/// Returns the logit and its gradient in grid coordinates, or `None` outside the grid.
fn value_and_gradient(field: &Field, p: Vec3) -> Option<(f32, Vec3)> {
    let inside = |k: usize| p[k] >= 0.0 && p[k] < (field.nodes[k] - 1) as f32;
    if !(0..3).all(inside) {
        return None;
    }
    let [_, y, z] = field.strides();
    let (i, j, k) = (p.x as usize, p.y as usize, p.z as usize);
    let cell = k * z + j * y + i;
    let f = [p.x - i as f32, p.y - j as f32, p.z - k as f32];
    let along = |axis: usize| {
        let (mut a, mut b) = (f, f);
        (a[axis], b[axis]) = (0.0, 1.0);
        field.interpolate(cell, b) - field.interpolate(cell, a)
    };
    Some((
        field.interpolate(cell, f),
        Vec3::new(along(0), along(1), along(2)),
    ))
}

impl Surface {
    /// Encodes the surface as binary little-endian PLY.
    pub fn ply(&self) -> Vec<u8> {
        let mut out = format!(
            "ply\nformat binary_little_endian 1.0\ncomment picofarm reconstruction, metres\nelement vertex {}\n\
             property float x\nproperty float y\nproperty float z\nelement face {}\n\
             property list uchar int vertex_indices\nend_header\n",
            self.positions.len(),
            self.triangles.len()
        )
        .into_bytes();
        for p in &self.positions {
            out.extend([p.x, p.y, p.z].into_iter().flat_map(f32::to_le_bytes));
        }
        for t in &self.triangles {
            out.push(3);
            out.extend(t.iter().flat_map(|v| (*v as i32).to_le_bytes()));
        }
        out
    }

    /// Returns the corners of every triangle.
    pub(crate) fn corners(&self) -> Vec<[Vec3; 3]> {
        let at = |v: u32| self.positions[v as usize];
        self.triangles.iter().map(|t| t.map(at)).collect()
    }
}
