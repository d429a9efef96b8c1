//! Whether masks belong to the spots of the captures: light that comes at a spot's own time is
//! compared inside and outside of each mask.

use crate::{assign::assign, fit::Observed, model::Model};

/// Gain in the sum of contrasts from which on another order counts.
const BETTER: f64 = 0.35;

/// The order of masks.
pub(crate) struct MaskOrder {
    /// The mask of each capture's spot.
    pub order: Vec<usize>,
    /// Mean contrast in this order, and as stated.
    pub contrast: f64,
    pub stated: f64,
}

/// Contrast of capture `k` with mask `j`: the share of pixels with light at the spot's time inside
/// of the mask minus the share outside.
pub(crate) fn order(
    model: &Model,
    seen: &Observed,
    ranges: &[f64],
    masks: &[u8],
    cells: usize,
    stored: &[usize],
) -> MaskOrder {
    let spots = model.beams.len();
    let light: Vec<Vec<bool>> = (0..spots)
        .map(|k| {
            let off = seen.residuals(model, ranges, k);
            let near = |e: &Option<f64>| e.is_some_and(|e| e.abs() < model.width);
            off.iter().map(near).collect()
        })
        .collect();
    let contrast = |k: usize, j: usize| {
        let (mut lit, mut all) = ([0.0; 2], [0.0; 2]);
        for (n, p) in stored
            .iter()
            .enumerate()
            .filter(|(n, _)| ranges[*n].is_finite())
        {
            let inside = usize::from(masks[j * cells + p] != 0);
            all[inside] += 1.0;
            lit[inside] += f64::from(u8::from(light[k][n]));
        }
        let share = |i: usize| if all[i] > 0.0 { lit[i] / all[i] } else { 0.0 };
        share(1) - share(0)
    };
    let table: Vec<Vec<f64>> = (0..spots)
        .map(|k| (0..spots).map(|j| contrast(k, j)).collect())
        .collect();
    let costs: Vec<Vec<f64>> = table
        .iter()
        .map(|row| row.iter().map(|c| -c).collect())
        .collect();
    let mean = |order: &[usize]| {
        let sum: f64 = order.iter().enumerate().map(|(k, j)| table[k][*j]).sum();
        sum / spots as f64
    };
    let stated: Vec<usize> = (0..spots).collect();
    let mut order = assign(&costs);
    if mean(&order) < mean(&stated) + BETTER / spots as f64 {
        order.clone_from(&stated);
    }
    MaskOrder {
        contrast: mean(&order),
        stated: mean(&stated),
        order,
    }
}
