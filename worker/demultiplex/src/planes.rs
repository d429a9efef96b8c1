//! Slanted planes over the image (PatchMatch stereo, Bleyer et al., BMVC 2011): each pixel takes
//! the plane under which the scores of its neighbourhood are best, out of its neighbours' planes,
//! those of the whole room, and small changes.

use picofarm_scene::Vec3;
use picofarm_settings::random::{GOLDEN, SplitMix64};
use rayon::prelude::*;

use crate::{
    Settings,
    geometry::{Plane, Rays, depth_of, fit},
    sweep::Volume,
};

/// Differences of log intensity at which a neighbour counts half.
const ALIKE: f32 = 0.3;
/// Depths leap by more than this share at an edge of an object.
const LEAP: f32 = 0.04;
/// Share of depth within which a pixel belongs to a plane of the room.
const NEAR: f32 = 0.01;

/// A plane for each pixel, and the mean score of its neighbourhood under it.
#[derive(Debug, Clone)]
pub struct Slants {
    pub plane: Vec<Plane>,
    pub score: Vec<f32>,
}

impl Slants {
    /// z-depth of a pixel.
    pub fn depth(&self, rays: &Rays, p: usize) -> f32 {
        depth_of(&self.plane[p], rays.film(p))
    }
}

/// What the planes are judged by.
pub struct Judge<'a> {
    pub rays: &'a Rays,
    pub volume: &'a Volume,
    /// Log intensity of each pixel.
    pub log: &'a [f32],
    pub settings: &'a Settings,
}

