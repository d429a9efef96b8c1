//! Planar near-mirrors: finds them, and aims at the narrow lobes around the spots' mirror images.
//!
//! A surface point x sees a spot s in a mirror of roughness α around one point m₀, in front of the
//! image of s. Over the mirror's plane, the half vector's slope grows linearly around m₀, so a
//! Gaussian in slope (for GGX its own heavy-tailed distribution), mapped to the plane by that
//! linear map, approximates the lobe's own shape. If the approximation is poor (grazing angles,
//! spots at the mirror's foot), MIS with BSDF sampling keeps the estimate unbiased and its variance
//! bounded.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    api::Stop,
    light::{
        columns::{Columns, Irradiance},
        emitters::Emitters,
    },
    numeric::{
        frame::frame,
        lanes::{self, Wide, widest},
        rng::Rng,
    },
    scene::world::World,
};

/// Largest number of planes; a scene with more facets counts as having curved mirrors.
const MAX_MIRRORS: usize = 8;

/// Planes below this share of the whole mirror area are left to plain sampling.
const MIN_SHARE: f64 = 0.02;

/// Factor by which the sampled lobe is wider than the real one, so that the tail is sampled too.
const WIDEN: f32 = 1.2;

/// Margin around the mirror's rectangle within which images still count, in units of the lobe's
/// width.
const MARGIN: f32 = 3.0;

/// One planar mirror and the spots' images behind it.
#[derive(Debug)]
pub(crate) struct Mirror {
    normal: Vec3,
    /// Distance of the plane from the origin along `normal`.
    offset: f32,
    u: Vec3,
    v: Vec3,
    /// Bounds along `u` and `v`.
    low: [f32; 2],
    high: [f32; 2],
    alpha: f32,
    ggx: bool,
    two_sided: bool,
    images: Columns,
    /// Signed distance of each spot from the plane.
    height: Vec<f32>,
}

/// All planar mirrors of a scene.
#[derive(Debug, Default)]
pub(crate) struct Mirrors {
    pub list: Vec<Mirror>,
    /// Mirror of each triangle, `NONE` for most; empty if there are no mirrors.
    of_triangle: Vec<u8>,
    /// Share of the specular area that no plane covers (curved near-mirrors).
    pub curved_share: f64,
    spots: usize,
}

const NONE: u8 = u8::MAX;

/// A sample: the target, the spot and the mirror, and the probability of that choice.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Aim {
    /// Point on the mirror's plane.
    pub target: Vec3,
    /// Mirror index.
    pub mirror: usize,
    /// Emitter index.
    pub spot: usize,
    /// Probability of having chosen this mirror and spot.
    pub chance: f32,
}

/// The linear map between the plane around m₀ and slopes.
struct Shape {
    m0: Vec3,
    t: Vec3,
    s: Vec3,
    jt: f32,
    js: f32,
    sigma: f32,
}

impl Mirrors {
    pub fn find(world: &World, emitters: &Emitters, stop: Stop) -> Self {
        let mut planes: Vec<Plane> = vec![];
        let mut total = 0.0;
        for (i, t) in world.triangles.iter().enumerate() {
            let surface = &world.surfaces[world.surface[i] as usize];
            let n = world.normals[i];
            if !surface.specular() || n == Vec3::ZERO || !world.counts(i) {
                continue;
            }
            if i % 4096 == 0 && stop.asked() {
                break;
            }
            let area = f64::from((t[1] - t[0]).cross(t[2] - t[0]).length()) * 0.5;
            total += area;
            let found = planes.iter().position(|p| {
                let same = p.surface == world.surface[i] && p.normal.dot(n) > 0.999_999;
                same && t.iter().all(|v| (p.normal.dot(*v) - p.offset).abs() < 1e-4)
            });
            match found {
                Some(p) => {
                    planes[p].area += area;
                    planes[p].triangles.push(i as u32);
                }
                None if planes.len() < 4096 => planes.push(Plane {
                    normal: n,
                    offset: n.dot(t[0]),
                    surface: world.surface[i],
                    area,
                    triangles: vec![i as u32],
                }),
                None => {}
            }
        }
        planes.sort_by(|a, b| b.area.total_cmp(&a.area));
        planes.retain(|p| p.area >= MIN_SHARE * total);
        planes.truncate(MAX_MIRRORS);
        if planes.is_empty() {
            return Self {
                curved_share: if total > 0.0 { 1.0 } else { 0.0 },
                ..Self::default()
            };
        }
        let mut of_triangle = vec![NONE; world.triangles.len()];
        for (k, p) in planes.iter().enumerate() {
            for &t in &p.triangles {
                of_triangle[t as usize] = k as u8;
            }
        }
        let covered: f64 = planes.iter().map(|p| p.area).sum();
        Self {
            list: planes
                .iter()
                .map(|p| Mirror::new(world, emitters, p))
                .collect(),
            of_triangle,
            curved_share: (1.0 - covered / total).max(0.0),
            spots: emitters.list.len(),
        }
    }

