//! The rays for the optimisation: those that pass at least one node that may change, by class.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::{
    Depth, Measured, ReconstructError,
    field::{Field, Skip},
    paths::Paths,
    progress::{Phase, Progress},
};

/// The greatest number of light paths that are examined; if there are more, every n-th is.
const MOST: usize = 2_200_000;
/// The greatest number of held-out rays of a class. At most one ray in `HELD_OUT_EVERY` is held
/// out.
const HELD_OUT: usize = 4096;
const HELD_OUT_EVERY: usize = 20;
/// The step of the examination, voxels.
const STEP: f32 = 0.7;

/// The measured fate of the light along a ray.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Wanted {
    /// All of it passes.
    Free,
    /// None of it passes.
    Stopped,
}

/// A part of a ray.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ray {
    pub origin: Vec3,
    pub direction: Vec3,
    pub span: (f32, f32),
    pub wanted: Wanted,
}

/// Candidates by class: lit light paths, shadowed ones, and camera rays.
pub(crate) struct Rays<'a> {
    paths: Paths<'a>,
    camera: Vec3,
    directions: Vec<Vec3>,
    ranges: &'a [f32],
    spacing: f32,
    /// Class → candidates, each a number for [`Rays::get`].
    pub classes: [Vec<u32>; 3],
    /// Class → candidates that are never used for learning. Their loss shows whether learning still
    /// improves the field.
    pub held_out: [Vec<u32>; 3],
}

impl<'a> Rays<'a> {
    /// Selects rays of a measurement.
    pub fn choose(
        (measured, depth): (&'a Measured, &'a Depth),
        (field, trainable): (&Field, &Skip),
        progress: &dyn Progress,
    ) -> Result<Self, ReconstructError> {
        let paths = Paths::new(measured, depth);
        let (k, pixels) = (paths.spots(), paths.pixels());
        let mut rays = Self {
            paths,
            camera: measured.camera.origin,
            directions: (0..pixels).map(|p| measured.ray(p)).collect(),
            ranges: &depth.range,
            spacing: field.spacing,
            classes: Default::default(),
            held_out: Default::default(),
        };
        let stride = (k * pixels).div_ceil(MOST).max(1);
        let meets = |ray: &Ray| {
            let mut met = false;
            let step = (STEP * field.spacing, 0.0);
            field.march(
                trainable,
                (ray.origin, ray.direction),
                ray.span,
                step,
                |_, _, _| {
                    met = true;
                    false
                },
            );
            met
        };
        for spot in 0..k + 2 {
            if !progress.at(Phase::Rays, spot as f32 / (k + 2) as f32, None) {
                return Err(ReconstructError::Stopped);
            }
            let every = if spot < k { stride } else { 1 };
            // Spots start at different pixels, so that together they cover the image.
            let of = (spot * pixels + spot % every..(spot + 1) * pixels).step_by(every);
            let found: Vec<(usize, u32)> = of
                .collect::<Vec<_>>()
                .into_par_iter()
                .filter_map(|q| {
                    let ray = rays.get(q as u32)?;
                    let class = match ray.wanted {
                        _ if spot >= k => 2,
                        Wanted::Free => 0,
                        Wanted::Stopped => 1,
                    };
                    meets(&ray).then_some((class, q as u32))
                })
                .collect();
            for (class, q) in found {
                rays.classes[class].push(q);
            }
        }
        for (class, held_out) in rays.classes.iter_mut().zip(&mut rays.held_out) {
            let every = class.len().div_ceil(HELD_OUT).max(HELD_OUT_EVERY);
            let mut n = 0;
            class.retain(|q| {
                n += 1;
                let learnt = n % every != 0;
                if !learnt {
                    held_out.push(*q);
                }
                learnt
            });
        }
        Ok(rays)
    }

    /// Returns ray number `spot · pixels + pixel`; spot K is the camera ray in front of the
    /// surface, K + 1 the one through it.
    #[inline]
    pub fn get(&self, number: u32) -> Option<Ray> {
        let (pixels, k) = (self.directions.len(), self.paths.spots());
        let (spot, pixel) = (number as usize / pixels, number as usize % pixels);
        if spot < k {
            let path = self.paths.get(spot, pixel)?;
            return Some(Ray {
                origin: path.origin,
                direction: path.direction,
                span: path.span,
                wanted: if path.lit {
                    Wanted::Free
                } else {
                    Wanted::Stopped
                },
            });
        }
        let (range, h) = (self.ranges[pixel], self.spacing);
        let (span, wanted) = match spot == k {
            true => ((0.1, range - h), Wanted::Free),
            false => ((range - h, range + 2.0 * h), Wanted::Stopped),
        };
        (range.is_finite() && span.0 < span.1).then_some(Ray {
            origin: self.camera,
            direction: self.directions[pixel],
            span,
            wanted,
        })
    }
}