impl Judge<'_> {
    /// Mean score of a pixel's neighbourhood under a plane.
    fn score(&self, p: usize, plane: &Plane) -> f32 {
        let rays = self.rays;
        let reach = self.settings.plane_reach;
        let (column, row) = (p % rays.width, p / rays.width);
        let (mut sum, mut weight) = (0.0, 0.0);
        for v in row.saturating_sub(reach)..(row + reach + 1).min(rays.height) {
            for u in column.saturating_sub(reach)..(column + reach + 1).min(rays.width) {
                let q = v * rays.width + u;
                let alike = (self.log[q] - self.log[p]).abs() / ALIKE;
                let w = 1.0 / (1.0 + alike * alike);
                let z = depth_of(plane, rays.film(q));
                sum += w * self.volume.at(q, z * rays.slant[q]);
                weight += w;
            }
        }
        let range = depth_of(plane, rays.film(p)) * rays.slant[p];
        let beyond = (range - self.volume.bound[p]) / self.settings.early_slack_m;
        sum / weight - self.settings.early_cost * beyond.clamp(0.0, 1.0)
    }

    /// The plane across the view at a z-depth.
    fn across(z: f32) -> Plane {
        [0.0, 0.0, 1.0 / z]
    }

    /// Planes that fit best, from a first map of z-depths.
    pub fn planes(&self, depth: &[f32]) -> Slants {
        let rays = self.rays;
        let first = |p: usize| {
            let fitted = fit(rays, depth, p, 2, LEAP).map(|f| through(f, rays.film(p), depth[p]));
            let flat = Self::across(depth[p]);
            let own = self.score(p, &flat);
            match fitted.map(|f| (f, self.score(p, &f))) {
                Some((f, score)) if score > own => (f, score),
                _ => (flat, own),
            }
        };
        let (plane, score) = (0..rays.len()).into_par_iter().map(first).unzip();
        let mut slants = Slants { plane, score };
        for round in 0..self.settings.plane_rounds {
            let room = self.room(&slants);
            for colour in 0..2 {
                let found: Vec<Option<(Plane, f32)>> = (0..rays.len())
                    .into_par_iter()
                    .map(|p| {
                        let (column, row) = (p % rays.width, p / rays.width);
                        match (column + row) % 2 == colour {
                            true => self.better(p, &slants, &room, round),
                            false => None,
                        }
                    })
                    .collect();
                for (p, found) in found.into_iter().enumerate() {
                    if let Some((plane, score)) = found {
                        slants.plane[p] = plane;
                        slants.score[p] = score;
                    }
                }
            }
        }
        slants
    }

    /// A better plane for a pixel, if there is one.
    fn better(
        &self,
        p: usize,
        slants: &Slants,
        room: &[Plane],
        round: u32,
    ) -> Option<(Plane, f32)> {
        let rays = self.rays;
        let (column, row) = ((p % rays.width) as i64, (p / rays.width) as i64);
        let mut best: Option<(Plane, f32)> = None;
        let mut level = slants.score[p];
        let mut ask = |plane: Plane| {
            let score = self.score(p, &plane);
            if score > level + 1e-4 {
                level = score;
                best = Some((plane, score));
            }
        };
        // All of the other colour.
        for (dx, dy) in [
            (1, 0),
            (-1, 0),
            (0, 1),
            (0, -1),
            (3, 0),
            (-3, 0),
            (0, 3),
            (0, -3),
            (9, 0),
            (-9, 0),
            (0, 9),
            (0, -9),
        ] {
            let (u, v) = (column + dx, row + dy);
            if u >= 0 && v >= 0 && u < rays.width as i64 && v < rays.height as i64 {
                ask(slants.plane[v as usize * rays.width + u as usize]);
            }
        }
        for plane in room {
            ask(*plane);
        }
        // Small changes of depth and slant, other ones for each pixel and round.
        let plane = slants.plane[p];
        let film = rays.film(p);
        let mut noise = Noise::new(p as u64, u64::from(round));
        for shrink in 0..3 {
            let size = 0.5f32.powi(shrink + round as i32);
            let w = 1.0 / depth_of(&plane, film);
            let a = plane[0] + w * 0.4 * size * noise.signed();
            let b = plane[1] + w * 0.4 * size * noise.signed();
            let w = w * (1.0 + 0.02 * size * noise.signed());
            ask([a, b, w - a * film.x - b * film.y]);
        }
        best
    }

    /// Planes to which many pixels belong, the greatest first.
    pub fn room(&self, slants: &Slants) -> Vec<Plane> {
        const MOST: usize = 12;
        let rays = self.rays;
        let stride = (rays.width / 32).max(1);
        let sampled = |p: &usize| {
            (p % rays.width).is_multiple_of(stride) && (p / rays.width).is_multiple_of(stride)
        };
        let points: Vec<usize> = (0..rays.len()).filter(sampled).collect();
        let mut free: Vec<bool> = points.iter().map(|p| slants.score[*p] > 0.0).collect();
        let belongs = |plane: &Plane, p: usize| {
            let z = slants.depth(rays, p);
            (depth_of(plane, rays.film(p)) - z).abs() < NEAR * z
        };
        let mut all = Vec::new();
        while all.len() < MOST {
            let count = |&n: &usize| -> usize {
                let plane = &slants.plane[points[n]];
                points
                    .iter()
                    .zip(&free)
                    .filter(|(q, free)| **free && belongs(plane, **q))
                    .count()
            };
            let candidates: Vec<usize> = (0..points.len()).filter(|n| free[*n]).collect();
            let counts: Vec<usize> = candidates.par_iter().map(count).collect();
            let Some(best) = (0..counts.len()).max_by_key(|n| (counts[*n], usize::MAX - n)) else {
                break;
            };
            if counts[best] * 100 < points.len() {
                break;
            }
            let plane = slants.plane[points[candidates[best]]];
            for (q, free) in points.iter().zip(&mut free) {
                *free &= !belongs(&plane, *q);
            }
            all.push(plane);
        }
        all
    }
}

/// The plane moved along the ray of a film point to a z-depth there.
fn through(plane: Plane, film: Vec3, z: f32) -> Plane {
    [
        plane[0],
        plane[1],
        1.0 / z - plane[0] * film.x - plane[1] * film.y,
    ]
}

/// Random numbers that follow from pixel and round alone.
struct Noise(SplitMix64);

impl Noise {
    fn new(pixel: u64, round: u64) -> Self {
        let state = pixel.wrapping_mul(GOLDEN) ^ round.wrapping_mul(0xd1b5_4a32_d192_ed03);
        Self(SplitMix64(state))
    }

    /// Returns a uniform number in [−1, 1).
    fn signed(&mut self) -> f32 {
        (self.0.bits() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}
