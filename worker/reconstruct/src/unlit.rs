//! The distance of surfaces that no spot lights. A pixel without two-bounce light still returns
//! light of three bounces: laser → spot → a lit surface → the pixel's surface → camera. Every
//! capture shows when the first of it arrives. The lit surfaces are known, so a distance and a
//! normal of the dark surface predict these times, and the distance is searched whose times agree.
//!
//! The first light is faint, so that it is seen late by a few bins. Shadowed pixels of known depth
//! show how late. Neighbouring dark pixels vote together, for common distances and for the planes
//! of the room.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::{
    Depth, Measured, MeasuredSpot, Plane,
    closed_form::{closed_form, on_ellipsoid, smooth},
    planes::planes,
    start::bounds,
};

/// The number of pixels along the width of the image that are searched; others copy the nearest.
const GRID: usize = 128;
/// The greatest number of lit surface points of a spot.
const SOURCES: usize = 220;
/// The number of shadowed pairs of a pixel and a spot that show how late first light is seen.
const SAMPLES: usize = 3000;
/// The least number of such pairs.
const FEWEST_SAMPLES: usize = 50;
/// The step of the search, metres.
const STEP_M: f32 = 0.06;
/// The least distance of a surface from the camera, metres.
const NEAREST_M: f32 = 0.3;
/// A time that differs by more than this has no further influence, metres of path.
const FAR_M: f32 = 0.4;
/// The mean difference of times from which no distance is returned, metres of path.
const WORST_M: f32 = 0.25;
/// The factor of the cost of a plane of the room.
const WALL: f32 = 0.85;
/// The number of neighbours on each side that vote together.
const REACH: i64 = 2;
/// The distance of points on walls outside the view, metres.
const UNSEEN_M: f32 = 0.3;
/// The distance behind the camera up to which walls return light, metres.
const BEHIND_M: f32 = 0.5;
/// The standard error of the distance of pixels that no spot lights, metres.
const ERROR_M: f32 = 0.05;
/// The relative difference in distance up to which neighbouring pixels are on one surface.
const JOINED: f32 = 0.06;
/// The least number of spots.
const FEWEST_SPOTS: usize = 3;

/// The share of the three-bounce light whose arrival is predicted. It is larger than the share of
/// all light whose arrival is measured, because light of more bounces arrives later.
const SHARE: f32 = 0.08;
/// The width and number of the classes of paths for this prediction.
const CLASS_M: f32 = 0.04;
const CLASSES: usize = 160;
/// The least square of the distance between two surfaces, m², which bounds the light of a corner.
const CORNER: f32 = 0.01;

/// A surface point that a spot lights.
#[derive(Debug, Clone, Copy)]
struct Source {
    point: Vec3,
    normal: Vec3,
    /// The path laser → spot → point, metres.
    path: f32,
    /// The light that it returns, in any unit.
    power: f32,
}

/// Sets [`Measured::unlit_range_m`] of the pixels without depth from the paths of their first light,
/// `[spot][row][column]`, metres; NaN = unknown. The light paths of these pixels are left unused,
/// because their distances are too uncertain.
pub(crate) fn fill(measured: &mut Measured, first: &[f32]) {
    let mut refined = measured.clone();
    let raw = closed_form(&mut refined).0;
    let depth = smooth(&refined, &raw);
    let (walls, _) = planes(&refined, &depth, 0);
    let walls: Vec<Plane> = walls.iter().map(|w| w.plane).collect();
    let found = Search::new(&refined, &depth, &walls, first).map_or(Vec::new(), |s| s.run());
    let pixels = measured.pixels();
    for (p, range) in found.iter().enumerate() {
        if range.is_finite() {
            for spot in 0..measured.spots.len() {
                measured.used[spot * pixels + p] = 0;
            }
        }
    }
    measured.unlit_range_m = found;
}

