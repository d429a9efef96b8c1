//! Cuts triangles that reach far beyond the scene to sizes that f32 can represent.

use picofarm_scene::Vec3;

use crate::{
    api::{RenderError, Stop},
    numeric::double::{self, Point, largest},
    scene::bvh::normal::normal,
};

/// Distance of the first cut, render units: twice the extent of a fully reached scene. Beyond it,
/// there is a cut at every further factor.
const FIRST_CUT: f64 = 16.0;
const FACTOR: f64 = 8.0;

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::double::{cross, dot, sub};

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

/// The maximum number of pieces that cutting may add, beyond one per triangle. A piece takes some
/// hundred bytes.
const MOST_PIECES: usize = 1 << 22;

/// The triangles after those that are far too wide have been cut.
#[derive(Default)]
pub(crate) struct Cut {
    pub points: Vec<[Point; 3]>,
    pub uv: Vec<[[f32; 2]; 3]>,
    pub normals: Vec<Vec3>,
    /// Index of the triangle that each piece was cut from.
    pub of: Vec<usize>,
}

impl Cut {
    /// Cuts all triangles. `uv` is empty without texture coordinates.
    pub fn of(
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

    pub fn push(&mut self, k: usize, t: &[Point; 3], uv: Option<&[[f32; 2]; 3]>, scale: f64) {
        let unit = |p: Point| Vec3::from(p.map(|x| (x * scale) as f32));
        let corner = |i: usize| (t[i], uv.map_or([0.0; 2], |uv| uv[i].map(f64::from)));
        let pieces = cut([0, 1, 2].map(corner), scale);
        let normal = match &pieces {
            None => normal(&t.map(unit)),
            Some(_) => double::normal(t),
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
