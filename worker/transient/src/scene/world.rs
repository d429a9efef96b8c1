//! The scene as the renderer sees it: one soup of triangles in *render units*.
//!
//! The camera is at the origin, and lengths are scaled by a power of two so that the scene is a few
//! units wide. Every offset therefore adapts to the scale, and results follow the physical law for
//! scenes of any size and position.

use std::sync::Arc;

use picofarm_scene::{Camera, Texture, Vec3};

use crate::scene::{
    bvh::tree::{Bvh, Stack},
    fresnel::Body,
    hit::Hit,
    intersection::{lift, point},
    panes::{Crossing, Panes},
    spectra::Texels,
    surface::Surface,
};

/// Geometry, materials and camera in render units.
#[derive(Debug)]
pub(crate) struct World {
    /// The hierarchy over `triangles`.
    pub bvh: Bvh,
    /// Vertices, render units.
    pub triangles: Vec<[Vec3; 3]>,
    /// Unit geometric normals; zero for triangles without area, which are never hit.
    pub normals: Vec<Vec3>,
    /// Index into `surfaces`, by triangle.
    pub surface: Vec<u32>,
    /// Object index, by triangle.
    pub object: Vec<u32>,
    /// Scattering by surface index.
    pub surfaces: Vec<Surface>,
    /// Index into `surfaces` of every object's first material.
    pub first_surface: Vec<u32>,
    /// Material index in its mesh, by surface index.
    pub material: Vec<u32>,
    /// Linear RGB albedo by surface index.
    pub rgb: Vec<[f32; 3]>,
    /// Textures by surface index and texture coordinates by triangle. Both are empty if the scene
    /// has no textures.
    pub textures: Vec<Option<Arc<Texture>>>,
    pub uv: Vec<[[f32; 2]; 3]>,
    /// Laser position, render units.
    pub laser: Vec3,
    /// Render units per metre: a power of two.
    pub scale: f32,
    /// Diagonal of the box around everything that the camera and the light reach, render units.
    pub diagonal: f32,
    /// The largest distance from the camera, in render units, at which a surface can scatter light
    /// that counts.
    pub horizon: f32,
    /// The camera (its origin is the origin of render units).
    pub camera: Camera,
    /// Side of the sensitive square in the middle of each pixel, as a fraction of the pixel's side.
    pub sensitive: f32,
    /// Thin glass. Its triangles are not among `triangles`.
    pub panes: Option<Panes>,
    /// Glass bodies by surface index; empty if there are none.
    pub bodies: Vec<Option<Body>>,
    /// Effect of texels at the laser's wavelength, by surface index; empty without a wavelength.
    pub texels: Vec<Option<Texels>>,
}

impl World {
    /// The body of glass that a triangle bounds.
    #[inline]
    pub fn body(&self, triangle: u32) -> Option<Body> {
        *self.bodies.get(self.surface[triangle as usize] as usize)?
    }

    /// Returns whether there are glass bodies.
    pub fn has_bodies(&self) -> bool {
        !self.bodies.is_empty()
    }

    /// Returns the first surface along a unit direction, and fills `crossings` with the panes
    /// before it in order. If there is no surface, the panes up to the end of the scene are
    /// returned.
    pub fn ahead(
        &self,
        stack: &mut Stack,
        from: Vec3,
        w: Vec3,
        crossings: &mut Vec<Crossing>,
    ) -> Option<Hit> {
        let hit = self.first(stack, from, w);
        self.across(stack, (from, w), hit.as_ref(), crossings);
        hit
    }

    /// Finds the panes between a point and the hit seen from there.
    pub fn across(
        &self,
        stack: &mut Stack,
        (from, w): (Vec3, Vec3),
        hit: Option<&Hit>,
        crossings: &mut Vec<Crossing>,
    ) {
        crossings.clear();
        if let Some(panes) = &self.panes {
            let to = match hit {
                Some(hit) => lift(hit.p, hit.n),
                None => from + w * (2.0 * self.diagonal + from.length()),
            };
            panes.crossings(stack, from, to, crossings);
        }
    }

    /// Returns the index of refraction around a point. A ray from the point decides: if it hits the
    /// surface of a body from within, the index is that of the body.
    pub fn medium(&self, stack: &mut Stack, origin: Vec3, direction: Vec3) -> f32 {
        if !self.has_bodies() {
            return 1.0;
        }
        let hit = self.first(stack, origin, direction);
        let within = |h: &Hit| h.n.dot(self.normals[h.triangle as usize]) < 0.0;
        let body = hit.filter(within).and_then(|h| self.body(h.triangle));
        body.map_or(1.0, |body| body.ior)
    }

