//! The surfaces that the centres of the pixels see.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::{
    api::{RenderError, Stop},
    scene::{hit::Hit, world::World},
};

/// The surfaces seen by the pixels' centres.
#[derive(Debug)]
pub(crate) struct Centres {
    /// First surfaces, row-major.
    pub hits: Vec<Option<Hit>>,
    /// Rays traced.
    pub rays: u64,
}

/// Traces the rays through the centres.
pub(crate) fn centres(world: &World, stop: Stop) -> Result<Centres, RenderError> {
    let i = world.camera.intrinsics;
    let rows: Vec<(Vec<Option<Hit>>, u64)> = (0..i.height)
        .into_par_iter()
        .map(|row| {
            if stop.asked() {
                return (vec![], 0);
            }
            let mut stack = world.bvh.stack();
            let hits = (0..i.width)
                .map(|col| {
                    let d = world.camera.ray(col as f32 + 0.5, row as f32 + 0.5);
                    world.closest(&mut stack, Vec3::ZERO, d)
                })
                .collect();
            (hits, stack.rays)
        })
        .collect();
    stop.check()?;
    let rays = rows.iter().map(|r| r.1).sum();
    Ok(Centres {
        hits: rows.into_iter().flat_map(|r| r.0).collect(),
        rays,
    })
}
