//! The shells of a tile: where vertices of paths within a narrow gate are.

use picofarm_scene::Vec3;

use crate::{
    api::Gate,
    numeric::rng::Rng,
    paths::{
        ellipsoid::{patches::Patches, window::Window},
        vertex::Vertex,
    },
    scene::{hit::Hit, world::World},
};

/// Number of gather points that represent a tile for its shells.
const STANDINS: usize = 8;

/// Largest difference between a path via a patch and the path via its centre, in radii of the
/// patch. It is at most 2, and less if the patch is seen at an angle.
const SWELL: f32 = 1.2;

/// The shells of one tile.
#[derive(Debug, Default)]
pub(crate) struct Shells {
    /// The gather points: position, and optical path to the camera, render units.
    points: Vec<(Vec3, f32)>,
    /// The point that the drawn sides of surfaces face.
    towards: Vec3,
    /// By patch: shortest and longest path beyond it.
    near: Vec<f32>,
    far: Vec<f32>,
    /// By patch: approximate share of its flux that reaches the gather points, negative on its
    /// back.
    seen: Vec<f32>,
    /// By patch: share of the paths that fall into the gate, weighted by flux; later the expected
    /// number of vertices per area.
    density: Vec<f32>,
    /// Patches in the shells, with the sum of weights up to and including each.
    chosen: Vec<(u32, f64)>,
}

impl Shells {
    /// Computes the shells for a tile's gather points.
    pub fn lay(
        &mut self,
        (world, patches, gate): (&World, &Patches, &Gate),
        gathers: &[(Vertex, usize)],
        count: u32,
    ) {
        let scale = f64::from(world.scale);
        self.points.clear();
        self.points.extend(
            gathers
                .iter()
                .map(|(v, _)| (v.hit.p, (v.length_m * scale) as f32)),
        );
        self.towards =
            self.points.iter().fold(Vec3::ZERO, |a, x| a + x.0) / self.points.len().max(1) as f32;
        self.reach(patches, gathers);
        let patches_count = patches.len();
        let (start, end) = ((gate.start_m * scale) as f32, (gate.end_m() * scale) as f32);
        self.density.clear();
        self.density.resize(patches_count, 0.0);
        let rows = patches.path.chunks_exact(patches_count.max(1));
        for (path, flux) in rows.zip(patches.flux.chunks_exact(patches_count.max(1))) {
            let near = &self.near[..patches_count];
            let (far, seen) = (&self.far[..patches_count], &self.seen[..patches_count]);
            for (k, sum) in self.density.iter_mut().enumerate() {
                let (a, b) = (path[k] + near[k], path[k] + far[k]);
                let inside = (b.min(end) - a.max(start)).max(0.0) / (b - a);
                *sum += inside * (flux[k] * seen[k]).max(0.0);
            }
        }
        self.chosen.clear();
        let mut total = 0.0f64;
        for (k, (&w, &area)) in self.density.iter().zip(&patches.area).enumerate() {
            if w > 0.0 {
                total += f64::from(w) * f64::from(area);
                self.chosen.push((k as u32, total));
            }
        }
        let each = if total > 0.0 {
            (f64::from(count) / total) as f32
        } else {
            0.0
        };
        for w in &mut self.density {
            *w *= each;
        }
    }

