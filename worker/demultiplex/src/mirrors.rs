//! Mirrors: pixels whose light fits no surface before a wall, but fits a room behind it.
//!
//! A plane mirror shows the room's image. A point of the image at range r is lit by the images L*
//! of the spots: its light comes after path(L) + |L* − x*| + r. Mirrors hang on walls, so that the
//! greatest planes of the room are the planes that are tried.

use picofarm_scene::Vec3;
use picofarm_settings::Gate;
use rayon::prelude::*;

use crate::{
    Settings,
    geometry::{Plane, Rays, Source, depth_of},
    peaks::Peaks,
    planes::Slants,
};

/// Ranges between which an image is searched, metres.
const STEP_M: f32 = 0.025;
/// Greatest range of an image, metres.
const FARTHEST_M: f32 = 10.0;
/// Distances of mirrors from their wall that are tried, metres.
const OFFSETS: [f32; 5] = [0.005, 0.015, 0.025, 0.035, 0.05];
/// The distance with which mirrors are searched for, metres.
const FIRST: f32 = 0.02;
/// A surface this far behind a wall is none, metres.
const BEHIND: f32 = 0.1;
/// Scores above this are of surfaces, not of images.
const SURE: f32 = 0.85;
/// The least score of surfaces that tell a wall.
const WALL: f32 = 0.6;
/// Metres by which a mirror's first light is later than its own surface's would be.
const LATE_M: f32 = 0.4;
/// Margin of an image over a surface from which on a mirror is more probable than not.
const MARGIN: f32 = 0.15;
/// Margin of pixels that are no candidates.
const NO_FIT: f32 = -0.2;
/// Margin that changes the odds by e.
const SCALE: f32 = 0.05;
/// Share of the pixels with a sure surface that may seem to be behind a wall.
const OPEN: f32 = 0.02;

/// The search for mirrors.
pub struct Mirrors<'a> {
    pub rays: &'a Rays,
    pub histogram: &'a [f32],
    pub gate: &'a Gate,
    pub sources: &'a [Source],
    /// The greatest range at which no light comes too early.
    pub bound: &'a [f32],
    pub settings: &'a Settings,
}

/// One pixel's light under the best surface and under the best image.
#[derive(Debug, Clone, Copy, Default)]
struct Fit {
    plane: usize,
    margin: f32,
}

