//! Volume rendering of a density field: transmittance T = exp(−∫σ) along a ray, and depth as the distance at which T has
//! fallen to one half (the median of where light is stopped; PlatoNeRF takes the mean, which blurs edges).

use picofarm_scene::{Camera, Vec3};
use rayon::prelude::*;

use crate::field::{EMPTY, Field, PEAK, Skip, sigmoid};

/// Steps a voxel.
const STEPS: f32 = 4.0;
/// Rays start this far from their origin, metres.
const NEAR_M: f32 = 0.02;
/// Nodes with logits up to this are empty.
const BARELY: f32 = EMPTY + 0.1;

/// Where a ray is stopped.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stopped {
    /// Distance along the unit direction, metres; where nothing is met, that at which looking ends.
    pub or_end_m: f32,
    /// Whether something is met.
    pub met: bool,
}

/// Distances of novel views, whatever the field is made of: a grid ([`Renderer`]) or a network.
pub trait Distances: Sync {
    /// Where rays from one place along unit directions are stopped, in their order.
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

/// A field ready to be looked at.
#[derive(Debug, Clone)]
pub struct Renderer<'a> {
    field: &'a Field,
    skip: Skip,
}

impl<'a> Renderer<'a> {
    /// Gets a field ready.
    pub fn new(field: &'a Field) -> Self {
        let skip = Skip::to_nodes(field, |i| field.logit[i] > BARELY);
        Self { field, skip }
    }

    /// Distance along a unit direction at which half the light is stopped, metres; `None` where the ray leaves the grid
    /// before.
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

    /// The same, or where the ray leaves the grid: the grid bounds what was observed.
    pub fn depth_or_end(&self, origin: Vec3, direction: Vec3) -> f32 {
        self.depth(origin, direction)
            .unwrap_or_else(|| self.end(origin, direction))
    }

    /// Where a ray leaves the grid.
    fn end(&self, origin: Vec3, direction: Vec3) -> f32 {
        let (near, far) = self.field.span(origin, direction);
        if far > near { far.max(0.0) } else { 0.0 }
    }

    /// Share of light that gets from `a` to `b`, in [0, 1].
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

    /// Distances along the rays through the pixels' middles, metres, row-major; `None` where nothing is met.
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