    /// Computes the path length from every patch via the gather points to the camera, and the flux
    /// that the gather points receive from it.
    fn reach(&mut self, patches: &Patches, gathers: &[(Vertex, usize)]) {
        let count = patches.len();
        for column in [&mut self.near, &mut self.far, &mut self.seen] {
            column.clear();
            column.resize(count, 0.0);
        }
        self.near.fill(f32::MAX);
        let [cx, cy, cz] = patches.centre.each_ref().map(|c| &c[..count]);
        let [nx, ny, nz] = patches.normal.each_ref().map(|c| &c[..count]);
        let radius = &patches.radius[..count];
        let standins = STANDINS.min(gathers.len());
        for s in 0..standins {
            let at = (2 * s + 1) * gathers.len() / (2 * standins);
            let (x, length) = self.points[at];
            let n = gathers[at].0.hit.n;
            let lambert = if gathers[at].0.hit.surface.diffuse() {
                1.0
            } else {
                0.0
            };
            let (near, far) = (&mut self.near[..count], &mut self.far[..count]);
            for k in 0..count {
                let (dx, dy, dz) = (x.x - cx[k], x.y - cy[k], x.z - cz[k]);
                let d2 = dx * dx + dy * dy + dz * dz;
                let d = d2.sqrt();
                near[k] = near[k].min(length + d);
                far[k] = far[k].max(length + d);
                let r = radius[k];
                let above = r - (n.x * dx + n.y * dy + n.z * dz);
                let cos = (above / (d + r)).max(0.0);
                let cos = lambert * cos + (1.0 - lambert) * if cos > 0.0 { 0.5 } else { 0.0 };
                let side = nx[k] * dx + ny[k] * dy + nz[k] * dz;
                let flat = nx[k] * nx[k] + ny[k] * ny[k] + nz[k] * nz[k];
                let side = if flat > 0.0 { side / d.max(1e-6) } else { 0.5 };
                self.seen[k] += cos * side / (d2 + r * r);
            }
        }
        for (k, &radius) in radius.iter().enumerate() {
            let more = SWELL * radius + 0.125 * (self.far[k] - self.near[k]) + 1e-6;
            self.near[k] -= more;
            self.far[k] += more;
            if patches.one_sided[k] {
                self.seen[k] = self.seen[k].max(0.0);
            }
        }
    }

    /// Draws a vertex. `at` in [0, 1) selects the patch. Returns `None` if no patch is in the
    /// shells, or if the surface scatters nothing there.
    pub fn draw(
        &self,
        (world, patches): (&World, &Patches),
        at: f64,
        rng: &mut Rng,
    ) -> Option<Hit> {
        let (_, total) = *self.chosen.last()?;
        let k = self.chosen.partition_point(|c| c.1 <= at * total);
        let patch = self.chosen[k.min(self.chosen.len() - 1)].0 as usize;
        let range = patches.first[patch] as usize..patches.first[patch + 1] as usize;
        let pieces = &patches.pieces[range];
        let area = rng.uniform() * patches.area[patch];
        let k = pieces.partition_point(|p| p.upto <= area);
        let piece = &pieces[k.min(pieces.len() - 1)];
        let [a, b, c] = piece.corners;
        let (r, v) = (rng.uniform().sqrt(), rng.uniform());
        let p = a * (1.0 - r) + b * (r * (1.0 - v)) + c * (r * v);
        let hit = world.on(piece.triangle, p, self.towards);
        (!hit.surface.is_black()).then_some(hit)
    }

    /// Returns the expected number of vertices drawn per area at a point.
    #[inline]
    pub fn density(&self, (world, patches): (&World, &Patches), h: &Hit) -> f32 {
        if h.n.dot(self.towards - h.p) <= 0.0 {
            return 0.0;
        }
        let patch = patches.at(h.triangle, world.barycentric(h.triangle, h.p));
        patch.map_or(0.0, |k| self.density[k])
    }

    /// Returns the window of paths up to `y` that can fall into the gate via a gather point,
    /// computed as if every path continued for `nearest` metres.
    pub fn window(&self, world: &World, gate: &Window, y: Vec3, nearest: f64) -> Window {
        let (mut near, mut far) = (f32::MAX, 0.0f32);
        for &(x, length) in &self.points {
            let d = length + (x - y).length();
            (near, far) = (near.min(d), far.max(d));
        }
        Window {
            start_m: gate.start_m - (world.metres(far) - nearest),
            end_m: gate.end_m - (world.metres(near) - nearest),
        }
    }
}