impl Mirrors<'_> {
    /// Returns the probability of each pixel to see a mirror, and gives those that do the mirror's
    /// plane.
    pub fn find(&self, walls: &[Plane], slants: &mut Slants) -> Vec<f32> {
        let rays = self.rays;
        let walls: Vec<Plane> = walls
            .iter()
            .copied()
            .filter(|w| self.encloses(w, slants))
            .collect();
        let planes: Vec<Plane> = walls.iter().map(|w| nearer(w, FIRST)).collect();
        let reach = crate::sweep::reach(self.gate, self.settings);
        let bins = self.gate.bins as usize;
        let images: Vec<Vec<Source>> = planes.iter().map(|p| self.images(p)).collect();
        let fits: Vec<Option<Fit>> = (0..rays.len())
            .into_par_iter()
            .map_init(Worker::default, |w, p| {
                let found = slants.depth(rays, p) * rays.slant[p];
                let sure = slants.score[p] > SURE;
                let behind = |plane: &Plane| {
                    let range = range_of(plane, rays, p);
                    // Light that comes late enough for an image.
                    let late = self.bound[p] > range + LATE_M;
                    let open = found > range - 0.15 && !sure;
                    late && open && range < self.settings.farthest_m
                };
                if !planes.iter().any(behind) {
                    return None;
                }
                let h = &self.histogram[p * bins..][..bins];
                w.peaks.find(h, reach, self.sources.len(), self.settings);
                let mut best: Option<Fit> = None;
                for (k, plane) in planes.iter().enumerate() {
                    if !behind(plane) {
                        continue;
                    }
                    let range = range_of(plane, rays, p);
                    let wall = range + 2.0 * FIRST;
                    let direct = self.best(w, p, self.sources, self.settings.nearest_m, wall);
                    let image = self.best(w, p, &images[k], range + 0.1, FARTHEST_M);
                    let margin = (image - direct) / (image.max(direct) + 1.0);
                    if best.is_none_or(|b| margin > b.margin) {
                        best = Some(Fit { plane: k, margin });
                    }
                }
                best
            })
            .collect();
        let chance: Vec<f32> = (0..rays.len())
            .into_par_iter()
            .map(|p| match fits[p] {
                Some(fit) => self.chance(p, fit.plane, &fits),
                None => 0.0,
            })
            .collect();
        self.settle(&chance, &fits, &walls, slants)
    }

    /// Whether nearly all that is seen is in front of a plane: it is a wall of the room.
    fn encloses(&self, plane: &Plane, slants: &Slants) -> bool {
        let rays = self.rays;
        let sure = (0..rays.len()).filter(|p| slants.score[*p] > WALL);
        let (mut all, mut behind) = (0, 0);
        for p in sure {
            let range = range_of(plane, rays, p);
            all += 1;
            behind += u32::from(slants.depth(rays, p) * rays.slant[p] > range + BEHIND);
        }
        (behind as f32) < OPEN * all as f32
    }

    /// The spots' images behind a plane.
    fn images(&self, plane: &Plane) -> Vec<Source> {
        let n = Vec3::new(plane[0], plane[1], plane[2]);
        let square = n.dot(n);
        let mirrored = |s: &Source| {
            let point = s.point - n * (2.0 * (n.dot(s.point) - 1.0) / square);
            Source::new(s.beam, point, s.path_m)
        };
        self.sources.iter().map(mirrored).collect()
    }

    /// The most that stands out at the times of any range.
    fn best(&self, w: &mut Worker, p: usize, sources: &[Source], from: f32, to: f32) -> f32 {
        let out = &w.peaks.out;
        let (start, per_bin) = (self.gate.start_m as f32, 1.0 / self.gate.bin_width_m as f32);
        let ray = self.rays.unit[p];
        let mut best = 0.0f32;
        let count = ((to - from) / STEP_M).max(0.0) as usize + 1;
        for n in 0..count {
            let x = ray * (from + n as f32 * STEP_M);
            w.taken.clear();
            w.taken.resize(out.len().div_ceil(64), 0u64);
            let mut sum = 0.0;
            for s in sources {
                let t = (s.path(x) - start) * per_bin - 0.5;
                if !(t >= 0.0 && t < (out.len() - 1) as f32) {
                    continue;
                }
                let j = t as usize;
                let f = t - j as f32;
                let nearest = j + usize::from(f >= 0.5);
                let (word, bit) = (&mut w.taken[nearest / 64], 1u64 << (nearest % 64));
                if *word & bit == 0 {
                    *word |= bit;
                    sum += out[j] + f * (out[j + 1] - out[j]);
                }
            }
            best = best.max(sum);
        }
        best
    }

    /// Probability from the mean margin of a pixel's neighbours under one plane.
    fn chance(&self, p: usize, plane: usize, fits: &[Option<Fit>]) -> f32 {
        let rays = self.rays;
        let reach = (rays.width / 64).max(1);
        let (column, row) = (p % rays.width, p / rays.width);
        let (mut sum, mut count) = (0.0, 0.0);
        for v in row.saturating_sub(reach)..(row + reach + 1).min(rays.height) {
            for u in column.saturating_sub(reach)..(column + reach + 1).min(rays.width) {
                sum += match fits[v * rays.width + u] {
                    Some(fit) if fit.plane == plane => fit.margin,
                    _ => NO_FIT,
                };
                count += 1.0;
            }
        }
        let odds = (sum / count - MARGIN) / SCALE;
        1.0 / (1.0 + libm::expf(-odds.clamp(-30.0, 30.0)))
    }

    /// Leaves regions of some size, and gives their pixels the plane at the distance from the wall
    /// at which their light fits best.
    fn settle(
        &self,
        chance: &[f32],
        fits: &[Option<Fit>],
        walls: &[Plane],
        slants: &mut Slants,
    ) -> Vec<f32> {
        let rays = self.rays;
        let least = (rays.len() / 2000).max(4);
        let mut out = chance.to_vec();
        let mut seen = vec![false; rays.len()];
        for first in 0..rays.len() {
            if seen[first] || chance[first] < 0.5 {
                continue;
            }
            let plane = fits[first].map_or(0, |f| f.plane);
            let mut region = vec![first];
            seen[first] = true;
            let mut next = 0;
            while next < region.len() {
                let p = region[next];
                next += 1;
                let (column, row) = (p % rays.width, p / rays.width);
                let near = [
                    (column > 0).then(|| p - 1),
                    (column + 1 < rays.width).then(|| p + 1),
                    (row > 0).then(|| p - rays.width),
                    (row + 1 < rays.height).then(|| p + rays.width),
                ];
                for q in near.into_iter().flatten() {
                    if !seen[q] && chance[q] >= 0.5 && fits[q].is_some_and(|f| f.plane == plane) {
                        seen[q] = true;
                        region.push(q);
                    }
                }
            }
            if region.len() < least {
                for p in region {
                    out[p] = out[p].min(0.45);
                }
                continue;
            }
            let plane = self.distance(&region, &walls[plane]);
            for p in region {
                slants.plane[p] = plane;
            }
        }
        out
    }

    /// A wall's plane moved to where the light of a region fits best.
    fn distance(&self, region: &[usize], wall: &Plane) -> Plane {
        let reach = crate::sweep::reach(self.gate, self.settings);
        let bins = self.gate.bins as usize;
        let stride = (region.len() / 200).max(1);
        let tried: Vec<Plane> = OFFSETS.iter().map(|d| nearer(wall, *d)).collect();
        let images: Vec<Vec<Source>> = tried.iter().map(|p| self.images(p)).collect();
        let sums: Vec<Vec<f32>> = region
            .par_iter()
            .step_by(stride)
            .map_init(Worker::default, |w, p| {
                let h = &self.histogram[p * bins..][..bins];
                w.peaks.find(h, reach, self.sources.len(), self.settings);
                let of = |(plane, images): (&Plane, &Vec<Source>)| {
                    let range = range_of(plane, self.rays, *p);
                    self.best(w, *p, images, range + 0.1, FARTHEST_M)
                };
                tried.iter().zip(&images).map(of).collect()
            })
            .collect();
        let total = |k: usize| sums.iter().map(|s| f64::from(s[k])).sum::<f64>();
        let best = (0..tried.len()).fold(0, |b, k| if total(k) > total(b) { k } else { b });
        tried[best]
    }
}

#[derive(Default)]
struct Worker {
    peaks: Peaks,
    taken: Vec<u64>,
}

/// A plane moved towards the camera, metres.
fn nearer(plane: &Plane, by: f32) -> Plane {
    let long = Vec3::new(plane[0], plane[1], plane[2]).length();
    let scale = 1.0 / (1.0 - by * long).max(0.1);
    plane.map(|x| x * scale)
}

/// Range of a plane along a pixel's ray; infinite where it is behind the camera.
fn range_of(plane: &Plane, rays: &Rays, p: usize) -> f32 {
    depth_of(plane, rays.film(p)) * rays.slant[p]
}
