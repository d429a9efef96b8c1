//! Builds meshes from boxes, lathes and quads, for our own furniture and rooms.

use std::f32::consts::TAU;

use crate::{Affine, Material, Mesh, Vec3};

/// A mesh under construction. All solids are closed, with outward facets.
#[derive(Debug, Default)]
pub(crate) struct Shape {
    mesh: Mesh,
    frame: Option<Affine>,
}

impl Shape {
    /// Creates an empty mesh.
    pub(crate) fn new(name: &str) -> Self {
        Self {
            mesh: Mesh {
                name: name.to_owned(),
                ..Mesh::default()
            },
            frame: None,
        }
    }

    /// Adds a material, and returns the index to pass to the solids.
    pub(crate) fn material(&mut self, material: Material) -> u32 {
        self.mesh.materials.push(material);
        self.mesh.materials.len() as u32 - 1
    }

    /// Places the solids added inside `build` by `frame`.
    pub(crate) fn placed(&mut self, frame: Affine, build: impl FnOnce(&mut Self)) {
        let outer = self.frame.replace(frame);
        debug_assert!(outer.is_none(), "frames do not nest");
        build(self);
        self.frame = outer;
    }

    fn vertex(&mut self, p: Vec3) -> u32 {
        let p = self.frame.as_ref().map_or(p, |f| f.point(p));
        self.mesh.positions.push(p);
        self.mesh.positions.len() as u32 - 1
    }

    fn face(&mut self, corners: [u32; 3], material: u32) {
        self.mesh.triangles.push(corners);
        self.mesh.triangle_material.push(material);
    }

    /// Adds a quadrilateral a→b→c→d, counter-clockwise seen from its front.
    pub(crate) fn quad(&mut self, corners: [Vec3; 4], material: u32) {
        let [a, b, c, d] = corners.map(|p| self.vertex(p));
        self.face([a, b, c], material);
        self.face([a, c, d], material);
    }

    /// Adds an axis-aligned box from `lo` to `hi`.
    pub(crate) fn cuboid(&mut self, lo: [f32; 3], hi: [f32; 3], material: u32) {
        let v: Vec<u32> = (0..8)
            .map(|i| {
                let axis = |k: usize| if i >> k & 1 == 1 { hi[k] } else { lo[k] };
                self.vertex(Vec3::new(axis(0), axis(1), axis(2)))
            })
            .collect();
        for [a, b, c, d] in [
            [0, 4, 6, 2],
            [1, 3, 7, 5],
            [0, 1, 5, 4],
            [2, 6, 7, 3],
            [0, 2, 3, 1],
            [4, 5, 7, 6],
        ] {
            self.face([v[a], v[b], v[c]], material);
            self.face([v[a], v[c], v[d]], material);
        }
    }

    /// Adds a body of revolution about the vertical through (cx, cz): `profile` lists (radius, y)
    /// along the outer surface, from the bottom round to the end; radius 0 at an end closes it.
    pub(crate) fn lathe(
        &mut self,
        [cx, cz]: [f32; 2],
        profile: &[[f32; 2]],
        segments: u32,
        material: u32,
    ) {
        let ring = |shape: &mut Self, [radius, y]: [f32; 2]| -> Vec<u32> {
            if radius == 0.0 {
                return vec![shape.vertex(Vec3::new(cx, y, cz)); segments as usize];
            }
            (0..segments)
                .map(|k| {
                    let a = k as f32 / segments as f32 * TAU;
                    let (s, c) = (libm::sinf(a), libm::cosf(a));
                    shape.vertex(Vec3::new(cx + radius * c, y, cz + radius * s))
                })
                .collect()
        };
        let mut below: Option<(Vec<u32>, bool)> = None;
        for &point in profile {
            let (next, tip) = (ring(self, point), point[0] == 0.0);
            if let Some((last, last_tip)) = below {
                for k in 0..segments as usize {
                    let n = (k + 1) % segments as usize;
                    if !last_tip {
                        self.face([last[k], next[n], last[n]], material);
                    }
                    if !tip {
                        self.face([last[k], next[k], next[n]], material);
                    }
                }
            }
            below = Some((next, tip));
        }
    }

    /// Adds a closed upright cylinder or cone frustum.
    pub(crate) fn cylinder(
        &mut self,
        centre: [f32; 2],
        [low, high]: [f32; 2],
        [bottom, top]: [f32; 2],
        segments: u32,
        material: u32,
    ) {
        let profile = [[0.0, low], [bottom, low], [top, high], [0.0, high]];
        self.lathe(centre, &profile, segments, material);
    }

    /// Adds an ellipsoid of revolution of the given radii.
    pub(crate) fn ellipsoid(
        &mut self,
        centre: Vec3,
        [radius, half_height]: [f32; 2],
        rings: u32,
        material: u32,
    ) {
        let profile: Vec<[f32; 2]> = (0..=rings)
            .map(|k| {
                let a = (k as f32 / rings as f32 - 0.5) * (TAU * 0.5);
                let r = if k == 0 || k == rings {
                    0.0
                } else {
                    radius * libm::cosf(a)
                };
                [r, centre.y + half_height * libm::sinf(a)]
            })
            .collect();
        self.lathe([centre.x, centre.z], &profile, rings * 2, material);
    }

    /// Returns the finished mesh, with triangles grouped by material as in the canonical format.
    pub(crate) fn finish(self) -> Mesh {
        let mut mesh = self.mesh;
        mesh.make_canonical();
        mesh
    }
}

#[cfg(test)]
mod tests {
    use super::{Shape, TAU};
    use crate::{Material, Mesh, Vec3};

    /// Returns the volume by the divergence theorem: positive only if the facets face outwards.
    fn volume(mesh: &Mesh) -> f32 {
        let corner = |v: u32| mesh.positions[v as usize];
        mesh.triangles
            .iter()
            .map(|&[a, b, c]| corner(a).dot(corner(b).cross(corner(c))) / 6.0)
            .sum()
    }

    fn solid(build: impl FnOnce(&mut Shape, u32)) -> Mesh {
        let mut shape = Shape::new("solid");
        let m = shape.material(Material::diffuse("grey", [0.5; 3]));
        build(&mut shape, m);
        shape.finish()
    }

    #[test]
    fn solids_are_closed_and_face_outwards() {
        let cuboid = solid(|s, m| s.cuboid([1.0, 2.0, 3.0], [2.0, 4.0, 6.0], m));
        assert!((volume(&cuboid) - 6.0).abs() < 1e-3);
        let cylinder = solid(|s, m| s.cylinder([0.3, 0.1], [0.0, 2.0], [1.0, 1.0], 64, m));
        assert!((volume(&cylinder) - TAU).abs() < 0.02);
        let ball = solid(|s, m| s.ellipsoid(Vec3::new(0.0, 1.0, 0.0), [1.0, 1.0], 32, m));
        assert!((volume(&ball) - 4.19).abs() < 0.05);
    }
}
