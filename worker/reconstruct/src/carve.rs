//! Carving by light paths. The emptiness of an unseen node is the largest share, over the spots, of
//! lit paths among those through it. A single spot that shines through a position proves it empty.
//! A share tolerates single wrong mask pixels, which ruin space carving with hard decisions.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::{
    ReconstructError,
    field::{Field, Skip},
    paths::Paths,
    progress::{Phase, Progress},
    start::State,
};

/// The step along a path, voxels.
const STEP: f32 = 0.7;
/// The least number of paths for a share.
const FEWEST: u16 = 2;
/// The number of paths below which a share has less weight.
const FEW: u16 = 4;

/// The emptiness of a grid's nodes according to light paths.
#[derive(Debug, Clone)]
pub struct Carved {
    /// The emptiness of each unseen node, in [0, 1]; −1 for nodes without paths, and for visible
    /// nodes.
    pub empty: Vec<f32>,
}

/// Follows the light paths of all spots through the unseen nodes.
///
/// # Errors
/// [`ReconstructError::Stopped`].
pub fn carve(
    field: &Field,
    states: &[State],
    paths: &Paths,
    progress: &dyn Progress,
) -> Result<Carved, ReconstructError> {
    let unseen: Vec<u32> = (0..states.len() as u32)
        .filter(|&i| states[i as usize] == State::Unseen)
        .collect();
    let mut slot = vec![u32::MAX; states.len()];
    for (k, &i) in unseen.iter().enumerate() {
        slot[i as usize] = k as u32;
    }
    let skip = Skip::to_nodes(field, |i| states[i] == State::Unseen);
    let one = |spot: usize| -> Option<Vec<(u16, u16)>> {
        progress
            .at(Phase::Carve, spot as f32 / paths.spots() as f32, None)
            .then(|| count(field, (&skip, &slot, unseen.len()), paths, spot))
    };
    let mut best = vec![-1.0f32; unseen.len()];
    // Processing a limited number of spots at a time bounds the memory; a maximum does not depend
    // on the order.
    let wave = rayon::current_num_threads().max(1);
    let spots: Vec<usize> = (0..paths.spots()).collect();
    for some in spots.chunks(wave) {
        let counts: Option<Vec<_>> = some.par_iter().map(|&s| one(s)).collect();
        for counts in counts.ok_or(ReconstructError::Stopped)? {
            best.par_iter_mut()
                .zip(counts)
                .for_each(|(best, (lit, all))| {
                    if all >= FEWEST {
                        let trust = if all < FEW { 0.8 } else { 1.0 };
                        *best = best.max(trust * f32::from(lit) / f32::from(all));
                    }
                });
        }
    }
    let mut empty = vec![-1.0f32; states.len()];
    for (&i, b) in unseen.iter().zip(best) {
        empty[i as usize] = b;
    }
    Ok(Carved { empty })
}

/// Counts lit paths and all paths of one spot through each unseen node.
fn count(
    field: &Field,
    (skip, slot, unseen): (&Skip, &[u32], usize),
    paths: &Paths,
    spot: usize,
) -> Vec<(u16, u16)> {
    let mut counts = vec![(0u16, 0u16); unseen];
    let [_, y, z] = field.strides();
    for pixel in 0..paths.pixels() {
        let Some(path) = paths.get(spot, pixel) else {
            continue;
        };
        let ray: (Vec3, Vec3) = (path.origin, path.direction);
        let step = (STEP * field.spacing, 0.0);
        field.march(skip, ray, path.span, step, |_, cell, f| {
            let [a, b, c] = f.map(|x| usize::from(x >= 0.5));
            let at = slot[cell + a + b * y + c * z];
            if at != u32::MAX {
                let (lit, all) = &mut counts[at as usize];
                *all = all.saturating_add(1);
                *lit = lit.saturating_add(u16::from(path.lit)).min(*all);
            }
            true
        });
    }
    counts
}
