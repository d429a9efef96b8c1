//! Needles: triangles so long and thin that f32 cannot resolve their distance along a ray.
//!
//! The barycentric coordinates of a hit are quotients of differences of products. Their relative
//! error grows with the ratio of a triangle's length to its width, and so does the error of t. For
//! a strip of 1 mm × 3 m the error is some tenths of a millimetre, many times the distance by which
//! [`crate::scene::intersection::lift`] moves a point off its surface. A ray that starts or ends on a needle
//! would hit that needle, or its neighbour in the same plane. So t of needles is computed in f64,
//! from the same vertices. The test whether the ray passes inside the edges is the same as for all
//! triangles, so that no ray slips between two that share an edge.

use picofarm_scene::Vec3;

use crate::scene::bvh::nodes::Pack;

/// Marks the index of a needle in a pack.
const NEEDLE: u32 = 1 << 31;

/// Ratio of length to width from which a triangle is a needle; below it the error of t is smaller
/// than the lift of points.
const SLENDER: f64 = 16.0;

/// Returns the mark of a triangle in its pack; 0 if it is not a needle.
pub(crate) fn mark(t: &[Vec3; 3]) -> u32 {
    match is_needle(t) {
        true => NEEDLE,
        false => 0,
    }
}

/// Returns whether a triangle is longer than [`SLENDER`] times its width.
pub(crate) fn is_needle(t: &[Vec3; 3]) -> bool {
    let [a, b, c] = t.map(wide);
    let (e, f, g) = (minus(b, a), minus(c, a), minus(c, b));
    let cross = [
        e[1] * f[2] - e[2] * f[1],
        e[2] * f[0] - e[0] * f[2],
        e[0] * f[1] - e[1] * f[0],
    ];
    let longest2 = dot(e, e).max(dot(f, f)).max(dot(g, g));
    // Twice the area is length times width.
    longest2 > SLENDER * dot(cross, cross).sqrt()
}

pub(crate) fn wide(p: Vec3) -> [f64; 3] {
    [f64::from(p.x), f64::from(p.y), f64::from(p.z)]
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

impl Pack {
    /// Returns the index of the triangle in a lane.
    #[inline(always)]
    pub(crate) fn triangle(&self, lane: usize) -> u32 {
        self.id[lane] & !NEEDLE
    }

    /// Returns a mask of the given lanes that contain needles.
    #[inline(always)]
    pub(crate) fn needles(&self, mut lanes: u32) -> u32 {
        let mut needles = 0;
        while lanes != 0 {
            let k = lanes.trailing_zeros() as usize & 7;
            lanes &= lanes - 1;
            needles |= (self.id[k] >> 31) << k;
        }
        needles
    }

    /// Returns whether a lane contains a needle.
    #[inline(always)]
    pub(crate) fn is_needle(&self, lane: usize) -> bool {
        self.id[lane] & NEEDLE != 0
    }

    /// Returns the distance along a ray to the triangle in a lane, in units of the direction. The
    /// ray must pass inside the triangle's edges. Returns NaN if the ray is in the triangle's
    /// plane.
    #[cold]
    pub(crate) fn exactly(&self, lane: usize, o: Vec3, d: Vec3) -> f32 {
        let at = |v: usize| {
            let [x, y, z] = [0, 1, 2].map(|k| self.vertex[3 * v + k][lane]);
            Vec3::new(x, y, z)
        };
        along(&[at(0), at(1), at(2)], o, d)
    }
}

/// Computes [`Pack::exactly`] for a triangle.
pub(crate) fn along(t: &[Vec3; 3], o: Vec3, d: Vec3) -> f32 {
    let (o, d) = (wide(o), wide(d));
    let [a, b, c] = t.map(|v| minus(wide(v), o));
    let (e, f) = (minus(b, a), minus(c, a));
    let normal = [
        e[1] * f[2] - e[2] * f[1],
        e[2] * f[0] - e[0] * f[2],
        e[0] * f[1] - e[1] * f[0],
    ];
    let plane = dot(normal, a) / dot(normal, d);
    // If the plane is seen nearly edge-on, its intersection may be far from where the ray passes
    // the triangle.
    let square = dot(d, d);
    let ends = [a, b, c].map(|v| dot(v, d) / square);
    let first = ends[0].min(ends[1]).min(ends[2]);
    let last = ends[0].max(ends[1]).max(ends[2]);
    match plane.is_nan() {
        true => f32::NAN,
        false => plane.clamp(first, last) as f32,
    }
}

#[cfg(test)]
#[path = "needle/tests.rs"]
mod tests;