    /// Returns the planar mirror of a triangle.
    #[inline]
    pub fn of(&self, triangle: u32) -> Option<usize> {
        let k = *self.of_triangle.get(triangle as usize)?;
        (k != NONE).then_some(usize::from(k))
    }

    /// Returns the number of weights for [`Mirrors::aim`].
    pub fn choices(&self) -> usize {
        self.list.len() * self.spots
    }

    /// Writes the unshadowed contribution at `x` of every spot via every mirror. Returns their
    /// sum.
    pub fn weights(&self, x: Vec3, n: Vec3, out: &mut [f32]) -> f32 {
        widest(Weights {
            mirrors: self,
            x,
            n,
            out,
        })
    }

    /// Chooses a spot and a mirror by unshadowed contribution at `x`, and a point to aim at; `None`
    /// if no image is in reach. `weights` has room for all choices.
    pub fn aim(&self, x: Vec3, n: Vec3, rng: &mut Rng, weights: &mut [f32]) -> Option<Aim> {
        let total = self.weights(x, n, weights);
        if total <= 0.0 {
            return None;
        }
        let (k, w) = pick(weights, total * rng.uniform())?;
        let (mirror, spot) = (k / self.spots, k % self.spots);
        let shape = self.list[mirror].shape(x, spot)?;
        let (a, b) = rng.circle();
        let u = rng.uniform();
        let r = shape.sigma
            * if self.list[mirror].ggx {
                (u / (1.0 - u)).sqrt()
            } else {
                (-libm::logf(1.0 - u)).sqrt()
            };
        Some(Aim {
            target: shape.m0 + shape.t * (a * r / shape.jt) + shape.s * (b * r / shape.js),
            mirror,
            spot,
            chance: w / total,
        })
    }

    /// Returns the weight of one spot and mirror at `x`, as in [`Mirrors::aim`].
    pub fn weight(&self, mirror: usize, spot: usize, x: Vec3, n: Vec3) -> f32 {
        self.list[mirror].weight(spot, x, n)
    }

    /// Returns the density per steradian at `x` of aiming at `m`, given mirror and spot.
    pub fn pdf(&self, mirror: usize, spot: usize, x: Vec3, m: Vec3) -> f32 {
        let mirror = &self.list[mirror];
        let Some(shape) = mirror.shape(x, spot) else {
            return 0.0;
        };
        let d = m - shape.m0;
        let (a, b) = (shape.t.dot(d) * shape.jt, shape.s.dot(d) * shape.js);
        let s2 = shape.sigma * shape.sigma;
        let e = (a * a + b * b) / s2;
        let falloff = if mirror.ggx {
            1.0 / ((1.0 + e) * (1.0 + e))
        } else if e > 80.0 {
            return 0.0;
        } else {
            libm::expf(-e)
        };
        let to = m - x;
        let d2 = to.dot(to);
        let cos = mirror.normal.dot(to).abs() / d2.sqrt();
        falloff / (PI * s2) * shape.jt * shape.js * d2 / cos
    }
}

/// The loop of [`Mirrors::weights`].
struct Weights<'a> {
    mirrors: &'a Mirrors,
    x: Vec3,
    n: Vec3,
    out: &'a mut [f32],
}

impl Wide for Weights<'_> {
    type Output = f32;

    #[inline(always)]
    fn run(self) -> f32 {
        let Self { mirrors, x, n, out } = self;
        let mut total = 0.0;
        for (m, out) in mirrors.list.iter().zip(out.chunks_mut(mirrors.spots)) {
            if m.weights(x, n, out) {
                total += lanes::sum(out);
            }
        }
        total
    }
}

/// Returns the entry at which the running sum exceeds `at`, and its weight; never an entry of
/// weight 0.
#[inline]
fn pick(weights: &[f32], at: f32) -> Option<(usize, f32)> {
    let mut sum = 0.0;
    let mut last = None;
    for (i, &w) in weights.iter().enumerate() {
        if w > 0.0 {
            sum += w;
            last = Some((i, w));
            if sum > at {
                break;
            }
        }
    }
    last
}

struct Plane {
    normal: Vec3,
    offset: f32,
    surface: u32,
    area: f64,
    triangles: Vec<u32>,
}

impl Mirror {
    fn new(world: &World, emitters: &Emitters, plane: &Plane) -> Self {
        let n = plane.normal;
        let (u, v) = frame(n);
        let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        for &t in &plane.triangles {
            for p in world.triangles[t as usize] {
                for (k, axis) in [u, v].into_iter().enumerate() {
                    low[k] = low[k].min(axis.dot(p));
                    high[k] = high[k].max(axis.dot(p));
                }
            }
        }
        let surface = &world.surfaces[plane.surface as usize];
        let mut images = Columns::default();
        let mut height = vec![];
        for (e, &strength) in emitters.list.iter().zip(&*emitters.columns.strength) {
            let h = n.dot(e.p) - plane.offset;
            height.push(h);
            images.push(e.p - n * (2.0 * h), e.n - n * (2.0 * n.dot(e.n)), strength);
        }
        Self {
            normal: n,
            offset: plane.offset,
            u,
            v,
            low,
            high,
            alpha: surface.alpha(),
            ggx: surface.ggx(),
            two_sided: surface.two_sided(),
            images,
            height,
        }
    }