    /// Returns whether there is thin glass.
    pub fn has_glass(&self) -> bool {
        self.panes.is_some()
    }

    /// Returns the fraction of light that glass transmits on the straight segment from `a` to `b`;
    /// 1 without glass. Occluding surfaces are ignored.
    #[inline(always)]
    pub fn glass(&self, stack: &mut Stack, a: Vec3, b: Vec3) -> f32 {
        match &self.panes {
            None => 1.0,
            Some(panes) => panes.through(stack, a, b),
        }
    }

    /// Like `glass`, from one point to many. Calls `each` with the index and the transmitted
    /// fraction of every segment that crosses glass.
    #[inline(always)]
    pub fn glass_bundle(
        &self,
        stack: &mut Stack,
        from: Vec3,
        to: &[Vec3],
        each: impl FnMut(usize, f32),
    ) {
        if let Some(panes) = &self.panes {
            panes.through_bundle(stack, from, to, each);
        }
    }

    /// Like `glass`, for red, green and blue.
    pub fn tint(&self, stack: &mut Stack, a: Vec3, b: Vec3) -> [f32; 3] {
        match &self.panes {
            None => [1.0; 3],
            Some(panes) => panes.tint(stack, a, b),
        }
    }

    /// Returns the ray through a point of a pixel's sensitive square. (0, 0) is the upper left
    /// corner of the square, and (1, 1) the lower right one.
    #[inline(always)]
    pub fn camera_ray(&self, (row, col): (u32, u32), (x, y): (f32, f32)) -> Vec3 {
        let (col, row) = (col as f32, row as f32);
        if self.sensitive == 1.0 {
            return self.camera.ray(col + x, row + y);
        }
        let inward = |x: f32| 0.5 + (x - 0.5) * self.sensitive;
        self.camera.ray(col + inward(x), row + inward(y))
    }

    /// Returns the row-major index of the pixel with a sensitive square that sees a direction in
    /// the camera's frame.
    pub fn pixel(&self, q: Vec3) -> Option<usize> {
        if q.z <= 0.0 {
            return None;
        }
        let i = &self.camera.intrinsics;
        let (x, y) = (i.fx * (q.x / q.z) + i.cx, i.fy * (q.y / q.z) + i.cy);
        let inside = x >= 0.0 && y >= 0.0 && x < i.width as f32 && y < i.height as f32;
        let sensed =
            |x: f32| self.sensitive == 1.0 || 2.0 * (x.fract() - 0.5).abs() < self.sensitive;
        (inside && sensed(x) && sensed(y)).then(|| y as usize * i.width as usize + x as usize)
    }

    /// Returns false if all light that scatters on a triangle arrives too late to count.
    pub fn counts(&self, triangle: usize) -> bool {
        self.near(&self.triangles[triangle])
    }

    /// Like `counts`, for any triangle.
    pub fn near(&self, t: &[Vec3; 3]) -> bool {
        let (low, high) = (t[0].min(t[1]).min(t[2]), t[0].max(t[1]).max(t[2]));
        // The distance from the camera, which is the origin, to the nearest point of the bounding
        // box.
        let near = low.max(Vec3::ZERO) + high.min(Vec3::ZERO);
        near.length() <= self.horizon
    }

    /// Returns whether any surface has a lobe too narrow for pixels to share its vertices.
    pub fn has_narrow_lobes(&self) -> bool {
        let narrow = |s: &Surface| !s.is_black() && !s.gloss().is_shared();
        self.surfaces.iter().any(narrow)
    }

    /// Converts world metres to render units.
    pub fn inward(&self, p: Vec3) -> Vec3 {
        (p - self.camera.origin) * self.scale
    }

    /// Converts render units to world metres.
    pub fn outward(&self, p: Vec3) -> Vec3 {
        p / self.scale + self.camera.origin
    }

    /// Converts a length in render units to metres.
    #[inline(always)]
    pub fn metres(&self, length: f32) -> f64 {
        f64::from(length / self.scale)
    }

    /// Returns the first surface from `origin` along `direction` (any length), ignoring glass.
    #[inline]
    pub fn first(&self, stack: &mut Stack, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let (_, id) = self.bvh.closest(stack, origin, direction, f32::INFINITY)?;
        let front = self.normals[id as usize].dot(direction) <= 0.0;
        let p = point(&self.triangles[id as usize], origin, direction);
        Some(self.hit(id, p, front))
    }

