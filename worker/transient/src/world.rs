//! The scene as the renderer sees it: one soup of triangles in *render units*.
//!
//! The camera is at the origin, and lengths are scaled by a power of two so that the scene is a few
//! units wide. Every offset therefore adapts to the scale, and results follow the physical law for
//! scenes of any size and position.

use std::sync::Arc;

use picofarm_scene::{Camera, Material, Scene, Texture, Vec3};

use crate::{
    api::{RenderError, Stop},
    bsdf::Surface,
    bvh::{Bvh, Stack, is_needle, normal},
    extent::{self, Point, wide},
    fresnel::Body,
    glass::{Crossing, Panes},
    rng::Rng,
    spectra::{self, Texels},
};

/// The largest distance of vertices and laser from the camera, and the smallest reach of a scene,
/// metres. Within these limits every product of lengths fits an f32.
const WIDEST_M: f64 = 1e9;
const NARROWEST_M: f64 = 1e-6;

/// The maximum number of pieces that cutting may add, beyond one per triangle. A piece takes some
/// hundred bytes.
const MOST_PIECES: usize = 1 << 22;

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
    textures: Vec<Option<Arc<Texture>>>,
    uv: Vec<[[f32; 2]; 3]>,
    /// Laser position, render units.
    pub laser: Vec3,
    /// Render units per metre: a power of two.
    pub scale: f32,
    /// Diagonal of the box around everything that the camera and the light reach, render units.
    pub diagonal: f32,
    /// The largest distance from the camera, in render units, at which a surface can scatter light
    /// that counts.
    horizon: f32,
    /// The camera (its origin is the origin of render units).
    pub camera: Camera,
    /// Side of the sensitive square in the middle of each pixel, as a fraction of the pixel's side.
    pub sensitive: f32,
    /// Thin glass. Its triangles are not among `triangles`.
    pub panes: Option<Panes>,
    /// Glass bodies by surface index; empty if there are none.
    bodies: Vec<Option<Body>>,
    /// What texels do to surfaces at the wavelength asked for, by surface index; empty without one.
    texels: Vec<Option<Texels>>,
}

/// A point on a surface, seen from somewhere.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hit {
    /// Position, render units.
    pub p: Vec3,
    /// Unit geometric normal on the side the ray came from.
    pub n: Vec3,
    /// Triangle index.
    pub triangle: u32,
    /// Scattering; black if the ray hit the back of a one-sided surface.
    pub surface: Surface,
    /// Fraction of light that glass transmits along the ray that found this hit; 1 without glass.
    pub through: f32,
}

impl Hit {
    /// Settles a mix on one of its parts where one is too narrow for pixels to share its vertices,
    /// so that each path is of one kind: by way of a near-mirror's lobe, or of others. A mix of
    /// wide lobes stays: its vertices scatter by both.
    #[inline(always)]
    pub fn choose_lobe(&mut self, rng: &mut Rng) {
        if self.surface.is_open() {
            self.settle(rng);
        }
    }

    #[cold]
    fn settle(&mut self, rng: &mut Rng) {
        self.surface = self.surface.lobe(rng.uniform());
    }
}

impl World {
    /// Returns a world in which light counts that travels up to `horizon_m`.
    ///
    /// # Errors
    /// Returns [`RenderError::Invalid`] if the scene is too wide or too small to be represented in
    /// f32.
    pub fn new(scene: &Scene, horizon_m: f64, stop: Stop) -> Result<Self, RenderError> {
        Self::at(scene, None, horizon_m, stop)
    }

