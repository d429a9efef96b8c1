//! One ray: its loss, and the derivative of the loss with respect to the logit of every node that
//! it passes.

use crate::{
    field::{Field, PEAK, Skip, sigmoid},
    rays::{Ray, Wanted},
};
use picofarm_scene::Vec3;

/// The number of steps a voxel.
const STEPS: f32 = 2.0;
/// A constant that limits the loss of a stopped ray if no matter stops it.
const FLOOR: f32 = 0.02;
/// The optical depth beyond which the loss of a free ray saturates.
const SATURATES: f32 = 10.0;
/// Derivatives below this are omitted.
const LEAST: f32 = 1e-6;

/// Scratch memory: the positions along a ray.
#[derive(Debug, Default)]
pub struct Cast {
    places: Vec<(usize, [f32; 3], f32)>,
    slope: f32,
}

impl Cast {
    /// Marches along a ray, and returns its loss.
    #[inline]
    pub(crate) fn march(&mut self, field: &Field, skip: &Skip, ray: &Ray, offset: f32) -> f64 {
        self.places.clear();
        let step = field.spacing / STEPS;
        let mut sum = 0.0f32;
        let places = &mut self.places;
        field.march(
            skip,
            (ray.origin, ray.direction),
            ray.span,
            (step, offset),
            |_, cell, f| {
                let s = sigmoid(field.interpolate(cell, f));
                sum += s * (PEAK / STEPS);
                places.push((cell, f, s));
                true
            },
        );
        let (loss, slope) = loss(ray.wanted, sum);
        self.slope = slope * (PEAK / STEPS);
        f64::from(loss)
    }

    /// Passes on the derivative of the loss with respect to the logit of each node, in parts.
    #[inline]
    pub(crate) fn spread(&self, field: &Field, mut tell: impl FnMut(usize, f32)) {
        let [_, y, z] = field.strides();
        if self.slope.abs() < LEAST {
            return;
        }
        for &(cell, [x1, y1, z1], s) in &self.places {
            let g = self.slope * s * (1.0 - s);
            if g.abs() < LEAST {
                continue;
            }
            let (x0, y0, z0) = (1.0 - x1, 1.0 - y1, 1.0 - z1);
            for (node, w) in [
                (cell, y0 * z0),
                (cell + y, y1 * z0),
                (cell + z, y0 * z1),
                (cell + y + z, y1 * z1),
            ] {
                tell(node, g * w * x0);
                tell(node + 1, g * w * x1);
            }
        }
    }
}

/// Returns the loss of a ray for its optical depth, and the derivative.
#[inline(always)]
fn loss(wanted: Wanted, depth: f32) -> (f32, f32) {
    match wanted {
        Wanted::Free => {
            let x = 1.0 + depth / SATURATES;
            (SATURATES * libm::logf(x), 1.0 / x)
        }
        Wanted::Stopped => {
            let through = libm::expf(-depth);
            let stopped = 1.0 - through + FLOOR;
            (-libm::logf(stopped), -through / stopped)
        }
    }
}

/// Returns the loss of the path from `a` to `b` through a field, and its derivative with respect to
/// every logit, as in the optimisation, for one ray. If `free`, all light should pass; otherwise
/// none should.
pub fn cast_ray(field: &Field, a: Vec3, b: Vec3, free: bool) -> (f64, Vec<f64>) {
    let skip = Skip::to_nodes(field, |_| true);
    let length = (b - a).length();
    let ray = Ray {
        origin: a,
        direction: (b - a) / length,
        span: (0.0, length),
        wanted: if free { Wanted::Free } else { Wanted::Stopped },
    };
    let mut cast = Cast::default();
    let mut slopes = vec![0.0f64; field.logit.len()];
    let loss = cast.march(field, &skip, &ray, 0.0);
    cast.spread(field, |node, g| slopes[node] += f64::from(g));
    (loss, slopes)
}
