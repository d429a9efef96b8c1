//! Volume rendering of a density field: transmittance T = exp(−∫σ) along a ray, and depth as the
//! distance at which T has decreased to one half. This is the median of the distances at which
//! light is stopped; PlatoNeRF takes the mean, which blurs edges.

use picofarm_scene::{Camera, Vec3};
use rayon::prelude::*;

use crate::field::{EMPTY, Field, PEAK, Skip, sigmoid};

/// The number of steps a voxel.
const STEPS: f32 = 4.0;
/// The distance of the start of rays from their origin, metres.
const NEAR_M: f32 = 0.02;
/// Nodes with logits up to this are empty.
const BARELY: f32 = EMPTY + 0.1;

/// The end of a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stopped {
    /// The distance along the unit direction, metres. If the ray hits nothing, the distance at
    /// which the search ended.
    pub or_end_m: f32,
    /// Whether the ray hits matter.
    pub met: bool,
}

/// The distances of novel views for any representation of the field: a grid ([`Renderer`]) or a
/// network.
pub trait Distances: Sync {
    /// Returns the ends of rays from one position along unit directions, in their order.
    fn distances(&self, origin: Vec3, directions: &[Vec3]) -> Vec<Stopped>;
}

impl Distances for Renderer<'_> {
    fn distances(&self, origin: Vec3, directions: &[Vec3]) -> Vec<Stopped> {
        let of = |d: &Vec3| {
            let depth = self.depth(origin, *d);
            Stopped {
                or_end_m: depth.unwrap_or_else(|| self.end(origin, *d)),
                met: depth.is_some(),
            }
        };
        directions.iter().map(of).collect()
    }
}

/// A field prepared for rendering.
#[derive(Debug, Clone)]
pub struct Renderer<'a> {
    field: &'a Field,
    skip: Skip,
}

impl<'a> Renderer<'a> {
    /// Prepares a field.
    pub fn new(field: &'a Field) -> Self {
        let skip = Skip::to_nodes(field, |i| field.logit[i] > BARELY);
        Self { field, skip }
    }

    /// Returns the distance along a unit direction at which half the light is stopped, metres, or
    /// `None` if the ray leaves the grid first.
    pub fn depth(&self, origin: Vec3, direction: Vec3) -> Option<f32> {
        let field = self.field;
        let step = field.spacing / STEPS;
        let half = std::f32::consts::LN_2;
        let (mut sum, mut found) = (0.0f32, None);
        let ray = (origin, direction);
        field.march(
            &self.skip,
            ray,
            (NEAR_M, f32::INFINITY),
            (step, 0.0),
            |t, cell, f| {
                let part = PEAK / STEPS * sigmoid(field.interpolate(cell, f));
                if sum + part >= half {
                    found = Some(t + step * ((half - sum) / part - 0.5));
                    return false;
                }
                sum += part;
                true
            },
        );
        found
    }

    /// Like [`Self::depth`], but returns the distance to the end of the grid if nothing was hit,
    /// because the grid bounds the observed space.
    pub fn depth_or_end(&self, origin: Vec3, direction: Vec3) -> f32 {
        self.depth(origin, direction)
            .unwrap_or_else(|| self.end(origin, direction))
    }

    /// Returns the distance at which a ray leaves the grid.
    fn end(&self, origin: Vec3, direction: Vec3) -> f32 {
        let (near, far) = self.field.span(origin, direction);
        if far > near { far.max(0.0) } else { 0.0 }
    }

    /// Returns the share of light that passes from `a` to `b`, in [0, 1].
    pub fn transmittance(&self, a: Vec3, b: Vec3) -> f32 {
        let field = self.field;
        let length = (b - a).length();
        if length <= 0.0 {
            return 1.0;
        }
        let count = (length * STEPS / field.spacing).ceil().max(1.0);
        let (step, mut sum) = (length / count, 0.0f32);
        let ray = (a, (b - a) / length);
        field.march(&self.skip, ray, (0.0, length), (step, 0.0), |_, cell, f| {
            sum += PEAK / field.spacing * step * sigmoid(field.interpolate(cell, f));
            true
        });
        libm::expf(-sum)
    }

    /// Returns the distances along the rays through the pixels' middles, metres, row-major; `None`
    /// if a ray hits nothing.
    pub fn view(&self, camera: &Camera) -> Vec<Option<f32>> {
        let width = camera.intrinsics.width as usize;
        let pixels = width * camera.intrinsics.height as usize;
        let of = |p: usize| {
            let (x, y) = ((p % width) as f32 + 0.5, (p / width) as f32 + 0.5);
            self.depth(camera.origin, camera.ray(x, y).normalized())
        };
        (0..pixels).into_par_iter().map(of).collect()
    }
}
