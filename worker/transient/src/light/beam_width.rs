//! Beams with a width: rays that represent a Gaussian beam.
//!
//! The rays of a Gaussian beam are straight lines on hyperboloids around its axis. A ray that
//! leaves the laser at `s` standard deviations from the axis is tilted by `s` standard deviations
//! of the angle, at a right angle to its offset. So at a distance z the ray is √(σ₀² + σ_θ²z²)·s
//! from the axis, which is the width of a Gaussian beam there.
//!
//! Each of a fixed number of rays carries an equal share of the light and ends in a point source of
//! its own. A spot is therefore a small group of point spots, on whatever surfaces the rays hit,
//! and is treated like any other spots (mirrors, glass, subsets). The rays are the same in every
//! render. Details smaller than the distance between two rays are not resolved.

use picofarm_scene::Vec3;

use crate::{api::BeamWidth, numeric::frame::frame};

/// A ray of a beam with a width.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ray {
    /// Its offset from the laser's position where it leaves the laser, metres.
    pub beside_m: Vec3,
    /// Unit direction.
    pub direction: Vec3,
}

/// Returns the ray of a beam along `direction` for a point of the normal distribution.
pub(crate) fn ray(width: &BeamWidth, [a, b]: [f32; 2], direction: Vec3) -> Ray {
    let (u, v) = frame(direction);
    // A diameter to 1/e² is four standard deviations.
    let (beside, tilt) = (
        0.25e-3 * width.diameter_mm as f32,
        0.25e-3 * width.divergence_mrad as f32,
    );
    Ray {
        beside_m: (u * a + v * b) * beside,
        direction: (direction + (v * a - u * b) * tilt).normalized(),
    }
}

/// Returns points of a normal distribution in the plane: a golden-angle spiral at the radii of
/// equal shares, shifted and scaled so that their mean is 0 and the mean square of each coordinate
/// is 1 on average over both.
pub(crate) fn places(count: u32) -> Vec<[f32; 2]> {
    let n = f64::from(count);
    let mut all: Vec<[f64; 2]> = (0..count)
        .map(|k| {
            let k = f64::from(k);
            let r = (-2.0 * libm::log(1.0 - (k + 0.5) / n)).sqrt();
            let angle = 2.399_963_229_728_653 * k;
            [r * libm::cos(angle), r * libm::sin(angle)]
        })
        .collect();
    for axis in 0..2 {
        let mean = all.iter().map(|p| p[axis]).sum::<f64>() / n;
        all.iter_mut().for_each(|p| p[axis] -= mean);
    }
    let square = all.iter().flatten().map(|x| x * x).sum::<f64>() / (2.0 * n);
    let scale = 1.0 / square.sqrt();
    let place = |p: [f64; 2]| p.map(|x| (x * scale) as f32);
    all.into_iter().map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_have_the_moments_of_a_normal_distribution() {
        for count in 4..=64 {
            let all = places(count);
            let n = f64::from(count);
            let mean = |of: &dyn Fn(&[f32; 2]) -> f32| {
                all.iter().map(|p| f64::from(of(p))).sum::<f64>() / n
            };
            assert!(mean(&|p| p[0]).abs() < 1e-6 && mean(&|p| p[1]).abs() < 1e-6);
            let (xx, yy) = (mean(&|p| p[0] * p[0]), mean(&|p| p[1] * p[1]));
            let xy = mean(&|p| p[0] * p[1]);
            assert!((xx + yy - 2.0).abs() < 1e-5, "{count}: {xx} {yy}");
            // With few places, the outermost one has no partner on the other side.
            let round = 2.0 / n.sqrt();
            assert!(
                (xx - yy).abs() < round && xy.abs() < round,
                "{count}: {xx} {yy} {xy}"
            );
        }
    }

    #[test]
    fn rays_are_as_wide_as_a_gaussian_beam_at_every_distance() {
        let width = BeamWidth {
            diameter_mm: 4.0,
            divergence_mrad: 2.0,
            points: 64,
        };
        let axis = Vec3::new(0.6, -0.64, 0.48);
        for z in [0.0f32, 1.0, 2.0, 10.0] {
            let mut square = 0.0;
            for place in places(width.points) {
                let ray = ray(&width, place, axis);
                let along = ray.direction.dot(axis);
                let at = ray.beside_m + ray.direction * (z / along);
                let off = at - axis * at.dot(axis);
                square += f64::from(off.dot(off)) / 64.0;
            }
            // Two coordinates, each with a standard deviation of a quarter of the diameter.
            let diameter = 4.0 * (square / 2.0).sqrt() * 1e3;
            let expected = libm::hypot(4.0, 2.0 * f64::from(z));
            assert!(
                (diameter / expected - 1.0).abs() < 2e-3,
                "{z}: {diameter} {expected}"
            );
        }
    }
}
