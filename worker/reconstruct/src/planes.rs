//! Planes of the room: large planes that visible points are on, with their openings. They close the
//! room outside the camera's view, and stabilise the depth of points on them.

use picofarm_scene::Vec3;

use crate::{
    Depth, Measured,
    rng::{Rng, Stream},
    walls::{Wall, walls},
};

/// The greatest number of planes.
const MOST: usize = 8;
/// The number of candidates for each plane.
const TRIES: usize = 300;
/// The distance between the pixels that are used.
const STRIDE: usize = 7;
/// The distance within which points are on a plane, metres; larger if times are noisy.
const CLOSE_M: f32 = 0.02;
/// The least cosine between a point's normal and the plane's.
const ALIKE: f32 = 0.9;
/// The least share of the pixels on a plane.
const LEAST_SHARE: f32 = 1.0 / 40.0;
/// The distance from which points are behind a plane, as a multiple of the tolerance.
const BEHIND: f32 = 3.0;

/// The half space n·x ≤ c of the room.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// The unit normal, pointing out of the room.
    pub normal: Vec3,
    /// The offset, metres.
    pub offset: f32,
}

impl Plane {
    /// Returns the distance into the room, metres; negative behind the plane.
    #[inline]
    pub fn inside(&self, x: Vec3) -> f32 {
        self.offset - self.normal.dot(x)
    }
}

/// A plane that many pixels see.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Candidate {
    pub plane: Plane,
    /// The share of the pixels on it.
    pub share: f32,
}

/// A pixel's point and its normal, pointing out of the room.
type Point = (Vec3, Vec3);

/// Finds planes by random sample consensus (Fischler and Bolles 1981) over the pixels' points and
/// normals, the largest first, each refined by least squares. Returns those that are walls, and
/// notes on the others and on openings. The lengths are those of the scene times `factor`.
pub(crate) fn planes(
    measured: &Measured,
    depth: &Depth,
    (seed, factor): (u64, f32),
) -> (Vec<Wall>, Vec<String>) {
    let mut errors: Vec<f32> = depth
        .error
        .iter()
        .copied()
        .filter(|e| e.is_finite())
        .collect();
    errors.sort_by(f32::total_cmp);
    let typical = errors.get(errors.len() / 2).copied().unwrap_or(0.0);
    let close = CLOSE_M.max(2.0 * typical).min(3.0 * CLOSE_M);
    let points: Vec<Point> = (0..depth.range.len())
        .step_by(STRIDE)
        .filter(|&p| depth.range[p].is_finite() && depth.normal[p] != Vec3::ZERO)
        .filter(|&p| !measured.is_doubtful(p))
        .map(|p| {
            let x = measured.camera.origin + measured.ray(p) * depth.range[p];
            (x, -depth.normal[p])
        })
        .collect();
    let least = (depth.range.len() as f32 * LEAST_SHARE / STRIDE as f32) as usize;
    let mut free = vec![true; points.len()];
    let mut found = Vec::new();
    let mut rng = Rng::new(seed, Stream::Planes, 0);
    let on = |plane: &Plane, (x, n): &Point| {
        plane.inside(*x).abs() < close && plane.normal.dot(*n) > ALIKE
    };
    for _ in 0..2 * MOST {
        let mut best: Option<(usize, Plane)> = None;
        for _ in 0..TRIES {
            let at = rng.below(points.len());
            if !free.get(at).copied().unwrap_or(false) {
                continue;
            }
            let (x, normal) = points[at];
            let plane = Plane {
                normal,
                offset: normal.dot(x),
            };
            let count = points
                .iter()
                .zip(&free)
                .filter(|(q, f)| **f && on(&plane, q))
                .count();
            if best.is_none_or(|(most, _)| count > most) {
                best = Some((count, plane));
            }
        }
        let Some((count, mut plane)) = best.filter(|(count, _)| *count >= least.max(8)) else {
            break;
        };
        for _ in 0..3 {
            let members = points
                .iter()
                .zip(&free)
                .filter(|(q, f)| **f && on(&plane, q));
            plane = least_squares(members.map(|(q, _)| q.0), plane);
        }
        for (f, q) in free.iter_mut().zip(&points) {
            *f &= !(plane.inside(q.0).abs() < 2.0 * close && plane.normal.dot(q.1) > ALIKE);
        }
        found.push(Candidate {
            plane,
            share: (count * STRIDE) as f32 / depth.range.len() as f32,
        });
    }
    let (mut found, notes) = walls(measured, depth, (&found, close), factor);
    found.truncate(MOST);
    (found, notes)
}