    /// The same at a wavelength, nanometres; without one, at that of the scene's reflectances.
    ///
    /// # Errors
    /// Those of [`World::new`].
    pub fn at(
        scene: &Scene,
        wavelength_nm: Option<f64>,
        horizon_m: f64,
        stop: Stop,
    ) -> Result<Self, RenderError> {
        let mut texels = vec![];
        let origin = scene.camera.origin;
        let centre = wide(origin);
        let count: usize = scene.objects.iter().map(|o| o.mesh.triangles.len()).sum();
        let mut points = Vec::with_capacity(count);
        let (mut surface, mut object) = (Vec::with_capacity(count), Vec::with_capacity(count));
        // The glass triangles and their materials.
        let (mut panes, mut glass): (Vec<[Point; 3]>, Vec<&Material>) = (vec![], vec![]);
        let (mut surfaces, mut material, mut rgb) = (vec![], vec![], vec![]);
        let mut bodies = vec![];
        let textured = |m: &Material| m.texture.is_some();
        let textured = scene
            .objects
            .iter()
            .any(|o| o.mesh.materials.iter().any(textured));
        let (mut textures, mut uv, mut first_surface) = (vec![], vec![], vec![]);
        for (index, o) in scene.objects.iter().enumerate() {
            stop.check()?;
            let first = surfaces.len() as u32;
            first_surface.push(first);
            for (k, m) in o.mesh.materials.iter().enumerate() {
                surfaces.push(match wavelength_nm {
                    None => Surface::new(m),
                    Some(nm) => {
                        let (surface, of_texels) = spectra::at(m, nm);
                        texels.push(of_texels);
                        surface
                    }
                });
                bodies.push(Body::new(m));
                material.push(k as u32);
                rgb.push(m.rgb);
                textures.push(m.texture.clone());
            }
            let rows = o.to_world.linear.map(wide);
            let shift = wide(o.to_world.translation);
            // Positions are f64 until the camera position is subtracted, which keeps precision in
            // scenes far from the origin.
            let place = |p: Vec3| {
                let p = wide(p);
                std::array::from_fn(|r| {
                    rows[r][0] * p[0] + rows[r][1] * p[1] + rows[r][2] * p[2] + shift[r] - centre[r]
                })
            };
            let placed: Vec<[f64; 3]> = o.mesh.positions.iter().map(|&p| place(p)).collect();
            for (t, &m) in o.mesh.triangles.iter().zip(&o.mesh.triangle_material) {
                let material = &o.mesh.materials[m as usize];
                if material.is_glass() {
                    panes.push(t.map(|v| placed[v as usize]));
                    glass.push(material);
                    continue;
                }
                points.push(t.map(|v| placed[v as usize]));
                if textured {
                    uv.push(t.map(|v| o.mesh.uv.get(v as usize).copied().unwrap_or_default()));
                }
                surface.push(first + m);
                object.push(index as u32);
            }
        }
        let widest = points
            .iter()
            .chain(&panes)
            .flatten()
            .flatten()
            .fold(0.0f64, |a, x| a.max(x.abs()));
        let laser = wide(scene.laser.origin - origin);
        let reach = laser.iter().fold(widest, |a, x| a.max(x.abs()));
        if reach > WIDEST_M || (widest > 0.0 && widest < NARROWEST_M) {
            return Err(RenderError::Invalid {
                field: "objects".into(),
                what: format!(
                    "reach {reach:e} m from the camera, expected {NARROWEST_M:e} to {WIDEST_M:e}; check the scene's unit and remove stray vertices"
                ),
            });
        }
        let reach = extent::reach(scene, &points, (widest, horizon_m), stop)?;
        // The camera may almost touch a surface. The pieces of a far wider scene would then
        // overflow an f32.
        let reach = reach.max(NARROWEST_M.min(widest));
        let scale = scale_for(reach);
        let mut normals = None;
        if reach < widest {
            let cut = Cut::of(&points, &uv, (reach, widest, scale), stop)?;
            let of = |all: &[u32]| cut.of.iter().map(|&k| all[k]).collect();
            (surface, object) = (of(&surface), of(&object));
            (points, uv, normals) = (cut.points, cut.uv, Some(cut.normals));
            let cut = Cut::of(&panes, &[], (reach, widest, scale), stop)?;
            glass = cut.of.iter().map(|&k| glass[k]).collect();
            panes = cut.points;
        }
        let unit = |p: Point| Vec3::from(p.map(|x| (x * f64::from(scale)) as f32));
        let triangles: Vec<[Vec3; 3]> = points.iter().map(|t| t.map(unit)).collect();
        // Free the points before the tree is built, because the tree takes as much memory again.
        drop(points);
        let panes: Vec<[Vec3; 3]> = panes.iter().map(|t| t.map(unit)).collect();
        let normals = normals.unwrap_or_else(|| {
            let each = triangles.iter();
            each.map(|t| normal(t).unwrap_or_default()).collect()
        });
        let edge = (reach * f64::from(scale)) as f32;
        let inside = |p: &Vec3| p.x.abs().max(p.y.abs()).max(p.z.abs()) <= edge;
        let corners = || triangles.iter().flatten().copied().filter(inside);
        let low = corners().fold(Vec3::ZERO, Vec3::min);
        let high = corners().fold(Vec3::ZERO, Vec3::max);
        Ok(Self {
            bvh: Bvh::build_unless(&triangles, stop)?,
            triangles,
            normals,
            surface,
            object,
            surfaces,
            first_surface,
            material,
            rgb,
            textures: if textured { textures } else { vec![] },
            uv,
            laser: (scene.laser.origin - origin) * scale,
            scale,
            diagonal: (high - low).length().max(edge),
            horizon: (horizon_m * f64::from(scale)) as f32,
            camera: scene.camera,
            sensitive: 1.0,
            panes: Panes::new(&panes, &glass, stop)?,
            bodies: match bodies.iter().any(Option::is_some) {
                true => bodies,
                false => vec![],
            },
            texels,
        })
    }

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
    pub fn on(&self, triangle: u32, p: Vec3, from: Vec3) -> Hit {
        let front = self.normals[triangle as usize].dot(from - p) >= 0.0;
        self.hit(triangle, p, front)
    }

