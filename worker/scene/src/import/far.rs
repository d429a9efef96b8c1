//! Coordinates far from the origin. Files contain them in double precision, scenes in single
//! precision. If rounding would be visible, a mesh or a scene is moved to the origin before it is
//! rounded.

use crate::Vec3;

/// The largest error of rounding to single precision, metres: a tenth of a picosecond of light.
const LOSS_M: f64 = 3e-5;
/// The largest error as a share of the size of a mesh.
const LOSS: f64 = 1e-5;

/// Returns the centre and diagonal of the bounding box of points, or `None` without any, and for
/// non-finite points.
pub(super) fn centre(points: &[[f64; 3]]) -> Option<([f64; 3], f64)> {
    let side = |k: usize| {
        let ends = (f64::INFINITY, f64::NEG_INFINITY);
        let all = points.iter().map(|p| p[k]);
        all.fold(ends, |(lo, hi), x| (lo.min(x), hi.max(x)))
    };
    let sides = [0, 1, 2].map(side);
    let centre = sides.map(|(lo, hi)| 0.5 * lo + 0.5 * hi);
    let square: f64 = sides.iter().map(|(lo, hi)| (hi - lo) * (hi - lo)).sum();
    let finite = points.iter().flatten().all(|x| x.is_finite());
    (!points.is_empty() && finite && square.is_finite()).then(|| (centre, square.sqrt()))
}

/// Returns whether rounding loses too much for an object of this size at this position.
pub(super) fn is_lossy(place: [f64; 3], size: f64) -> bool {
    let largest = place.iter().fold(0.0f64, |m, x| m.max(x.abs()));
    largest * f64::from(f32::EPSILON) * 0.5 > LOSS_M.min(LOSS * size)
}

/// Returns points relative to an origin, subtracted before they are rounded.
pub(super) fn relative(points: &[[f64; 3]], origin: [f64; 3]) -> Vec<Vec3> {
    let place = |p: &[f64; 3]| Vec3::from(std::array::from_fn(|k| (p[k] - origin[k]) as f32));
    points.iter().map(place).collect()
}

/// Returns points, and the origin of their frame. If rounding would be visible, the frame is
/// centred on the points.
pub(super) fn local(points: &[[f64; 3]]) -> (Vec<Vec3>, [f64; 3]) {
    let origin = match centre(points) {
        Some((centre, size)) if is_lossy(centre, size) => centre,
        _ => [0.0; 3],
    };
    (relative(points, origin), origin)
}

/// Returns a note on a scene that was moved.
pub(super) fn note([x, y, z]: [f64; 3]) -> String {
    format!(
        "moved from [{x}, {y}, {z}] to [0, 0, 0], to keep the digits of coordinates far from it"
    )
}