/// Returns the plane through points with the least sum of squared distances, facing as `plane`
/// does.
fn least_squares(points: impl Iterator<Item = Vec3>, plane: Plane) -> Plane {
    let (mut n, mut mean, mut square) = (0.0f64, [0f64; 3], [[0f64; 3]; 3]);
    for x in points {
        let x = [x.x, x.y, x.z].map(f64::from);
        n += 1.0;
        for a in 0..3 {
            mean[a] += x[a];
            for b in 0..3 {
                square[a][b] += x[a] * x[b];
            }
        }
    }
    if n < 3.0 {
        return plane;
    }
    let m = mean.map(|v| v / n);
    let cov: [[f64; 3]; 3] =
        std::array::from_fn(|a| std::array::from_fn(|b| square[a][b] / n - m[a] * m[b]));
    let normal = smallest_axis(cov, plane.normal);
    let offset = (0..3).map(|a| f64::from(normal[a]) * m[a]).sum::<f64>() as f32;
    Plane { normal, offset }
}

/// Returns the unit eigenvector of the smallest eigenvalue of a covariance, on the side of `near`,
/// by inverse iteration.
fn smallest_axis(mut cov: [[f64; 3]; 3], near: Vec3) -> Vec3 {
    let trace = cov[0][0] + cov[1][1] + cov[2][2];
    for (a, row) in cov.iter_mut().enumerate() {
        row[a] += 1e-9 * trace + 1e-15;
    }
    let [a, b, c] = cov;
    let cross = |u: [f64; 3], v: [f64; 3]| {
        [
            u[1] * v[2] - u[2] * v[1],
            u[2] * v[0] - u[0] * v[2],
            u[0] * v[1] - u[1] * v[0],
        ]
    };
    // Rows of the adjugate, which is the inverse up to a factor.
    let adjugate = [cross(b, c), cross(c, a), cross(a, b)];
    let mut n = [near.x, near.y, near.z].map(f64::from);
    for _ in 0..30 {
        let next: [f64; 3] = std::array::from_fn(|k| (0..3).map(|j| adjugate[j][k] * n[j]).sum());
        let length = next.iter().map(|v| v * v).sum::<f64>().sqrt();
        if length <= 0.0 || !length.is_finite() {
            return near;
        }
        n = next.map(|v| v / length);
    }
    let n = Vec3::new(n[0] as f32, n[1] as f32, n[2] as f32);
    if n.dot(near) < 0.0 { -n } else { n }
}

/// Moves pixels that are on a plane, by position and normal, onto it, and sets their normal to the
/// plane's.
pub fn settle(measured: &Measured, depth: &mut Depth, walls: &[Wall]) {
    for p in 0..depth.range.len() {
        let (range, normal) = (depth.range[p], depth.normal[p]);
        if !range.is_finite() || normal == Vec3::ZERO {
            continue;
        }
        let ray = measured.ray(p);
        let x = measured.camera.origin + ray * range;
        let reach = CLOSE_M.max(3.0 * depth.error[p]).min(4.0 * CLOSE_M);
        let near =
            |plane: &&Plane| plane.inside(x).abs() < reach && -plane.normal.dot(normal) > ALIKE;
        if let Some(plane) = walls.iter().map(|w| &w.plane).find(near) {
            let slope = plane.normal.dot(ray);
            if slope > 0.05 {
                depth.range[p] = range + plane.inside(x) / slope;
                depth.normal[p] = -plane.normal;
            }
        }
    }
}

/// Moves pixels that are behind a closed part of a wall onto it, because nothing is visible there:
/// a mirror on a wall shows a room behind the wall, and light of three bounces comes late. Their
/// light paths are left unused. Returns the number of pixels.
pub fn confine(measured: &mut Measured, depth: &mut Depth, walls: &[Wall]) -> usize {
    let pixels = measured.pixels();
    let mut count = 0;
    for p in 0..pixels {
        if !depth.range[p].is_finite() {
            continue;
        }
        let ray = measured.ray(p);
        let origin = measured.camera.origin;
        let x = origin + ray * depth.range[p];
        let reach = BEHIND * CLOSE_M.max(depth.error[p]);
        let first = walls
            .iter()
            .filter(|wall| wall.plane.inside(x) < -reach)
            .filter_map(|wall| Some((wall.hit(origin, ray)?, wall.plane.normal)))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((range, normal)) = first {
            (depth.range[p], depth.normal[p]) = (range, -normal);
            count += 1;
            for spot in 0..measured.spots.len() {
                measured.used[spot * pixels + p] = 0;
            }
        }
    }
    count
}
