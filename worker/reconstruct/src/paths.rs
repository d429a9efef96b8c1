//! The light paths between seen surface points and spots: secondary rays, whose transmittance the shadow masks tell.

use picofarm_scene::Vec3;

use crate::{Depth, Measured};

/// Left out at both ends of a lit path, metres: the surfaces there are no obstacles.
pub const MARGIN_LIT_M: f32 = 0.08;
/// Left out where a shadowed path leaves its surface point, metres: what stands on a surface may cast the shadow.
pub const MARGIN_SHADOW_M: f32 = 0.03;
/// Paths that meet the surface at either end at less than this cosine tell nothing: a surface that faces away is dark by
/// itself, and a path along a wall runs through the wall's voxels.
const GRAZING: f32 = 0.08;

/// The part of a light path that the mask tells of.
#[derive(Debug, Clone, Copy)]
pub struct LightPath {
    /// Surface point, metres.
    pub origin: Vec3,
    /// Unit direction to the spot.
    pub direction: Vec3,
    /// Distances from the origin between which light is free or stopped, metres.
    pub span: (f32, f32),
    /// Whether light came through.
    pub lit: bool,
}

/// The light paths of a measurement.
#[derive(Debug, Clone)]
pub struct Paths<'a> {
    measured: &'a Measured,
    points: Vec<Vec3>,
    normals: &'a [Vec3],
    /// Normal of the surface that each spot lies on; zero where unknown.
    spot_normals: Vec<Vec3>,
}

impl<'a> Paths<'a> {
    /// Of depths in the camera's frame.
    pub fn new(measured: &'a Measured, depth: &'a Depth) -> Self {
        let camera = &measured.camera;
        let points = (0..measured.pixels())
            .map(|p| camera.origin + measured.ray(p) * depth.range[p])
            .collect();
        let i = &camera.intrinsics;
        let normal_at = |point: Vec3| {
            let q = camera.to_camera(point);
            let (u, v) = (i.fx * q.x / q.z + i.cx, i.fy * q.y / q.z + i.cy);
            let inside =
                q.z > 0.0 && u >= 0.0 && v >= 0.0 && u < i.width as f32 && v < i.height as f32;
            // Times next to a spot are unknown: the normals of pixels around are asked.
            let (u, v) = (u as i64, v as i64);
            let reach = i64::from(i.width / 12 + 2);
            let near = (0..=reach).flat_map(|r| [(r, 0), (-r, 0), (0, r), (0, -r)]);
            near.filter(|_| inside)
                .map(|(a, b)| (u + a, v + b))
                .filter(|&(a, b)| {
                    a >= 0 && b >= 0 && a < i64::from(i.width) && b < i64::from(i.height)
                })
                .map(|(a, b)| depth.normal[(b * i64::from(i.width) + a) as usize])
                .find(|n| *n != Vec3::ZERO)
                .unwrap_or(Vec3::ZERO)
        };
        let spot_normals = measured.spots.iter().map(|s| normal_at(s.point)).collect();
        Self {
            measured,
            points,
            normals: &depth.normal,
            spot_normals,
        }
    }

    /// Number of spots.
    pub fn spots(&self) -> usize {
        self.measured.spots.len()
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.points.len()
    }

    /// What light loses on the way from a spot to a pixel's surface by geometry: cos · cos / r², 1/m², for matt surfaces. `None`
    /// where depth or a normal is unknown, or the path tells nothing.
    pub fn geometry(&self, spot: usize, pixel: usize) -> Option<f32> {
        let (here, there) = (self.normals[pixel], self.spot_normals[spot]);
        let way = self.measured.spots[spot].point - self.points[pixel];
        let square = way.dot(way);
        let direction = way / libm::sqrtf(square);
        let (a, b) = (here.dot(direction), -there.dot(direction));
        let known = a.min(b) >= GRAZING && square.is_finite();
        known.then(|| a * b / square)
    }

    /// Whether the path meets a surface, whose normal is known, at so small an angle that it tells nothing.
    #[inline]
    pub fn grazes(&self, spot: usize, pixel: usize) -> bool {
        let (here, there) = (self.normals[pixel], self.spot_normals[spot]);
        let way = self.measured.spots[spot].point - self.points[pixel];
        let direction = way / way.length();
        let grazes = |n: Vec3, w: Vec3| n != Vec3::ZERO && n.dot(w) < GRAZING;
        grazes(here, direction) || grazes(there, -direction)
    }

    /// Path of light laser → spot → what a pixel sees → camera, metres; NaN where depth is unknown.
    pub fn length(&self, spot: usize, pixel: usize) -> f32 {
        let (x, spot) = (self.points[pixel], &self.measured.spots[spot]);
        spot.path_m + (x - spot.point).length() + (x - self.measured.camera.origin).length()
    }

    /// Normals of what a pixel sees and of what a spot lies on; zero where unknown.
    pub fn normals(&self, spot: usize, pixel: usize) -> (Vec3, Vec3) {
        (self.normals[pixel], self.spot_normals[spot])
    }

    /// The path from what a pixel sees to a spot; `None` where it tells nothing.
    #[inline]
    pub fn get(&self, spot: usize, pixel: usize) -> Option<LightPath> {
        let q = spot * self.points.len() + pixel;
        let origin = self.points[pixel];
        if self.measured.used[q] == 0 || !origin.is_finite() {
            return None;
        }
        let way = self.measured.spots[spot].point - origin;
        let length = way.length();
        let direction = way / length;
        let lit = self.measured.lit[q] != 0;
        let margin = if lit { MARGIN_LIT_M } else { MARGIN_SHADOW_M };
        let span = (margin, length - MARGIN_LIT_M);
        if span.0 >= span.1 {
            return None;
        }
        if self.grazes(spot, pixel) {
            return None;
        }
        Some(LightPath {
            origin,
            direction,
            span,
            lit,
        })
    }
}