/// Adds the distances of pixels that no spot lights to those in closed form, and returns their
/// number. Distances that come with the others from one estimate are added only where they continue
/// a lit surface, because those of dark objects alone are often wrong by half a metre.
pub(crate) fn add(measured: &Measured, raw: &mut Depth) -> usize {
    let known = |p: usize| {
        let range = measured.unlit_range_m.get(p).copied().unwrap_or(f32::NAN);
        let mirror = measured.mirror.get(p).is_some_and(|m| *m != 0);
        let new = !raw.range[p].is_finite() && range.is_finite() && range > 0.0 && !mirror;
        new.then_some(range)
    };
    let wanted: Vec<Option<f32>> = (0..measured.pixels()).map(known).collect();
    let mut count = 0;
    if !measured.computed {
        for (p, range) in wanted.iter().enumerate() {
            if let Some(range) = range {
                (raw.range[p], raw.error[p]) = (*range, ERROR_M);
                count += 1;
            }
        }
        return count;
    }
    let width = measured.camera.intrinsics.width as usize;
    let mut edge: Vec<usize> = (0..wanted.len()).filter(|p| raw.range[*p].is_finite()).collect();
    while let Some(p) = edge.pop() {
        let (u, own) = (p % width, raw.range[p]);
        let beside = [
            p.checked_sub(width),
            Some(p + width).filter(|q| *q < wanted.len()),
            (u > 0).then(|| p - 1),
            (u + 1 < width).then(|| p + 1),
        ];
        for q in beside.into_iter().flatten() {
            let Some(range) = wanted[q].filter(|_| !raw.range[q].is_finite()) else {
                continue;
            };
            if (range - own).abs() < JOINED * own {
                (raw.range[q], raw.error[q]) = (range, ERROR_M);
                count += 1;
                edge.push(q);
            }
        }
    }
    count
}

struct Search<'a> {
    measured: &'a Measured,
    depth: &'a Depth,
    walls: &'a [Plane],
    /// The planes of the room, and those through spots on dark surfaces.
    planes: Vec<Plane>,
    first: &'a [f32],
    sources: Vec<Vec<Source>>,
    /// The least path of each spot's sources, metres.
    starts: Vec<f32>,
    /// How late first light is seen, metres.
    late: f32,
    /// The greatest distance of a surface, metres.
    farthest: f32,
}

impl<'a> Search<'a> {
    /// Returns `None` if too little is lit to predict first light.
    fn new(
        measured: &'a Measured,
        depth: &'a Depth,
        walls: &'a [Plane],
        first: &'a [f32],
    ) -> Option<Self> {
        let mut ranges: Vec<f32> = depth.range.iter().copied().filter(|r| r.is_finite()).collect();
        ranges.sort_by(f32::total_cmp);
        let farthest = *ranges.get(ranges.len().saturating_sub(1 + ranges.len() / 200))? + 0.3;
        let unseen = unseen_points(measured, depth, walls);
        let sources: Vec<Vec<Source>> = (0..measured.spots.len())
            .map(|k| {
                let mut all = lit_points(measured, depth, k);
                let spot = &measured.spots[k];
                all.extend(unseen.iter().map(|&(y, n)| source(spot, (y, n), UNSEEN_M * UNSEEN_M)));
                all
            })
            .collect();
        let least = |all: &Vec<Source>| all.iter().map(|s| s.path).fold(f32::INFINITY, f32::min);
        let starts = sources.iter().map(least).collect();
        let mut search = Self {
            measured,
            depth,
            walls,
            planes: with_dark_spots(measured, depth, walls),
            first,
            sources,
            starts,
            late: 0.0,
            farthest,
        };
        search.late = search.lateness()?;
        Some(search)
    }

