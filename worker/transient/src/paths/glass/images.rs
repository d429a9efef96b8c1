//! Mirror images of the spots in planar panes. Light that a pane reflects once on its way from a
//! spot comes straight from the image behind the pane. So a camera path's points connect to images
//! as they do to spots, within the extent of the pane and if nothing blocks the path. The camera
//! itself does so too: a spot that it sees in a planar pane is a point of light, in one pixel and
//! one bin.

use picofarm_scene::Vec3;

use crate::{
    api::Stop,
    film::{slots::Film, splat::Splat, technique::Technique},
    numeric::{frame::frame, rng::Rng, systematic::draw},
    paths::{
        glass::{buffers::Buffers, contribution::Found, lit_points::Lit, point::Point},
        tracer::Walk,
    },
    scene::{hit::Hit, intersection::lift, panes::Panes, world::World},
};

/// Largest number of planes, by area, that points are connected by, and the least share of the
/// whole area for such a plane. Light reflected by other planes is left to light paths.
const MOST: usize = 8;
const LEAST: f32 = 0.02;

/// Largest number of planes that panes are compared with, because curved glass has one for each
/// facet.
const MOST_KNOWN: usize = 4096;

/// Largest distance of a pane from its plane, render units, and least cosine between the normals of
/// both.
const FLAT: f32 = 1e-5;
const ALIKE: f32 = 0.999_999;

/// Least distance from a plane for a point to be on one of its sides, render units.
const OFF: f32 = 1e-4;

/// Number of lit points that are considered for one connection, in all planes together, and its
/// least and greatest value for one plane.
const LOOKED_AT: usize = 64;
const OF_ONE: (usize, usize) = (4, 32);

/// Panes in one plane.
#[derive(Debug)]
struct Plane {
    normal: Vec3,
    /// Distance from the origin along `normal`.
    offset: f32,
    /// Two directions within the plane, and the bounds along them.
    u: Vec3,
    v: Vec3,
    low: [f32; 2],
    high: [f32; 2],
    area: f32,
    /// The first pane of the plane; its weight represents all of them.
    pane: usize,
}

/// The planes of a scene's panes.
#[derive(Debug, Default)]
pub(crate) struct Images {
    /// The planes, largest first.
    planes: Vec<Plane>,
    /// The number of planes by which points of camera paths are connected.
    kept: usize,
    /// Plane of each pane; [`NONE`] if it has none.
    of_pane: Vec<u32>,
}

const NONE: u32 = u32::MAX;

impl Images {
    /// Returns the planes of all panes. The result is unusable after a stop.
    pub fn find(world: &World, stop: Stop) -> Self {
        let Some(panes) = &world.panes else {
            return Self::default();
        };
        let mut planes: Vec<(Plane, Vec<usize>)> = vec![];
        for (pane, (corners, normal)) in panes.triangles().enumerate() {
            // Each pane is compared with all planes so far.
            if pane % 256 == 0 && stop.asked() {
                break;
            }
            if normal == Vec3::ZERO || panes.reflectance(pane) == 0.0 {
                continue;
            }
            let [a, b, c] = corners;
            let area = 0.5 * (b - a).cross(c - a).length();
            let known = planes.iter().position(|(p, _)| {
                let flat = |v: &Vec3| (p.normal.dot(*v) - p.offset).abs() < FLAT;
                p.normal.dot(normal) > ALIKE && corners.iter().all(flat)
            });
            let k = match known {
                Some(k) => k,
                None if planes.len() < MOST_KNOWN => {
                    planes.push((Plane::new(normal, normal.dot(a), pane), vec![]));
                    planes.len() - 1
                }
                None => continue,
            };
            let (plane, all) = &mut planes[k];
            plane.area += area;
            plane.widen(&corners);
            all.push(pane);
        }
        let whole: f32 = planes.iter().map(|(p, _)| p.area).sum();
        planes.sort_by(|a, b| b.0.area.total_cmp(&a.0.area));
        let large = planes.iter().filter(|(p, _)| p.area >= LEAST * whole);
        let kept = large.count().min(MOST);
        let mut of_pane = vec![NONE; panes.triangles().count()];
        for (k, (_, all)) in planes.iter().enumerate() {
            for &pane in all {
                of_pane[pane] = k as u32;
            }
        }
        Self {
            kept,
            planes: planes.into_iter().map(|(plane, _)| plane).collect(),
            of_pane,
        }
    }

    /// Returns whether points of camera paths are connected to any images.
    pub fn any(&self) -> bool {
        self.kept > 0
    }

    /// Returns whether points of camera paths are connected to the spots' images in a pane.
    pub fn has(&self, pane: u32) -> bool {
        (self.of_pane[pane as usize] as usize) < self.kept
    }

    /// Returns whether [`Images::seen`] includes the spots that the camera sees in a pane.
    pub fn shows(&self, pane: u32) -> bool {
        self.of_pane[pane as usize] != NONE
    }