    #[inline(always)]
    fn hit(&self, id: u32, p: Vec3, front: bool) -> Hit {
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
    fn texel(&self, triangle: u32, p: Vec3) -> Option<[f32; 3]> {
        let i = triangle as usize;
        let texture = self.textures.get(self.surface[i] as usize)?.as_ref()?;
        let [u, v, w] = self.barycentric(triangle, p);
        let [a, b, c] = self.uv[i];
        let at = |k: usize| a[k] * u + b[k] * v + c[k] * w;
        Some(texture.at([at(0), at(1)]))
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

/// The triangles after those that are far too wide have been cut.
#[derive(Default)]
struct Cut {
    points: Vec<[Point; 3]>,
    uv: Vec<[[f32; 2]; 3]>,
    normals: Vec<Vec3>,
    /// Index of the triangle that each piece was cut from.
    of: Vec<usize>,
}

impl Cut {
    /// Cuts all triangles. `uv` is empty without texture coordinates.
    fn of(
        points: &[[Point; 3]],
        uv: &[[[f32; 2]; 3]],
        (reach, widest, scale): (f64, f64, f32),
        stop: Stop,
    ) -> Result<Self, RenderError> {
        let mut cut = Self::default();
        for (k, t) in points.iter().enumerate() {
            if k % 1024 == 0 {
                stop.check()?;
            }
            cut.push(k, t, uv.get(k), f64::from(scale));
            if cut.points.len() > 2 * points.len() + MOST_PIECES {
                return Err(RenderError::Invalid {
                    field: "objects".into(),
                    what: format!(
                        "too many triangles reach far beyond what camera and light do ({reach:.3e} m of {widest:.3e} m): cut there, the first {} of {} make {} pieces; remove large surfaces that are out of sight, or check where the camera stands",
                        k + 1,
                        points.len(),
                        cut.points.len(),
                    ),
                });
            }
        }
        Ok(cut)
    }

    fn push(&mut self, k: usize, t: &[Point; 3], uv: Option<&[[f32; 2]; 3]>, scale: f64) {
        let unit = |p: Point| Vec3::from(p.map(|x| (x * scale) as f32));
        let corner = |i: usize| (t[i], uv.map_or([0.0; 2], |uv| uv[i].map(f64::from)));
        let pieces = extent::cut([0, 1, 2].map(corner), scale);
        let normal = match &pieces {
            None => normal(&t.map(unit)),
            Some(_) => extent::normal(t),
        };
        for piece in pieces.unwrap_or_else(|| vec![[0, 1, 2].map(corner)]) {
            self.points.push(piece.map(|c| c.0));
            if uv.is_some() {
                self.uv.push(piece.map(|c| c.1.map(|x| x as f32)));
            }
            self.normals.push(normal.unwrap_or_default());
            self.of.push(k);
        }
    }
}

/// Returns the power of two that scales `widest` into [4, 8).
fn scale_for(widest: f64) -> f32 {
    if widest == 0.0 {
        return 1.0;
    }
    let mut scale = 1.0f64;
    while widest * scale >= 8.0 {
        scale *= 0.5;
    }
    while widest * scale < 4.0 {
        scale *= 2.0;
    }
    scale as f32
}

/// Returns the hit point from barycentric coordinates, with the same shear as the traversal. It is
/// on the triangle to the last bits for any distance of the ray's origin.
#[inline]
pub(crate) fn point(t: &[Vec3; 3], o: Vec3, d: Vec3) -> Vec3 {
    let n = Vec3::new(d.x.abs(), d.y.abs(), d.z.abs());
    let kz = if n.z >= n.x && n.z >= n.y {
        2
    } else if n.y >= n.x {
        1
    } else {
        0
    };
    let (kx, ky) = ((kz + 1) % 3, (kz + 2) % 3);
    let (sx, sy) = (d[kx] / d[kz], d[ky] / d[kz]);
    let [a, b, c] = t.map(|v| {
        let v = v - o;
        (v[kx] - sx * v[kz], v[ky] - sy * v[kz])
    });
    let u = c.0 * b.1 - c.1 * b.0;
    let v = a.0 * c.1 - a.1 * c.0;
    let w = b.0 * a.1 - b.1 * a.0;
    let det = u + v + w;
    let size = |p: f32, q: f32, r: f32| p.abs().max(q.abs()).max(r.abs());
    let whole = size(a.0, b.0, c.0) * size(a.1, b.1, c.1);
    if det.abs() * SLIM < whole && is_needle(t) {
        return needle_point(t, o, d);
    }
    let k = 1.0 / det;
    let (u, v) = (u * k, v * k);
    t[0] * u + t[1] * v + t[2] * (1.0 - u - v)
}

/// [`point`] tests whether a triangle is a needle if its area is smaller than the square around it
/// by more than this factor.
const SLIM: f32 = 8.0;

/// [`point`] in f64, for triangles on which an f32 result would be off by some millimetres along
/// the triangle.
#[cold]
fn needle_point(t: &[Vec3; 3], o: Vec3, d: Vec3) -> Vec3 {
    let (o, d) = (wide(o), wide(d));
    let minus = |a: Point, b: Point| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    let cross = |a: Point, b: Point| {
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    };
    let dot = |a: Point, b: Point| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let corners = t.map(wide);
    let [a, b, c] = corners.map(|v| minus(v, o));
    // Volumes with the ray's direction, which are proportional to the barycentric coordinates.
    let all = [
        dot(d, cross(c, b)),
        dot(d, cross(a, c)),
        dot(d, cross(b, a)),
    ];
    let sum = all[0] + all[1] + all[2];
    let at = |k: usize| {
        let each = all.iter().zip(&corners);
        (each.map(|(share, v)| share * v[k]).sum::<f64>() / sum) as f32
    };
    Vec3::new(at(0), at(1), at(2))
}

/// Returns a point moved off its surface by a few units in the last place, along `n` (Wächter and
/// Binder, Ray Tracing Gems, chapter 6).
///
/// The offset is enough that a ray does not hit the surface it starts from, and too little to pass
/// through anything. It is never less than 2⁻¹⁸, because triangles extend to 8 units and are
/// rounded accordingly. With a quarter of this offset, rays that graze tilted planes occasionally
/// hit their own plane; with this offset they never do. The offset is not larger, because objects
/// close to a spot cast their shadow from the lifted position (1 cm from a step of 2 cm, 256 units
/// gave 0.08 % too much light).
#[inline]
pub(crate) fn lift(p: Vec3, n: Vec3) -> Vec3 {
    let axis = |p: f32, n: f32| {
        if p.abs() < 0.5 {
            return p + n * (1.0 / 262144.0);
        }
        let steps = (64.0 * n) as i32;
        let bits = p.to_bits() as i32;
        f32::from_bits(bits.wrapping_add(if p < 0.0 { -steps } else { steps }) as u32)
    };
    Vec3::new(axis(p.x, n.x), axis(p.y, n.y), axis(p.z, n.z))
}

#[cfg(test)]
#[path = "world/tests.rs"]
mod tests;
