//! Estimates the extent of a scene that camera and light reach, and cuts triangles to sizes that
//! f32 can represent. A scene's scale must not depend on objects far outside its rooms, nor on how
//! far a wall extends behind them.

use picofarm_scene::{Scene, Vec3};

use crate::{
    api::{RenderError, Stop},
    rng::{Rng, Stream},
};

/// A point in metres from the camera.
pub(crate) type Point = [f64; 3];

/// Ratio of a scene's width to its reached width above which the scale depends on the reached
/// width.
const SLACK: f64 = 4.0;
/// Number of probes in all directions, along each side of the image, and the largest number along
/// beams; and the bounces of each probe.
const ROUND: u32 = 64;
const ACROSS: u32 = 8;
const BEAMS: usize = 32;
const BOUNCES: u32 = 3;
/// Largest extent of a wall that counts, as a multiple of the distance at which it was hit.
const BEYOND: f64 = 2.0;

/// Distance of the first cut, render units: twice the extent of a fully reached scene. Beyond it,
/// there is a cut at every further factor.
const FIRST_CUT: f64 = 16.0;
const FACTOR: f64 = 8.0;

/// Returns the largest distance from the camera, along an axis, of the surfaces that contribute
/// light: `widest`, unless the probes' hits are much nearer. No surface farther than `horizon`
/// counts.
///
/// # Errors
/// [`RenderError::Stopped`] if the render was stopped.
pub(crate) fn reach(
    scene: &Scene,
    triangles: &[[Point; 3]],
    (widest, horizon): (f64, f64),
    stop: Stop,
) -> Result<f64, RenderError> {
    let i = &scene.camera.intrinsics;
    let origin = wide(scene.camera.origin);
    let laser = sub(wide(scene.laser.origin), origin);
    let mut probe = Probe {
        triangles,
        found: 0.0,
        enough: widest / SLACK,
        horizon,
        rng: Rng::new(0, Stream::Extent, 0, 0),
    };
    let mut starts = vec![];
    for k in 0..ACROSS * ACROSS {
        let at = |k: u32, length: u32| (k as f32 + 0.5) / ACROSS as f32 * length as f32;
        let (x, y) = (at(k % ACROSS, i.width), at(k / ACROSS, i.height));
        starts.push(([0.0; 3], wide(scene.camera.ray(x, y))));
    }
    for beam in scene.laser.beams.iter().take(BEAMS) {
        starts.push((laser, wide(beam.direction)));
    }
    for _ in 0..ROUND {
        let d = probe.direction();
        starts.push(([0.0; 3], d));
    }
    for (from, direction) in starts {
        // Each walk tests all triangles.
        stop.check()?;
        if probe.walk(from, direction) {
            return Ok(widest);
        }
    }
    Ok(match probe.found > 0.0 {
        true => probe.found,
        false => widest,
    })
}

struct Probe<'a> {
    triangles: &'a [[Point; 3]],
    /// Largest distance of a surface so far.
    found: f64,
    enough: f64,
    horizon: f64,
    rng: Rng,
}

impl Probe<'_> {
    /// Follows light from a point. Returns true if the distance reached is enough.
    fn walk(&mut self, mut from: Point, mut direction: Point) -> bool {
        for _ in 0..=BOUNCES {
            let Some((k, at)) = self.first(from, direction) else {
                return false;
            };
            if largest(at) > self.horizon {
                return false;
            }
            let t = &self.triangles[k];
            let all = t.iter().fold(0.0f64, |a, &p| a.max(largest(p)));
            let until = all.min(BEYOND * largest(at)).min(self.horizon);
            self.found = self.found.max(until);
            if self.found > self.enough {
                return true;
            }
            let n = cross(sub(t[1], t[0]), sub(t[2], t[0]));
            let side = dot(n, direction);
            let d = self.direction();
            direction = match dot(n, d) * side > 0.0 {
                true => d.map(|x| -x),
                false => d,
            };
            // Moves off the surface by more than the rounding of f64.
            let off = 1e-9 * largest(at).max(largest(from)) / dot(n, n).sqrt();
            let off = if side > 0.0 { -off } else { off };
            from = std::array::from_fn(|a| at[a] + off * n[a]);
        }
        false
    }

    /// Returns a direction, uniform over the sphere, by rejection, so that the bits are the same
    /// everywhere.
    fn direction(&mut self) -> Point {
        loop {
            let d = std::array::from_fn(|_| 2.0 * f64::from(self.rng.uniform()) - 1.0);
            let square = dot(d, d);
            if square > 0.01 && square <= 1.0 {
                return d;
            }
        }
    }

    /// Returns the first surface from a point along a direction: triangle and point (Möller and
    /// Trumbore 1997).
    fn first(&self, from: Point, d: Point) -> Option<(usize, Point)> {
        let mut best = (f64::INFINITY, usize::MAX);
        for (k, [a, b, c]) in self.triangles.iter().enumerate() {
            let (e, f) = (sub(*b, *a), sub(*c, *a));
            let p = cross(d, f);
            let det = dot(e, p);
            if det == 0.0 {
                continue;
            }
            let s = sub(from, *a);
            let u = dot(s, p) / det;
            if !(0.0..=1.0).contains(&u) {
                continue;
            }
            let q = cross(s, e);
            let v = dot(d, q) / det;
            let t = dot(f, q) / det;
            if v >= 0.0 && u + v <= 1.0 && t > 0.0 && t < best.0 {
                best = (t, k);
            }
        }
        let at = || std::array::from_fn(|a| from[a] + best.0 * d[a]);
        (best.1 != usize::MAX).then(|| (best.1, at()))
    }
}

/// A corner: a point and its texture coordinates.
pub(crate) type Corner = (Point, [f64; 2]);