    /// Returns the path by which a share of a spot's three-bounce light has arrived via a surface
    /// point with a normal; infinite if none arrives.
    fn arrival(&self, spot: usize, (x, n): (Vec3, Vec3)) -> f32 {
        let mut classes = [0.0f32; CLASSES];
        let (start, mut all) = (self.starts[spot], 0.0f32);
        for source in &self.sources[spot] {
            let way = x - source.point;
            let (a, b) = (source.normal.dot(way), -n.dot(way));
            // Both surfaces must face each other.
            if a <= 0.0 || b <= 0.0 {
                continue;
            }
            let square = way.dot(way).max(CORNER);
            let light = source.power * a * b / (square * square);
            let class = (source.path + libm::sqrtf(square) - start) / CLASS_M;
            classes[(class as usize).min(CLASSES - 1)] += light;
            all += light;
        }
        if all <= 0.0 {
            return f32::INFINITY;
        }
        let (mut sum, mut path) = (0.0f32, f32::INFINITY);
        for (i, light) in classes.iter().enumerate() {
            if sum + light >= SHARE * all {
                path = start + (i as f32 + (SHARE * all - sum) / light) * CLASS_M;
                break;
            }
            sum += light;
        }
        path + (x - self.measured.camera.origin).length()
    }

    /// Returns the median delay of first light at shadowed pixels of known depth.
    fn lateness(&self) -> Option<f32> {
        let (measured, depth) = (self.measured, self.depth);
        let pixels = measured.pixels();
        let all: Vec<usize> = (0..measured.lit.len())
            .filter(|&q| {
                let p = q % pixels;
                measured.used[q] != 0
                    && measured.lit[q] == 0
                    && depth.normal[p] != Vec3::ZERO
                    && self.first[q].is_finite()
            })
            .collect();
        let stride = all.len().div_ceil(SAMPLES).max(1);
        let some: Vec<usize> = all.into_iter().step_by(stride).collect();
        let delay = |&q: &usize| {
            let p = q % pixels;
            let x = measured.camera.origin + measured.ray(p) * depth.range[p];
            self.first[q] - self.arrival(q / pixels, (x, depth.normal[p]))
        };
        let mut delays: Vec<f32> = some.par_iter().map(delay).filter(|d| d.is_finite()).collect();
        delays.sort_by(f32::total_cmp);
        (delays.len() >= FEWEST_SAMPLES).then(|| delays[delays.len() / 2])
    }

    /// Returns the mean difference of first light from what a surface predicts.
    fn cost(&self, pixel: usize, surface: (Vec3, Vec3)) -> f32 {
        let pixels = self.measured.pixels();
        let (mut sum, mut count) = (0.0f32, 0usize);
        for spot in 0..self.sources.len() {
            let seen = self.first[spot * pixels + pixel];
            if !seen.is_finite() || self.sources[spot].is_empty() {
                continue;
            }
            let off = seen - self.late - self.arrival(spot, surface);
            sum += if off.is_finite() { off.abs().min(FAR_M) } else { FAR_M };
            count += 1;
        }
        match count < FEWEST_SPOTS {
            true => f32::INFINITY,
            false => sum / count as f32,
        }
    }

    /// Returns the greatest distance that the first light of all spots allows.
    fn bound(&self, pixel: usize) -> f32 {
        let (measured, ray) = (self.measured, self.measured.ray(pixel));
        let pixels = measured.pixels();
        let mut bound = self.farthest;
        for (k, spot) in measured.spots.iter().enumerate() {
            let seen = self.first[k * pixels + pixel] + 2.0 * measured.bin_width_m;
            let far = on_ellipsoid(
                seen - spot.path_m,
                spot.point - measured.camera.origin,
                ray,
            );
            if far.is_finite() && far > 0.0 {
                bound = bound.min(far);
            }
        }
        bound
    }

