//! What the model of shadows is learnt from. The example `learn` uses it; demultiplexing does not.

use rayon::prelude::*;

use crate::{Capture, DemultiplexError, Settings, demultiplex::take_apart};
pub use crate::{
    forest::{Forest, LEVELS, Tree, UNIT},
    learned::FEATURES,
};

/// Features of chosen pairs: `[feature][pair]`. Pairs are (index of the spot, pixel).
///
/// With `depth_m` they are those of [`crate::shadows_at`], otherwise of [`crate::demultiplex`].
/// With a first forest, what it says around each pair is added.
///
/// # Errors
/// [`DemultiplexError`] names the argument that cannot be used.
pub fn features(
    capture: &Capture,
    settings: &Settings,
    depth_m: Option<&[f32]>,
    first: Option<&Forest>,
    pairs: &[(usize, usize)],
) -> Result<Vec<Vec<f32>>, DemultiplexError> {
    let mut out = Vec::new();
    take_apart(capture, settings, depth_m, None, &mut |scene| {
        let odds = first.map(|f| scene.judged(std::slice::from_ref(f), false).0);
        let parts: Vec<Vec<Vec<f32>>> = (0..scene.sources.len())
            .into_par_iter()
            .map(|i| {
                let mut all = scene.features(i);
                if let Some(odds) = &odds {
                    all.extend(scene.around(i, odds));
                }
                let beam = scene.sources[i].beam;
                let own: Vec<usize> = pairs
                    .iter()
                    .filter(|(spot, _)| *spot == beam)
                    .map(|(_, p)| *p)
                    .collect();
                all.iter()
                    .map(|values| own.iter().map(|p| values[*p]).collect())
                    .collect()
            })
            .collect();
        let count = parts.first().map_or(0, Vec::len);
        out = (0..count)
            .map(|f| {
                parts
                    .iter()
                    .flat_map(|part| part[f].iter().copied())
                    .collect()
            })
            .collect();
    })?;
    Ok(out)
}
