//! Estimates the extent of a scene that camera and light reach, and cuts triangles to sizes that
//! f32 can represent. A scene's scale must not depend on objects far outside its rooms, nor on how
//! far a wall extends behind them.

use picofarm_scene::Scene;

use crate::{
    api::{RenderError, Stop},
    numeric::{
        double::{Point, cross, dot, largest, sub, wide},
        rng::{Rng, Stream},
    },
};

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
