//! The light paths between visible surface points and spots: secondary rays, with transmittances
//! known from the shadow masks.

use picofarm_scene::Vec3;

use crate::{Depth, Measured};

/// The length omitted at both ends of a lit path, metres: the surfaces there are not obstacles.
pub const MARGIN_LIT_M: f32 = 0.08;
/// The length omitted at the surface point of a shadowed path, metres. It is short because an
/// object on the surface may cast the shadow.
pub const MARGIN_SHADOW_M: f32 = 0.03;
/// The least cosine between a path and the surface normal at either end. Paths at smaller angles
/// are not evidence: a surface that faces away is dark by itself, and a path along a wall runs
/// through the wall's voxels.
const GRAZING: f32 = 0.08;

/// The part of a light path that the mask describes.
#[derive(Debug, Clone, Copy)]
pub struct LightPath {
    /// The surface point, metres.
    pub origin: Vec3,
    /// The unit direction to the spot.
    pub direction: Vec3,
    /// The distances from the origin between which light passes or is stopped, metres.
    pub span: (f32, f32),
    /// Whether light arrived.
    pub lit: bool,
}

/// The light paths of a measurement.
#[derive(Debug, Clone)]
pub struct Paths<'a> {
    measured: &'a Measured,
    points: Vec<Vec3>,
    normals: &'a [Vec3],
    /// The normal of the surface at each spot; zero if unknown.
    spot_normals: Vec<Vec3>,
}

impl<'a> Paths<'a> {
    /// Creates the light paths for depths in the camera's frame.
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
            // Times next to a spot are unknown, so the normals of surrounding pixels are used.
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

    /// Returns the number of spots.
    pub fn spots(&self) -> usize {
        self.measured.spots.len()
    }

    /// Returns the number of pixels.
    pub fn pixels(&self) -> usize {
        self.points.len()
    }

    /// Returns the geometric attenuation of light from a spot to a pixel's surface: cos · cos / r²,
    /// 1/m², for matt surfaces. Returns `None` if depth or a normal is unknown, or if the path is
    /// not evidence.
    pub fn geometry(&self, spot: usize, pixel: usize) -> Option<f32> {
        let (here, there) = (self.normals[pixel], self.spot_normals[spot]);
        let way = self.measured.spots[spot].point - self.points[pixel];
        let square = way.dot(way);
        let direction = way / libm::sqrtf(square);
        let (a, b) = (here.dot(direction), -there.dot(direction));
        let known = a.min(b) >= GRAZING && square.is_finite();
        known.then(|| a * b / square)
    }

    /// Returns whether the path reaches a surface with a known normal at so small an angle that it
    /// is not evidence.
    #[inline]
    pub fn grazes(&self, spot: usize, pixel: usize) -> bool {
        let (here, there) = (self.normals[pixel], self.spot_normals[spot]);
        let way = self.measured.spots[spot].point - self.points[pixel];
        let direction = way / way.length();
        let grazes = |n: Vec3, w: Vec3| n != Vec3::ZERO && n.dot(w) < GRAZING;
        grazes(here, direction) || grazes(there, -direction)
    }

    /// Returns the path of light laser → spot → visible surface → camera, metres; NaN if depth is
    /// unknown.
    pub fn length(&self, spot: usize, pixel: usize) -> f32 {
        let (x, spot) = (self.points[pixel], &self.measured.spots[spot]);
        spot.path_m + (x - spot.point).length() + (x - self.measured.camera.origin).length()
    }

    /// Returns the normals at a pixel's visible surface and at a spot; zero if unknown.
    pub fn normals(&self, spot: usize, pixel: usize) -> (Vec3, Vec3) {
        (self.normals[pixel], self.spot_normals[spot])
    }

    /// Returns the path from a pixel's visible surface to a spot, or `None` if it is not evidence.
    #[inline]
    pub fn get(&self, spot: usize, pixel: usize) -> Option<LightPath> {
        let q = spot * self.points.len() + pixel;
        let origin = self.points[pixel];
        if self.measured.used[q] == 0 || !self.measured.is_evident(pixel) || !origin.is_finite() {
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
