//! Splits polygons into triangles, in the polygon's own plane.

use earcut::Earcut;

/// The greatest number of corners of a non-convex polygon: the search for crossing edges takes
/// their square in the worst case.
const MAX_CONCAVE: usize = 1 << 14;
/// A polygon with corners farther from its plane than this share of its size is not flat.
const FLAT: f64 = 1e-3;
/// Areas below this share of the square of a polygon's size are rounding errors.
const NO_AREA: f64 = 1e-12;
/// The largest difference between the area of a polygon and the areas of its triangles.
const SAME_AREA: f64 = 1e-6;

/// Splits polygons, and counts non-flat ones and those without an area.
#[derive(Debug, Default)]
pub(crate) struct Triangulation {
    /// The number of non-planar polygons with more than three corners.
    pub(crate) bent: usize,
    /// The number of polygons of more than three corners without an area, which are omitted.
    pub(crate) empty: usize,
}

impl Triangulation {
    /// Adds the triangles of a polygon, as indices of corners, to `out`. Convex polygons become
    /// fans around their first corner; triangles are unchanged.
    ///
    /// # Errors
    /// A polygon with crossing edges, or a concave one with too many corners.
    pub(crate) fn split(
        &mut self,
        corners: &[[f64; 3]],
        out: &mut Vec<[u32; 3]>,
    ) -> Result<(), String> {
        if corners.len() <= 3 {
            out.extend((corners.len() == 3).then_some([0, 1, 2]));
            return Ok(());
        }
        if !corners.iter().flatten().all(|x| x.is_finite()) {
            return Err("a corner is not finite; repair the mesh".into());
        }
        let size = extent(corners);
        let origin = corners[0];
        let local: Vec<[f64; 3]> = corners.iter().map(|p| difference(*p, origin)).collect();
        let normal = newell(&local);
        let length = norm(normal);
        if length <= NO_AREA * size * size {
            if is_a_line(&local, size) {
                self.empty += 1;
                return Ok(());
            }
            return Err(CROSSING.into());
        }
        let axis = normal.map(|x| x / length);
        let off = local.iter().map(|p| dot(*p, axis).abs());
        if off.fold(0.0, f64::max) > FLAT * size {
            self.bent += 1;
        }
        let flat = projected(&local, axis);
        let fan = || (2..corners.len() as u32).map(|k| [0, k - 1, k]);
        if is_convex(&flat) {
            out.extend(fan());
            return Ok(());
        }
        if corners.len() > MAX_CONCAVE {
            return Err(format!(
                "a concave polygon of {} corners, more than {MAX_CONCAVE}; split it",
                corners.len()
            ));
        }
        if edges_cross(&flat) {
            return Err(CROSSING.into());
        }
        let mut ears: Vec<u32> = Vec::new();
        Earcut::new().earcut(flat.iter().copied(), &[] as &[u32], &mut ears);
        let ears = ears.as_chunks::<3>().0;
        let covered: f64 = ears.iter().map(|t| area(&flat, *t).abs()).sum();
        if (covered - length).abs() > SAME_AREA * length {
            return Err(CROSSING.into());
        }
        // The triangles have the orientation of the polygon, whatever order the crate returns.
        out.extend(
            ears.iter()
                .map(|&[a, b, c]| match area(&flat, [a, b, c]) < 0.0 {
                    true => [a, c, b],
                    false => [a, b, c],
                }),
        );
        Ok(())
    }

    /// Returns the changes and omissions, for a note.
    pub(crate) fn note(&self) -> Option<String> {
        let bent = (self.bent > 0).then(|| {
            format!(
                "{} polygons are not flat; they were split as they look from the front",
                self.bent
            )
        });
        let empty =
            (self.empty > 0).then(|| format!("{} polygons without an area left out", self.empty));
        match (bent, empty) {
            (Some(bent), Some(empty)) => Some(format!("{bent}; {empty}")),
            (one, other) => one.or(other),
        }
    }
}

const CROSSING: &str = "the edges of a polygon cross, so it has no inside; repair the mesh or triangulate it before export";

fn difference(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn norm(v: [f64; 3]) -> f64 {
    dot(v, v).sqrt()
}

/// Returns the length of the diagonal of the bounding box of points.
fn extent(points: &[[f64; 3]]) -> f64 {
    let side = |k: usize| {
        let all = points.iter().map(|p| p[k]);
        let (lo, hi) = all.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), x| {
            (lo.min(x), hi.max(x))
        });
        hi - lo
    };
    norm([side(0), side(1), side(2)])
}

/// Returns twice the area of a polygon along each axis (Newell).
fn newell(points: &[[f64; 3]]) -> [f64; 3] {
    let mut sum = [0.0; 3];
    for (a, b) in edges(points) {
        for (k, s) in sum.iter_mut().enumerate() {
            let (i, j) = ((k + 1) % 3, (k + 2) % 3);
            *s += a[i] * b[j] - a[j] * b[i];
        }
    }
    sum
}

