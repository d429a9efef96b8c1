//! Depth in closed form: a two-bounce time defines an ellipsoid for the surface point, with the
//! spot and the camera as foci, and a pixel's ray intersects it once (Henley et al. 2022,
//! bounce-flash lidar). Several spots are combined by weighted least squares; neighbouring pixels
//! by a plane in inverse depth.

mod smooth;

use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::{
    Measured, MeasuredSpot,
    agreement::{self, Times},
};

pub use smooth::smooth;

/// The number of rounds that refine the spots' distances.
const ROUNDS: usize = 4;
/// The number of Newton steps in the least squares of a pixel.
const STEPS: usize = 4;
/// The least sensitivity of a time to depth. A less sensitive time (with surface point and camera
/// on opposite sides of the spot) contains no information about depth.
const LEAST_SENSITIVITY: f32 = 0.1;
/// The lower bound of the residuals' scale for exact times, metres.
const FINEST: f32 = 1e-3;

/// The surface that every pixel sees.
#[derive(Debug, Clone)]
pub struct Depth {
    /// The distance along the ray, metres; NaN if no time is known. `[row][column]`.
    pub range: Vec<f32>,
    /// The standard error of the distance from the residuals of the spots' times, metres; NaN if no
    /// time is known.
    pub error: Vec<f32>,
    /// The unit normal in world axes, facing the camera; zero if unknown.
    pub normal: Vec<Vec3>,
}

/// Computes the depth of every pixel, and the agreement of the times before spots are refined. The
/// distances of spots that are straight along their beams are refined, because each is only known
/// to half a bin.
pub fn closed_form(measured: &mut Measured) -> (Depth, Times) {
    let mut range = fit(measured, &medians(measured)).0;
    let times = agreement::times(measured, &range);
    refine_spots(measured, &range);
    for _ in 1..ROUNDS {
        range = fit(measured, &range).0;
        refine_spots(measured, &range);
    }
    let (range, error) = fit(measured, &range);
    let depth = Depth {
        normal: vec![Vec3::ZERO; range.len()],
        range,
        error,
    };
    (depth, times)
}

/// Returns a spot relative to the camera, which is one focus.
fn seen(measured: &Measured, spot: &MeasuredSpot) -> Vec3 {
    spot.point - measured.camera.origin
}

/// Returns the distance along the unit ray `r` at which |x| + |x − l| = s; it is not positive if
/// there is none.
pub(crate) fn on_ellipsoid(s: f32, l: Vec3, r: Vec3) -> f32 {
    (s * s - l.dot(l)) / (2.0 * (s - r.dot(l)))
}

/// Returns the derivative of a time with respect to depth: 1 + cos of the angle between the ray and
/// the direction from spot to point. In [0, 2].
fn sensitivity(to_point: Vec3, r: Vec3) -> f32 {
    1.0 + to_point.dot(r) / to_point.length().max(1e-3)
}

/// Returns each pixel's weighted median over its lit spots.
fn medians(measured: &Measured) -> Vec<f32> {
    let pixels = measured.pixels();
    let foci: Vec<Vec3> = measured.spots.iter().map(|s| seen(measured, s)).collect();
    let of = |p: usize| {
        let r = measured.ray(p);
        let mut found: Vec<(f32, f32)> = Vec::with_capacity(foci.len());
        for (i, &l) in foci.iter().enumerate() {
            let q = i * pixels + p;
            if measured.lit[q] == 0 || measured.used[q] == 0 {
                continue;
            }
            let d = on_ellipsoid(measured.tau[q] - measured.spots[i].path_m, l, r);
            let s = sensitivity(r * d - l, r);
            if d.is_finite() && d > 0.0 && s > LEAST_SENSITIVITY {
                found.push((d, s * s));
            }
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        let half = 0.5 * found.iter().map(|f| f.1).sum::<f32>();
        let mut sum = 0.0;
        let past = |f: &&(f32, f32)| {
            sum += f.1;
            sum >= half
        };
        found.iter().find(past).map_or(f32::NAN, |f| f.0)
    };
    (0..pixels).into_par_iter().map(of).collect()
}

/// Fits each pixel by weighted least squares over its lit spots, starting from a guess. Returns
/// depth and its standard error. Residuals within half a bin have little influence, because a time
/// is anywhere in its bin; large residuals have almost none.
fn fit(measured: &Measured, guess: &[f32]) -> (Vec<f32>, Vec<f32>) {
    let pixels = measured.pixels();
    let dead = (0.5 * measured.bin_width_m).max(FINEST);
    let foci: Vec<Vec3> = measured.spots.iter().map(|s| seen(measured, s)).collect();
    let of = |p: usize| -> (f32, f32) {
        let (r, mut x) = (measured.ray(p), guess[p]);
        if !x.is_finite() {
            return (f32::NAN, f32::NAN);
        }
        let mut error = dead;
        for _ in 0..STEPS {
            let (mut a, mut b, mut square) = (1e-9f32, 0.0f32, 0.0f32);
            for (i, &l) in foci.iter().enumerate() {
                let q = i * pixels + p;
                if measured.lit[q] == 0 || measured.used[q] == 0 {
                    continue;
                }
                let way = r * x - l;
                let g = sensitivity(way, r);
                let miss = x + way.length() + measured.spots[i].path_m - measured.tau[q];
                let far = miss.abs();
                let weight = match far {
                    _ if far > 3.0 * dead => 0.3 * dead / far,
                    _ if far > dead => 1.0,
                    _ => 0.25,
                };
                a += weight * g * g;
                b += weight * g * miss;
                square += weight * miss * miss;
            }
            x -= (b / a).clamp(-0.5, 0.5);
            error = libm::sqrtf((square + 0.25 * dead * dead) / a);
        }
        match x > 0.0 {
            true => (x, error),
            false => (f32::NAN, f32::NAN),
        }
    };
    (0..pixels).into_par_iter().map(of).unzip()
}

/// Moves each straight spot along its beam to the position that best fits the depths of all pixels.
fn refine_spots(measured: &mut Measured, range: &[f32]) {
    let pixels = measured.pixels();
    let this = &*measured;
    let limit = this.bin_width_m.max(10.0 * FINEST);
    let step = |(i, spot): (usize, &MeasuredSpot)| -> f32 {
        if spot.folded {
            return 0.0;
        }
        let l = seen(this, spot);
        let (mut a, mut b) = (1e-9f64, 0.0f64);
        for (p, &depth) in range.iter().enumerate() {
            let q = i * pixels + p;
            if this.lit[q] == 0 || this.used[q] == 0 || !depth.is_finite() {
                continue;
            }
            let way = this.ray(p) * depth - l;
            let length = way.length();
            let g = 1.0 - way.dot(spot.direction) / length;
            let miss = depth + length + spot.path_m - this.tau[q];
            // Pixels near the spot are sensitive to its lateral position, and outliers are
            // unreliable.
            if length < 0.2 || miss.abs() > limit {
                continue;
            }
            a += f64::from(g * g);
            b += f64::from(g * miss);
        }
        -((b / a) as f32).clamp(-limit, limit)
    };
    let steps: Vec<f32> = this.spots.par_iter().enumerate().map(step).collect();
    for (spot, step) in measured.spots.iter_mut().zip(steps) {
        spot.path_m += step;
        spot.point += spot.direction * step;
    }
}
