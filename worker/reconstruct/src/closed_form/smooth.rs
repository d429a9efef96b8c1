//! Smoothing over neighbouring pixels: a plane is linear in inverse z-depth over the image, so a
//! plane fitted to a pixel's neighbours in inverse depth gives its depth with less noise, and its
//! normal.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use super::Depth;
use crate::Measured;

/// The number of pixels on each side of the central one, at a focal length of 256 pixels or more.
/// Coarser images use fewer, so that the fit does not span edges.
const REACH: i64 = 3;
/// The focal length in pixels for each pixel of reach.
const FOCAL: f32 = 128.0;
/// The relative difference in inverse depth up to which a neighbour counts as on the same surface.
/// The same amount is added for each pixel of distance.
const SLOPE: f32 = 0.012;
/// The least number of neighbours of a fit.
const FEWEST: f64 = 6.0;

/// Replaces each pixel's depth by the plane through its neighbours on the same surface, weighted by
/// their errors, and computes normals. A pixel without enough neighbours retains its depth and has
/// no normal.
pub fn smooth(measured: &Measured, depth: &Depth) -> Depth {
    let camera = &measured.camera;
    let i = camera.intrinsics;
    let (width, height) = (i64::from(i.width), i64::from(i.height));
    // In coarse images, the difference between neighbouring pixels is larger.
    let slope = SLOPE * (512.0 * 0.5 / i.fx.min(i.fy)).max(1.0);
    let reach = ((i.fx.min(i.fy) / FOCAL).round() as i64).clamp(1, REACH);
    let rays: Vec<(Vec3, f32)> = (0..measured.pixels())
        .map(|p| {
            let r = measured.ray(p);
            (r, r.dot(camera.forward))
        })
        .collect();
    let inverse: Vec<f32> = depth
        .range
        .iter()
        .zip(&rays)
        .map(|(d, r)| 1.0 / (d * r.1))
        .collect();
    let of = |p: usize| -> (f32, f32, Vec3) {
        let own = (depth.range[p], depth.error[p], Vec3::ZERO);
        if !own.0.is_finite() {
            return own;
        }
        let (u, v) = (p as i64 % width, p as i64 / width);
        let (mut m, mut count) = ([[0f64; 4]; 3], 0.0);
        for dv in -reach..=reach {
            for du in -reach..=reach {
                let (a, b) = (u + du, v + dv);
                if a < 0 || b < 0 || a >= width || b >= height {
                    continue;
                }
                let q = (b * width + a) as usize;
                let far = (du.abs().max(dv.abs()) + 1) as f32 * slope;
                if !inverse[q].is_finite() || (inverse[q] / inverse[p] - 1.0).abs() > far {
                    continue;
                }
                let weight = f64::from((depth.error[p] / depth.error[q]).clamp(0.1, 3.0));
                let f = [1.0, du as f64, dv as f64];
                for r in 0..3 {
                    for c in 0..3 {
                        m[r][c] += weight * f[r] * f[c];
                    }
                    m[r][3] += weight * f[r] * f64::from(inverse[q]);
                }
                count += 1.0;
            }
        }
        if count < FEWEST {
            return own;
        }
        let Some([at, du, dv]) = solve(m) else {
            return own;
        };
        if at <= 0.0 {
            return own;
        }
        let range = 1.0 / (at as f32 * rays[p].1);
        let off = (
            f64::from(i.cx) - (u as f64 + 0.5),
            f64::from(i.cy) - (v as f64 + 0.5),
        );
        // The plane n·x = 1 in the camera's frame.
        let n = [
            (du * f64::from(i.fx)) as f32,
            (dv * f64::from(i.fy)) as f32,
            (at + du * off.0 + dv * off.1) as f32,
        ];
        let n = camera.right * n[0] + camera.down * n[1] + camera.forward * n[2];
        let n = -n.normalized();
        let error = depth.error[p] / libm::sqrtf(count as f32 / 4.0).max(1.0);
        (range, error, if n.is_finite() { n } else { Vec3::ZERO })
    };
    let found: Vec<(f32, f32, Vec3)> = (0..measured.pixels()).into_par_iter().map(of).collect();
    Depth {
        range: found.iter().map(|f| f.0).collect(),
        error: found.iter().map(|f| f.1).collect(),
        normal: found.iter().map(|f| f.2).collect(),
    }
}

/// Solves the equations by Gauss–Jordan without pivoting, because the matrix is symmetric and
/// positive. Returns `None` if it is singular.
fn solve(mut m: [[f64; 4]; 3]) -> Option<[f64; 3]> {
    for a in 0..3 {
        m[a][a] += 1e-9;
        let pivot = m[a][a];
        if pivot <= 1e-8 {
            return None;
        }
        for value in &mut m[a] {
            *value /= pivot;
        }
        let row = m[a];
        for (c, other) in m.iter_mut().enumerate() {
            if c != a {
                let f = other[a];
                for (value, r) in other.iter_mut().zip(row) {
                    *value -= f * r;
                }
            }
        }
    }
    Some([m[0][3], m[1][3], m[2][3]])
}