    /// Returns the distance of each dark pixel; NaN for others.
    fn run(&self) -> Vec<f32> {
        let measured = self.measured;
        let width = measured.camera.intrinsics.width as usize;
        let pixels = measured.pixels();
        let coarse = width.div_ceil(GRID).max(1);
        let mirror = |p: usize| measured.mirror.get(p).is_some_and(|m| *m != 0);
        let dark = |p: usize| !self.depth.range[p].is_finite() && !mirror(p);
        let asked: Vec<usize> = (0..pixels)
            .filter(|&p| dark(p) && (p % width) % coarse == 0 && (p / width) % coarse == 0)
            .collect();
        let steps = ((self.farthest - NEAREST_M) / STEP_M).max(1.0) as usize;
        let slices = steps + self.planes.len();
        let costs: Vec<Vec<f32>> = asked.par_iter().map(|&p| self.costs(p, steps)).collect();
        let mut slot = vec![usize::MAX; pixels];
        for (i, &p) in asked.iter().enumerate() {
            slot[p] = i;
        }
        let height = pixels / width.max(1);
        let vote = |&p: &usize| -> f32 {
            let (u, v) = ((p % width) as i64, (p / width) as i64);
            let mut sums = vec![0.0f32; slices];
            let mut count = 0.0;
            for dv in -REACH..=REACH {
                for du in -REACH..=REACH {
                    let (a, b) = (u + du * coarse as i64, v + dv * coarse as i64);
                    if a < 0 || b < 0 || a >= width as i64 || b >= height as i64 {
                        continue;
                    }
                    let Some(other) = costs.get(slot[b as usize * width + a as usize]) else {
                        continue;
                    };
                    count += 1.0;
                    for (sum, c) in sums.iter_mut().zip(other) {
                        *sum += c.min(FAR_M);
                    }
                }
            }
            let own = &costs[slot[p]];
            let best = (0..slices)
                .filter(|s| own[*s].is_finite())
                .min_by(|a, b| sums[*a].total_cmp(&sums[*b]));
            match best {
                Some(s) if sums[s] / count < WORST_M => self.distance(p, s, steps),
                _ => f32::NAN,
            }
        };
        let found: Vec<f32> = asked.par_iter().map(vote).collect();
        (0..pixels)
            .map(|p| {
                let (u, v) = (p % width / coarse * coarse, p / width / coarse * coarse);
                match dark(p) {
                    true => found.get(slot[v * width + u]).copied().unwrap_or(f32::NAN),
                    false => f32::NAN,
                }
            })
            .collect()
    }

    /// Returns the distance of a slice: a step of the search, or a plane of the room.
    fn distance(&self, pixel: usize, slice: usize, steps: usize) -> f32 {
        match slice.checked_sub(steps) {
            None => NEAREST_M + (slice as f32 + 0.5) * STEP_M,
            Some(wall) => {
                let (plane, ray) = (&self.planes[wall], self.measured.ray(pixel));
                plane.inside(self.measured.camera.origin) / plane.normal.dot(ray)
            }
        }
    }

    /// Returns the cost of every slice of a pixel; infinite where its first light does not allow it.
    fn costs(&self, pixel: usize, steps: usize) -> Vec<f32> {
        let (ray, bound) = (self.measured.ray(pixel), self.bound(pixel));
        let origin = self.measured.camera.origin;
        // Furniture is often parallel to the walls.
        let mut facing: Vec<Vec3> = self
            .walls
            .iter()
            .flat_map(|w| [w.normal, -w.normal])
            .filter(|n| n.dot(ray) < -0.3)
            .collect();
        facing.push(-ray);
        let room = self
            .walls
            .iter()
            .map(|w| (w.inside(origin), w.normal.dot(ray)))
            .filter(|(far, slope)| *far > 0.0 && *slope > 0.01)
            .map(|(far, slope)| far / slope)
            .fold(bound, f32::min);
        let at_step = |step: usize| {
            let range = self.distance(pixel, step, steps);
            if range > room {
                return f32::INFINITY;
            }
            let x = origin + ray * range;
            let costs = facing.iter().map(|n| self.cost(pixel, (x, *n)));
            costs.fold(f32::INFINITY, f32::min)
        };
        let on_wall = |wall: usize| {
            let range = self.distance(pixel, steps + wall, steps);
            if self.planes[wall].normal.dot(ray) <= 0.0 {
                return f32::INFINITY;
            }
            // The first wall on the ray is the surface; the others are behind it.
            if !(range > 0.0 && range <= room + STEP_M) {
                return f32::INFINITY;
            }
            WALL * self.cost(pixel, (origin + ray * range, -self.planes[wall].normal))
        };
        (0..steps)
            .map(at_step)
            .chain((0..self.planes.len()).map(on_wall))
            .collect()
    }
}

