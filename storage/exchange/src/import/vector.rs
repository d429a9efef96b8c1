//! Vector operations.

/// Returns the length of a vector.
pub(super) fn norm(a: [f64; 3]) -> f64 {
    libm::sqrt(a.iter().map(|x| x * x).sum())
}

/// Returns the distance between two points.
pub(super) fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    norm([a[0] - b[0], a[1] - b[1], a[2] - b[2]])
}

/// Returns the scalar product.
pub(super) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