/// Returns the sides of a closed polygon.
fn edges<T: Copy>(points: &[T]) -> impl Iterator<Item = (T, T)> + '_ {
    let next = points.iter().cycle().skip(1);
    points.iter().copied().zip(next.copied())
}

/// Returns whether all points are on one line.
fn is_a_line(local: &[[f64; 3]], size: f64) -> bool {
    let far = local
        .iter()
        .copied()
        .max_by(|a, b| norm(*a).total_cmp(&norm(*b)));
    let along = far.unwrap_or_default();
    let length = norm(along);
    if length == 0.0 {
        return true;
    }
    let unit = along.map(|x| x / length);
    local.iter().all(|p| {
        let t = dot(*p, unit);
        norm(difference(*p, unit.map(|x| x * t))) <= 1e-9 * size
    })
}

/// Projects the polygon against its normal, counter-clockwise.
fn projected(local: &[[f64; 3]], axis: [f64; 3]) -> Vec<[f64; 2]> {
    // The smallest component of the normal gives the most stable second axis.
    let k = (0..3).fold(0, |m, k| if axis[k].abs() < axis[m].abs() { k } else { m });
    let mut helper = [0.0; 3];
    helper[k] = 1.0;
    let u = cross(helper, axis);
    let u = u.map(|x| x / norm(u));
    let v = cross(axis, u);
    local.iter().map(|p| [dot(*p, u), dot(*p, v)]).collect()
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// Returns twice the signed area of a triangle.
fn turn(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

fn area(flat: &[[f64; 2]], [a, b, c]: [u32; 3]) -> f64 {
    turn(flat[a as usize], flat[b as usize], flat[c as usize])
}

/// Returns whether a fan around the first corner covers the polygon once: no corner turns back, and
/// all corners are within half a turn as seen from the first.
fn is_convex(flat: &[[f64; 2]]) -> bool {
    let n = flat.len();
    let size = flat.iter().flatten().fold(0.0f64, |m, x| m.max(x.abs()));
    let least = -NO_AREA * size * size;
    (0..n).all(|k| {
        let (b, c) = (flat[(k + 1) % n], flat[(k + 2) % n]);
        let in_fan = k < 2 || turn(flat[0], flat[k - 1], flat[k]) >= least;
        let in_half = turn(flat[0], flat[1], flat[k]) >= least;
        turn(flat[k], b, c) >= least && in_fan && in_half
    })
}

/// Returns whether two edges that are not adjacent cross in a point inside both.
fn edges_cross(flat: &[[f64; 2]]) -> bool {
    let mut sides: Vec<([f64; 2], [f64; 2])> = edges(flat).collect();
    let low = |s: &([f64; 2], [f64; 2])| s.0[0].min(s.1[0]);
    sides.sort_by(|a, b| low(a).total_cmp(&low(b)));
    for (i, a) in sides.iter().enumerate() {
        let end = a.0[0].max(a.1[0]);
        let near = sides[i + 1..].iter().take_while(|b| low(b) <= end);
        for b in near {
            let apart = |p: [f64; 2], q: [f64; 2], r: ([f64; 2], [f64; 2])| {
                turn(p, q, r.0) * turn(p, q, r.1) < 0.0
            };
            if apart(a.0, a.1, *b) && apart(b.0, b.1, *a) {
                return true;
            }
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Places corners in an inclined plane, far from the origin.
    fn placed(flat: &[[f64; 2]]) -> Vec<[f64; 3]> {
        let (u, v) = ([0.6, 0.0, 0.8], [0.0, 1.0, 0.0]);
        let at = |p: &[f64; 2]| std::array::from_fn(|k| 1e4 + p[0] * u[k] + p[1] * v[k]);
        flat.iter().map(at).collect()
    }

    fn covered(corners: &[[f64; 3]], triangles: &[[u32; 3]]) -> f64 {
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|k| corners[k as usize]);
            0.5 * norm(cross(difference(b, a), difference(c, a)))
        };
        triangles.iter().map(area).sum()
    }

    /// Checks triangles and covered area, from every first corner and in both orientations.
    fn every_start(flat: &[[f64; 2]], area: f64) {
        for start in 0..flat.len() {
            for back in [false, true] {
                let mut turned = flat.to_vec();
                turned.rotate_left(start);
                if back {
                    turned.reverse();
                }
                let (corners, mut out) = (placed(&turned), Vec::new());
                let mut split = Triangulation::default();
                split.split(&corners, &mut out).expect("simple");
                let found = covered(&corners, &out);
                assert!((found - area).abs() < 1e-6 * area, "{turned:?}: {found}");
                // All triangles have the orientation of the polygon.
                let whole = newell(
                    &corners
                        .iter()
                        .map(|p| difference(*p, corners[0]))
                        .collect::<Vec<_>>(),
                );
                for t in &out {
                    let [a, b, c] = t.map(|k| corners[k as usize]);
                    let normal = cross(difference(b, a), difference(c, a));
                    assert!(dot(normal, whole) >= -1e-9, "{t:?}");
                }
                assert_eq!(split.bent, 0);
            }
        }
    }

    #[test]
    fn concave_polygons_are_covered_from_every_first_corner() {
        every_start(
            &[[0., 0.], [2., 0.], [2., 1.], [1., 1.], [1., 2.], [0., 2.]],
            3.0,
        );
        every_start(&[[0., 0.], [2., 0.], [0.5, 0.5], [0., 2.]], 1.0);
        every_start(&[[0., 0.], [1., 0.], [1., 1.], [0., 1.]], 1.0);
        // Corners on a side, and a slit that goes in and out again (a hole joined to the rim).
        every_start(&[[0., 0.], [1., 0.], [2., 0.], [2., 2.], [0., 2.]], 4.0);
        let hole = [
            [0., 0.],
            [4., 0.],
            [4., 4.],
            [0., 4.],
            [0., 0.],
            [1., 1.],
            [1., 3.],
            [3., 3.],
            [3., 1.],
            [1., 1.],
        ];
        every_start(&hole, 12.0);
    }

    #[test]
    fn convex_polygons_are_fans() {
        let (mut split, mut out) = (Triangulation::default(), Vec::new());
        let corners = placed(&[[0., 0.], [1., 0.], [1., 1.], [0.5, 1.5], [0., 1.]]);
        split.split(&corners, &mut out).expect("convex");
        assert_eq!(out, [[0, 1, 2], [0, 2, 3], [0, 3, 4]]);
        assert_eq!(split.note(), None);
    }

    #[test]
    fn polygons_whose_edges_cross_are_refused_and_others_are_noted() {
        let refused = |flat: &[[f64; 2]]| {
            let said = Triangulation::default().split(&placed(flat), &mut Vec::new());
            assert!(said.is_err_and(|e| e.contains("cross")), "{flat:?}");
        };
        refused(&[[0., 0.], [1., 1.], [1., 0.], [0., 1.]]);
        refused(&[[0., 0.], [3., 1.], [1., 0.], [0., 1.]]);
        let turn = |k: usize| {
            let (s, c) = libm::sincos(std::f64::consts::TAU * (k * 2 % 5) as f64 / 5.0);
            [c, s]
        };
        refused(&std::array::from_fn::<_, 5, _>(turn));
        // A polygon that goes around twice.
        let spiral = |k: usize| {
            let (s, c) = libm::sincos(std::f64::consts::TAU * k as f64 / 5.5);
            [c * (1.0 + 0.1 * k as f64), s * (1.0 + 0.1 * k as f64)]
        };
        refused(&std::array::from_fn::<_, 11, _>(spiral));
        let (mut split, mut out) = (Triangulation::default(), Vec::new());
        let mut bent = placed(&[[0., 0.], [1., 0.], [1., 1.], [0., 1.]]);
        bent[2] = [1e4 + 0.9, 1e4 + 1.0, 1e4];
        split.split(&bent, &mut out).expect("bent");
        split
            .split(&placed(&[[0., 0.], [1., 0.], [2., 0.], [1., 0.]]), &mut out)
            .expect("a line");
        assert_eq!((split.bent, split.empty, out.len()), (1, 1, 2));
        assert!(
            split
                .note()
                .is_some_and(|n| n.contains("not flat") && n.contains("area"))
        );
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

        /// Corners at increasing angles around a point form a simple polygon, whatever their
        /// distances.
        #[test]
        fn a_simple_polygons_triangles_cover_its_area(radii in proptest::collection::vec(0.05f64..1.0, 4..60)) {
            let n = radii.len();
            let flat: Vec<[f64; 2]> = radii.iter().enumerate().map(|(k, r)| {
                let (s, c) = libm::sincos(std::f64::consts::TAU * k as f64 / n as f64);
                [r * c, r * s]
            }).collect();
            let expected: f64 = edges(&flat).map(|(a, b)| a[0] * b[1] - a[1] * b[0]).sum::<f64>() * 0.5;
            let (corners, mut out) = (placed(&flat), Vec::new());
            Triangulation::default().split(&corners, &mut out).expect("simple");
            let found = covered(&corners, &out);
            prop_assert!((found - expected).abs() < 1e-6 * expected, "{found} {expected}");
            prop_assert!(out.iter().flatten().all(|k| (*k as usize) < n));
        }
    }
}