/// Returns some of the surface points that a spot lights.
fn lit_points(measured: &Measured, depth: &Depth, spot: usize) -> Vec<Source> {
    let pixels = measured.pixels();
    let of = &measured.spots[spot];
    let lit: Vec<usize> = (0..pixels)
        .filter(|&p| {
            let q = spot * pixels + p;
            measured.lit[q] != 0 && measured.used[q] != 0 && depth.normal[p] != Vec3::ZERO
        })
        .collect();
    let stride = lit.len().div_ceil(SOURCES).max(1);
    lit.into_iter()
        .step_by(stride)
        .map(|p| {
            let y = measured.camera.origin + measured.ray(p) * depth.range[p];
            let normal = depth.normal[p];
            let slope = -normal.dot(measured.ray(p)).min(-0.05);
            let i = &measured.camera.intrinsics;
            let area = stride as f32 * depth.range[p] * depth.range[p] / (slope * i.fx * i.fy);
            source(of, (y, normal), area)
        })
        .collect()
}

/// Returns the source of a surface of some area, m², with a normal, that a spot lights.
fn source(spot: &MeasuredSpot, (point, normal): (Vec3, Vec3), area: f32) -> Source {
    let way = spot.point - point;
    let received = normal.dot(way).max(0.0) / (way.dot(way).max(CORNER) * way.length().max(0.1));
    Source {
        point,
        normal,
        path: spot.path_m + way.length(),
        power: area * received,
    }
}

/// Returns points on the room's planes outside the camera's view, with normals into the room: their
/// light reaches surfaces that face the camera.
fn unseen_points(measured: &Measured, depth: &Depth, walls: &[Plane]) -> Vec<(Vec3, Vec3)> {
    let camera = &measured.camera;
    let (lo, hi) = bounds(measured, depth, 64);
    let back = camera.forward * -BEHIND_M;
    let (lo, hi) = (lo.min(lo + back), hi.max(hi + back));
    let mut found = Vec::new();
    for (w, wall) in walls.iter().enumerate() {
        let across = match wall.normal.x.abs() < 0.7 {
            true => Vec3::new(1.0, 0.0, 0.0),
            false => Vec3::new(0.0, 1.0, 0.0),
        };
        let a = wall.normal.cross(across).normalized();
        let b = wall.normal.cross(a);
        let foot = camera.origin + wall.normal * wall.inside(camera.origin);
        let reach = ((hi - lo).length() / UNSEEN_M) as i32;
        for i in -reach..=reach {
            for j in -reach..=reach {
                let x = foot + a * (i as f32 * UNSEEN_M) + b * (j as f32 * UNSEEN_M);
                let within = (0..3).all(|k| x[k] >= lo[k] && x[k] <= hi[k]);
                let enclosed = walls
                    .iter()
                    .enumerate()
                    .all(|(other, p)| other == w || p.inside(x) > 0.0);
                if within && enclosed && measured.pixel_of(x).is_none() {
                    found.push((x, -wall.normal));
                }
            }
        }
    }
    found
}

/// Returns the planes of the room and, for each spot at a pixel without depth, the planes through it
/// that are parallel to them and face the camera: such a spot is on a dark surface.
fn with_dark_spots(measured: &Measured, depth: &Depth, walls: &[Plane]) -> Vec<Plane> {
    let mut all = walls.to_vec();
    for spot in &measured.spots {
        let Some(p) = measured.pixel_of(spot.point) else {
            continue;
        };
        let ray = measured.ray(p);
        if depth.range[p].is_finite() {
            continue;
        }
        let mut normals: Vec<Vec3> = walls
            .iter()
            .flat_map(|w| [w.normal, -w.normal])
            .filter(|n| n.dot(ray) > 0.5)
            .collect();
        normals.push(ray);
        all.extend(normals.into_iter().map(|normal| Plane {
            normal,
            offset: normal.dot(spot.point),
        }));
    }
    all
}