/// Cuts a triangle at the nearest box around the camera and at each larger one, so that every
/// piece's corners are about as far away as the piece. `scale` is render units per metre. Returns
/// `None` if no cut is needed. Triangles with a common edge are cut at the same points of it, so no
/// gap opens.
pub(crate) fn cut(triangle: [Corner; 3], scale: f64) -> Option<Vec<[Corner; 3]>> {
    let far = triangle.iter().fold(0.0f64, |a, c| a.max(largest(c.0)));
    let first = FIRST_CUT / scale;
    if far <= first {
        return None;
    }
    let mut pieces = vec![triangle.to_vec()];
    for axis in 0..3 {
        let mut at = first;
        while at < far {
            for plane in [-at, at] {
                pieces = pieces
                    .into_iter()
                    .flat_map(|p| halves(&p, axis, plane))
                    .collect();
            }
            at *= FACTOR;
        }
    }
    let fan = |p: Vec<Corner>| -> Vec<[Corner; 3]> {
        (2..p.len()).map(|k| [p[0], p[k - 1], p[k]]).collect()
    };
    Some(pieces.into_iter().flat_map(fan).collect())
}

/// Returns the parts of a convex polygon below and above a plane across an axis.
fn halves(polygon: &[Corner], axis: usize, plane: f64) -> Vec<Vec<Corner>> {
    let at = |c: &Corner| c.0[axis];
    let above = polygon.iter().any(|c| at(c) > plane);
    let below = polygon.iter().any(|c| at(c) < plane);
    if !(above && below) {
        return vec![polygon.to_vec()];
    }
    let (mut low, mut high) = (vec![], vec![]);
    for (k, a) in polygon.iter().enumerate() {
        let b = &polygon[(k + 1) % polygon.len()];
        if at(a) <= plane {
            low.push(*a);
        }
        if at(a) >= plane {
            high.push(*a);
        }
        if (at(a) < plane && at(b) > plane) || (at(a) > plane && at(b) < plane) {
            let meet = meet(a, b, axis, plane);
            low.push(meet);
            high.push(meet);
        }
    }
    vec![low, high]
}

/// Returns the intersection of an edge and a plane: the same point from either end.
fn meet(a: &Corner, b: &Corner, axis: usize, plane: f64) -> Corner {
    let (a, b) = if a.0[axis] < b.0[axis] {
        (a, b)
    } else {
        (b, a)
    };
    let t = (plane - a.0[axis]) / (b.0[axis] - a.0[axis]);
    let mix = |a: f64, b: f64| a * (1.0 - t) + b * t;
    let mut p: Point = std::array::from_fn(|k| mix(a.0[k], b.0[k]));
    p[axis] = plane;
    (p, std::array::from_fn(|k| mix(a.1[k], b.1[k])))
}

/// Returns the unit normal; `None` for a triangle without area.
pub(crate) fn normal(t: &[Point; 3]) -> Option<Vec3> {
    let n = cross(sub(t[1], t[0]), sub(t[2], t[0]));
    let length = dot(n, n).sqrt();
    let unit = || Vec3::from(n.map(|x| (x / length) as f32));
    (length.is_finite() && length > 0.0).then(unit)
}

pub(crate) fn wide(v: Vec3) -> Point {
    [f64::from(v.x), f64::from(v.y), f64::from(v.z)]
}

fn largest(p: Point) -> f64 {
    p.iter().fold(0.0, |a, x| a.max(x.abs()))
}

fn sub(a: Point, b: Point) -> Point {
    std::array::from_fn(|k| a[k] - b[k])
}

fn dot(a: Point, b: Point) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: Point, b: Point) -> Point {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(t: &[Corner; 3]) -> f64 {
        let n = cross(sub(t[1].0, t[0].0), sub(t[2].0, t[0].0));
        0.5 * dot(n, n).sqrt()
    }

    #[test]
    fn pieces_cover_their_triangle_and_meet_their_neighbours_pieces() {
        let corner = |p: Point| (p, [p[0], p[1]]);
        let [a, b, c, d] = [
            [-1e5, -2e3, 30.0],
            [7e4, -5e4, -400.0],
            [3e3, 9e4, 1e3],
            [2e5, 2e5, 7e3],
        ]
        .map(corner);
        let (one, other) = (cut([a, b, c], 1.0).unwrap(), cut([c, b, d], 1.0).unwrap());
        for (pieces, whole) in [(&one, [a, b, c]), (&other, [c, b, d])] {
            let sum: f64 = pieces.iter().map(area).sum();
            assert!((sum / area(&whole) - 1.0).abs() < 1e-9);
            assert!(
                pieces
                    .iter()
                    .flatten()
                    .all(|c| (c.0[0] - c.1[0]).abs() < 1e-6)
            );
        }
        // Both have the same corners along the common edge.
        let along = |pieces: &[[Corner; 3]]| {
            let e = sub(c.0, b.0);
            let on = |p: Point| {
                let x = cross(sub(p, b.0), e);
                dot(x, x).sqrt() < 1e-6 * dot(e, e) / 1e5
            };
            let mut all: Vec<[u64; 3]> = pieces
                .iter()
                .flatten()
                .filter(|c| on(c.0))
                .map(|c| c.0.map(f64::to_bits))
                .collect();
            all.sort_unstable();
            all.dedup();
            all
        };
        assert!(along(&one).len() > 10, "{}", along(&one).len());
        assert_eq!(along(&one), along(&other));
    }

    #[test]
    fn what_is_near_is_not_cut() {
        let corner = |p: Point| (p, [0.0; 2]);
        let t = [[0.0, 0.0, 1.0], [8.0, 0.0, 1.0], [0.0, 8.0, 1.0]].map(corner);
        assert!(cut(t, 1.0).is_none());
    }
}