    /// Returns the splats that each pass draws of the spots that the camera sees in planar panes.
    /// Each is a point of light at the place of its image, computed like a spot seen without glass
    /// ([`crate::paths::one_bounce`]). The result is unusable after a stop.
    pub fn seen(
        &self,
        (walk, film): (&Walk, &Film),
        buffers: &mut Buffers,
        stop: Stop,
    ) -> Vec<Splat> {
        let (world, mut seen) = (walk.world, vec![]);
        let Some(panes) = &world.panes else {
            return seen;
        };
        let (camera, i) = (&world.camera, &world.camera.intrinsics);
        let area = world.sensitive.powi(2) / (i.fx * i.fy);
        for (k, plane) in self.planes.iter().enumerate() {
            if stop.asked() {
                break;
            }
            for (spot, e) in walk.emitters.list.iter().enumerate() {
                let place = (e.p, e.n);
                let Some(way) = self.way((world, panes), k, (Vec3::ZERO, 1.0), place, buffers)
                else {
                    continue;
                };
                let image = e.p - plane.normal * (2.0 * (plane.normal.dot(e.p) - plane.offset));
                let (q, d) = (camera.direction_to_camera(image), image.length());
                let Some(pixel) = world.pixel(q) else {
                    continue;
                };
                let cos = q.z / d;
                let value = e.intensity(way.back) * way.free / (d * d * cos * cos * cos * area);
                seen.push(Splat {
                    pixel: pixel as u32,
                    slot: film.slot(e.path_m + way.length_m) as u32,
                    spot: spot as u16,
                    value,
                    bounces: 2,
                    technique: Technique::SeenSpot,
                });
            }
        }
        seen.retain(|s| s.value > 0.0);
        seen
    }

    /// Connects a point of a camera path to `count` images, drawn in proportion to their unblocked
    /// contributions.
    pub fn connect(
        &self,
        walk: &Walk,
        point: &Point,
        count: u32,
        rng: &mut Rng,
        buffers: &mut Buffers,
        mut each: impl FnMut(Found),
    ) {
        let (world, emitters) = (walk.world, walk.emitters);
        let Some(panes) = &world.panes else { return };
        let spots = emitters.list.len();
        let mut weights = std::mem::take(&mut buffers.lights);
        weights.clear();
        for plane in &self.planes[..self.kept] {
            let of = (&point.hit, point.back);
            let each = emitters.list.iter();
            weights.extend(each.map(|e| plane.weight(panes, of, e.p, |w| e.intensity(w))));
        }
        draw(&weights, count, rng.uniform(), |k, value| {
            let (plane, spot) = (k / spots, k % spots);
            // `value` is this image's weight over its probability.
            let of = self.light((walk, panes), (plane, spot), point, buffers);
            if let Some((share, found)) = of {
                let value = point.path.weight * value * share;
                each(Found { value, ..found });
            }
        });
        buffers.lights = weights;
    }

    /// Returns the light from a spot's image as a share of its weight, with the path and the
    /// ratios.
    fn light(
        &self,
        (walk, panes): (&Walk, &Panes),
        (plane, spot): (usize, usize),
        point: &Point,
        buffers: &mut Buffers,
    ) -> Option<(f32, Found)> {
        let (world, path) = (walk.world, &point.path);
        let e = &walk.emitters.list[spot];
        let from = (lift(point.hit.p, point.hit.n), point.medium);
        let way = self.way((world, panes), plane, from, (e.p, e.n), buffers)?;
        let found = Found {
            value: 0.0,
            path_m: path.length_m + way.length_m + e.path_m,
            spot,
            bounces: path.bounces + 2,
            technique: Technique::Image,
        };
        Some((way.share, found))
    }

    /// Connects a point of a camera path to images of the points of `lit`, at most `count` of them.
    /// A few points are considered, and some of these are drawn in proportion to their unblocked
    /// contributions.
    pub fn connect_lit(
        &self,
        (walk, lit): (&Walk, &Lit),
        point: &Point,
        count: u32,
        rng: &mut Rng,
        buffers: &mut Buffers,
        mut each: impl FnMut(Found),
    ) {
        let world = walk.world;
        let (Some(panes), all) = (&world.panes, lit.list.len()) else {
            return;
        };
        if all == 0 || self.kept == 0 {
            return;
        }
        let some = (LOOKED_AT / self.kept).clamp(OF_ONE.0, OF_ONE.1).min(all);
        let first = ((rng.uniform() * all as f32) as usize).min(all - 1);
        let of = |k: usize| &lit.list[(first + k) % all];
        let mut weights = std::mem::take(&mut buffers.lights);
        weights.clear();
        let h = &point.hit;
        for plane in &self.planes[..self.kept] {
            for k in 0..some {
                let y = of(k);
                let sends = |back: Vec3| y.sum * y.hit.n.dot(back).max(0.0);
                let weight = plane.weight(panes, (h, point.back), y.hit.p, sends);
                weights.push(weight);
            }
        }
        let scale = all as f32 / some as f32;
        draw(&weights, count, rng.uniform(), |k, value| {
            let (plane, y) = (k / some, of(k % some));
            let place = (y.hit.p, y.hit.n);
            let from = (lift(h.p, h.n), point.medium);
            let Some(way) = self.way((world, panes), plane, from, place, buffers) else {
                return;
            };
            let factor = point.path.weight * value * scale * way.share / y.sum;
            for a in &y.arrivals {
                let found = Found {
                    value: factor * a.value,
                    path_m: point.path.length_m + way.length_m + a.path_m,
                    spot: a.spot,
                    bounces: point.path.bounces + 1 + a.bounces,
                    technique: Technique::LitImage,
                };
                if found.bounces <= walk.max_bounces {
                    each(found);
                }
            }
        });
        buffers.lights = weights;
    }