    /// Returns the first surface from `origin` along `direction` (any length).
    #[inline]
    pub fn closest(&self, stack: &mut Stack, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let mut hit = self.first(stack, origin, direction)?;
        if self.panes.is_some() {
            hit.through = self.glass(stack, origin, lift(hit.p, hit.n));
        }
        Some(hit)
    }

    /// Returns a point of a triangle as a hit seen from `from`.
    pub fn hit_on(&self, triangle: u32, p: Vec3, from: Vec3) -> Hit {
        let front = self.normals[triangle as usize].dot(from - p) >= 0.0;
        self.hit(triangle, p, front)
    }

    #[inline(always)]
    pub fn hit(&self, id: u32, p: Vec3, front: bool) -> Hit {
        let i = id as usize;
        let geometric = self.normals[i];
        let mut surface = self.surfaces[self.surface[i] as usize];
        if let Some(texel) = self.texel(id, p) {
            let factor = match self.texels.get(self.surface[i] as usize) {
                None => (texel[0] + texel[1] + texel[2]) / 3.0,
                Some(texels) => texels.as_ref().map_or(1.0, |t| t.factor(texel)),
            };
            surface = surface.scaled(factor);
        }
        Hit {
            p,
            n: if front { geometric } else { -geometric },
            triangle: id,
            surface: if front || surface.two_sided() {
                surface
            } else {
                surface.black()
            },
            through: 1.0,
        }
    }

    /// Returns the texture's colour at a point of a triangle, or `None` without a texture.
    #[inline]
    pub fn texel(&self, triangle: u32, p: Vec3) -> Option<[f32; 3]> {
        let i = triangle as usize;
        let texture = self.textures.get(self.surface[i] as usize)?.as_ref()?;
        let [u, v, w] = self.barycentric(triangle, p);
        let [a, b, c] = self.uv[i];
        let mixed = |k: usize| a[k] * u + b[k] * v + c[k] * w;
        Some(texture.at([mixed(0), mixed(1)]))
    }

    /// Returns the barycentric coordinates of a point of a triangle.
    #[inline(always)]
    pub fn barycentric(&self, triangle: u32, p: Vec3) -> [f32; 3] {
        let i = triangle as usize;
        let [a, b, c] = self.triangles[i];
        let n = self.normals[i];
        let area = |a: Vec3, b: Vec3| n.dot((a - p).cross(b - p));
        let (u, v, w) = (area(b, c), area(c, a), area(a, b));
        let whole = 1.0 / (u + v + w);
        [u * whole, v * whole, w * whole]
    }

    /// Returns the linear RGB albedo at a hit.
    pub fn albedo(&self, h: &Hit) -> [f32; 3] {
        let rgb = self.rgb[self.surface[h.triangle as usize] as usize];
        match self.texel(h.triangle, h.p) {
            Some(texel) => std::array::from_fn(|k| rgb[k] * texel[k]),
            None => rgb,
        }
    }

    /// Returns the intersection of the line from `origin` along `direction` with the plane of a
    /// triangle.
    pub fn point(&self, triangle: u32, origin: Vec3, direction: Vec3) -> Vec3 {
        point(&self.triangles[triangle as usize], origin, direction)
    }

    /// Returns the fraction of light that passes on the straight segment between two surface
    /// points: 0 if a surface occludes it, 1 if nothing does. Each end is lifted off its surface
    /// along the given normal, towards the other end.
    #[inline]
    pub fn free(&self, stack: &mut Stack, a: Vec3, na: Vec3, b: Vec3, nb: Vec3) -> f32 {
        let (a, b) = (lift(a, na), lift(b, nb));
        match self.bvh.occluded(stack, a, b - a, 1.0) {
            true => 0.0,
            false => self.glass(stack, a, b),
        }
    }

    /// Returns the fraction of light that passes on the straight segment from the camera to a
    /// surface point.
    pub fn seen(&self, stack: &mut Stack, p: Vec3, n: Vec3) -> f32 {
        let p = lift(p, n);
        match self.bvh.occluded(stack, Vec3::ZERO, p, 1.0) {
            true => 0.0,
            false => self.glass(stack, Vec3::ZERO, p),
        }
    }
}

#[cfg(test)]
#[path = "world/tests.rs"]
mod tests;
