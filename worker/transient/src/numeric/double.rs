//! Points in f64, for lengths before they are scaled to render units.

use picofarm_scene::Vec3;

/// A point in metres from the camera.
pub(crate) type Point = [f64; 3];

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

pub(crate) fn largest(p: Point) -> f64 {
    p.iter().fold(0.0, |a, x| a.max(x.abs()))
}

pub(crate) fn sub(a: Point, b: Point) -> Point {
    std::array::from_fn(|k| a[k] - b[k])
}

pub(crate) fn dot(a: Point, b: Point) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: Point, b: Point) -> Point {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}