    /// Returns the path from a point, lifted off its surface, in a medium of some index via a pane
    /// of a plane to another point, if it is free.
    fn way(
        &self,
        (world, panes): (&World, &Panes),
        k: usize,
        (from, medium): (Vec3, f32),
        (p, n): (Vec3, Vec3),
        buffers: &mut Buffers,
    ) -> Option<Way> {
        let plane = &self.planes[k];
        // Computed from the start of the ray, because the ray hits the pane there.
        let q = plane.between(from, p)?;
        let to = q - from;
        let stack = &mut buffers.scratch.stack;
        if world.bvh.occluded(stack, from, to, 1.0) {
            return None;
        }
        // A point a little beyond the pane.
        let beyond = from + to * (1.0 + 1.0 / 16384.0);
        panes.crossings(stack, from, beyond, &mut buffers.crossings);
        let mut passes = 1.0;
        let mut reflects = 0.0;
        for c in &buffers.crossings {
            if self.of_pane[c.pane as usize] as usize == k {
                reflects = c.reflects;
                break;
            }
            passes *= c.passes;
        }
        if reflects == 0.0 {
            return None;
        }
        let w = to.normalized();
        let side = match plane.normal.dot(w) <= 0.0 {
            true => plane.normal,
            false => -plane.normal,
        };
        let free = passes * reflects * world.free(stack, q, side, p, n);
        let cos = plane.normal.dot(w).abs();
        let length = to.length() + (p - q).length();
        (free > 0.0).then(|| Way {
            share: free / panes.weight(plane.pane, cos),
            free,
            back: (q - p).normalized(),
            length_m: world.metres(length) * f64::from(medium),
        })
    }
}

/// A free path via a pane.
struct Way {
    /// Transmitted and reflected share of the light, relative to the reflectance that weights
    /// assume.
    share: f32,
    /// The same share, relative to all light.
    free: f32,
    /// Unit direction from the far end.
    back: Vec3,
    /// Optical length, metres.
    length_m: f64,
}

impl Plane {
    fn new(normal: Vec3, offset: f32, pane: usize) -> Self {
        let (u, v) = frame(normal);
        Self {
            normal,
            offset,
            u,
            v,
            low: [f32::INFINITY; 2],
            high: [f32::NEG_INFINITY; 2],
            area: 0.0,
            pane,
        }
    }

    fn widen(&mut self, corners: &[Vec3; 3]) {
        for p in corners {
            for (k, axis) in [self.u, self.v].into_iter().enumerate() {
                self.low[k] = self.low[k].min(axis.dot(*p));
                self.high[k] = self.high[k].max(axis.dot(*p));
            }
        }
    }

    /// Returns the point of reflection for light from a spot to a point, if both are on one side
    /// and the reflection is within the bounds.
    fn between(&self, x: Vec3, spot: Vec3) -> Option<Vec3> {
        let (a, b) = (
            self.normal.dot(x) - self.offset,
            self.normal.dot(spot) - self.offset,
        );
        if a.abs() < OFF || b.abs() < OFF || a * b <= 0.0 {
            return None;
        }
        let image = spot - self.normal * (2.0 * b);
        let q = x + (image - x) * (a / (a + b));
        let within = |k: usize, axis: Vec3| {
            let at = axis.dot(q);
            at > self.low[k] - OFF && at < self.high[k] + OFF
        };
        (within(0, self.u) && within(1, self.v)).then_some(q)
    }

    /// Returns the unblocked contribution from another point to a point via the plane: f · cos,
    /// times the pane's reflectance, times the light that the other point `sends` in a direction,
    /// over the squared distance.
    fn weight(
        &self,
        panes: &Panes,
        (h, back): (&Hit, Vec3),
        p: Vec3,
        sends: impl Fn(Vec3) -> f32,
    ) -> f32 {
        let Some(q) = self.between(h.p, p) else {
            return 0.0;
        };
        let (to, on) = (q - h.p, q - p);
        let (near, far) = (to.length(), on.length());
        let w = to / near;
        let f = h.surface.scatter(h.n, back, w);
        if f == 0.0 {
            return 0.0;
        }
        let reflects = panes.weight(self.pane, self.normal.dot(w).abs());
        let d = near + far;
        let weight = f * sends(on / far) * reflects / (d * d);
        if weight.is_finite() { weight } else { 0.0 }
    }
}
