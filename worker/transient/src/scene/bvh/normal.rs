//! The normal of a triangle.

use picofarm_scene::Vec3;

/// Returns the unit normal (v1−v0)×(v2−v0), computed in f64; `None` for a triangle without area.
pub(crate) fn normal(t: &[Vec3; 3]) -> Option<Vec3> {
    let wide = |v: Vec3| [f64::from(v.x), f64::from(v.y), f64::from(v.z)];
    let [a, b, c] = t.map(wide);
    let e = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
    let f = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
    let n = [
        e[1] * f[2] - e[2] * f[1],
        e[2] * f[0] - e[0] * f[2],
        e[0] * f[1] - e[1] * f[0],
    ];
    let length = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
    if length.is_finite() && length > 0.0 {
        let k = 1.0 / length;
        Some(Vec3::new(
            (n[0] * k) as f32,
            (n[1] * k) as f32,
            (n[2] * k) as f32,
        ))
    } else {
        None
    }
}