    /// Writes the weights of all spots at `x`. Returns whether `x` is on a reflecting side;
    /// otherwise all weights are 0.
    #[inline(always)]
    fn weights(&self, x: Vec3, n: Vec3, out: &mut [f32]) -> bool {
        let hx = self.normal.dot(x) - self.offset;
        // `reflects` without branches, for all spots at once.
        let (im, count) = (&self.images, out.len());
        let (px, py, pz) = (&im.px[..count], &im.py[..count], &im.pz[..count]);
        let height = &self.height[..count];
        let (ux, uv) = (self.u.dot(x), self.v.dot(x));
        let side = if hx > 1e-4 {
            1.0
        } else if self.two_sided && hx < -1e-4 {
            -1.0
        } else {
            out.fill(0.0);
            return false;
        };
        let images = Irradiance {
            first: 0,
            columns: im,
            x,
            n,
            out: &mut *out,
        };
        images.run();
        for i in 0..count {
            let (dx, dy, dz) = (px[i] - x.x, py[i] - x.y, pz[i] - x.z);
            let d2 = dx * dx + dy * dy + dz * dz;
            let sum = hx + height[i];
            let t = hx / sum;
            let margin = MARGIN * 2.0 * self.alpha * t * (1.0 - t) * d2 / sum.abs();
            let a = ux + t * (self.u.x * dx + self.u.y * dy + self.u.z * dz);
            let b = uv + t * (self.v.x * dx + self.v.y * dy + self.v.z * dz);
            let inside = (side * height[i] > 1e-4)
                & (a > self.low[0] - margin)
                & (a < self.high[0] + margin)
                & (b > self.low[1] - margin)
                & (b < self.high[1] + margin);
            out[i] = if inside { out[i] } else { 0.0 };
        }
        true
    }

    fn weight(&self, spot: usize, x: Vec3, n: Vec3) -> f32 {
        let im = &self.images;
        let d = Vec3::new(im.px[spot], im.py[spot], im.pz[spot]) - x;
        let ns = Vec3::new(im.nx[spot], im.ny[spot], im.nz[spot]);
        let (cx, cs) = (n.dot(d), -ns.dot(d));
        let hx = self.normal.dot(x) - self.offset;
        if !(cx > 0.0 && cs > 0.0 && self.reflects(spot, x, hx)) {
            return 0.0;
        }
        let d2 = d.dot(d);
        im.strength[spot] * cx * cs / (d2 * d2)
    }

    /// Returns whether `x` and the spot are on the same, reflecting side and the image is within
    /// the frame.
    fn reflects(&self, spot: usize, x: Vec3, hx: f32) -> bool {
        let hs = self.height[spot];
        let front = hx > 1e-4 && hs > 1e-4;
        let back = self.two_sided && hx < -1e-4 && hs < -1e-4;
        if !(front || back) {
            return false;
        }
        let t = hx / (hx + hs);
        let im = &self.images;
        let d = Vec3::new(im.px[spot], im.py[spot], im.pz[spot]) - x;
        let margin = MARGIN * 2.0 * self.alpha * t * (1.0 - t) * d.dot(d) / (hx + hs).abs();
        let a = self.u.dot(x) + t * self.u.dot(d);
        let b = self.v.dot(x) + t * self.v.dot(d);
        a > self.low[0] - margin
            && a < self.high[0] + margin
            && b > self.low[1] - margin
            && b < self.high[1] + margin
    }

    fn shape(&self, x: Vec3, spot: usize) -> Option<Shape> {
        let im = &self.images;
        let d = Vec3::new(im.px[spot], im.py[spot], im.pz[spot]) - x;
        let hx = self.normal.dot(x) - self.offset;
        let hs = self.height[spot];
        let length = d.length();
        let share = hx / (hx + hs);
        let cos = (hx + hs).abs() / length;
        if !(hx * hs > 0.0 && length > 0.0) {
            return None;
        }
        let flat = d - self.normal * self.normal.dot(d);
        let size = flat.length();
        let t = if size > 1e-4 * length {
            flat / size
        } else {
            self.u
        };
        let bend = 1.0 / (share * length) + 1.0 / ((1.0 - share) * length);
        Some(Shape {
            m0: x + d * share,
            t,
            s: self.normal.cross(t),
            jt: 0.5 * bend * cos,
            js: 0.5 * bend / cos,
            sigma: WIDEN * self.alpha,
        })
    }
}
