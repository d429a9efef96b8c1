//! Pools variances over neighbouring bins and pixels.

use crate::render::region::Region;

/// The number of bins on either side over which the variance of the 3+ part and of the two-bounce
/// part is pooled.
pub(crate) const MULTI_REACH: usize = 3;
pub(crate) const TWO_REACH: usize = 1;

/// Fraction of a pixel's mean variance added to every bin.
pub(crate) const FLOOR: f32 = 0.003;

/// Weight of a bin's own sample variance, because edges and peaks differ from their neighbours.
/// Without it the brightest bins deviate by 1.25 to 1.4 of the stored error.
pub(crate) const OWN: f32 = 0.5;

/// Pools variances in place, half of each, over 3×3 pixels and a few bins, within a region's
/// `[row][col][slot]`.
///
/// The sample variance of a bin that few paths reach is mostly chance, and often nearly zero. Its
/// neighbours have nearly the same true variance, so their mean is a better estimate. The floor
/// accounts for paths that might have arrived and did not. Over many seeds the rms of (h − mean) /
/// error is then 1 within a few percent, whereas with single sample variances it is arbitrary.
pub(crate) fn pool(
    variance: &mut [f32],
    region: &Region,
    slots: usize,
    reach: usize,
    rows: &mut Pool,
) {
    let (height, width) = (region.rows as usize, region.cols as usize);
    let size = width * slots;
    let Pool { bins, smooth } = rows;
    bins.resize(size, 0.0);
    for row in smooth.iter_mut() {
        row.resize(size, 0.0);
    }
    // Pixel rows are processed in turn and three are buffered, because a large region would not
    // stay in the cache.
    let mut done = 0;
    for row in 0..height {
        while done < height && done <= row + 1 {
            let v = &variance[done * size..(done + 1) * size];
            for (out, v) in bins.chunks_mut(slots).zip(v.chunks(slots)) {
                along_bins(out, v, reach);
            }
            let smooth = &mut smooth[done % 3];
            for (col, out) in smooth.chunks_mut(slots).enumerate() {
                let near = col.max(1) - 1..(col + 2).min(width);
                mean(out, near.map(|c| &bins[c * slots..(c + 1) * slots]));
            }
            done += 1;
        }
        let near = row.max(1) - 1..done;
        mean(&mut bins[..], near.map(|r| &smooth[r % 3][..]));
        let own = &mut variance[row * size..(row + 1) * size];
        for (v, pooled) in own.iter_mut().zip(&*bins) {
            *v = pooled + OWN * (*v - pooled);
        }
    }
}

/// Work buffers of [`pool`]: a row of pixels after the mean over bins, and the latest three rows
/// after the mean over columns.
#[derive(Debug, Default)]
pub(crate) struct Pool {
    bins: Vec<f32>,
    smooth: [Vec<f32>; 3],
}

/// Writes the means of a pixel's bins and their neighbours, with the floor.
fn along_bins(out: &mut [f32], v: &[f32], reach: usize) {
    let slots = v.len();
    let floor = FLOOR * v.iter().sum::<f32>() / slots as f32;
    let width = 2 * reach + 1;
    let edge = reach.min(slots);
    for k in (0..edge).chain((slots - edge).max(edge)..slots) {
        let near = &v[k.saturating_sub(reach)..(k + reach + 1).min(slots)];
        out[k] = near.iter().sum::<f32>() / near.len() as f32 + floor;
    }
    // All other bins, with SIMD.
    if slots > 2 * reach {
        let inner = &mut out[reach..slots - reach];
        inner.copy_from_slice(&v[..inner.len()]);
        for j in 1..width {
            for (o, x) in inner.iter_mut().zip(&v[j..]) {
                *o += x;
            }
        }
        for o in inner {
            *o = *o / width as f32 + floor;
        }
    }
}

/// Writes the mean of one to three items.
pub(crate) fn mean<'a>(out: &mut [f32], mut items: impl ExactSizeIterator<Item = &'a [f32]>) {
    let share = 1.0 / items.len() as f32;
    if let Some(first) = items.next() {
        out.copy_from_slice(first);
    }
    for item in items {
        for (o, x) in out.iter_mut().zip(item) {
            *o += x;
        }
    }
    for o in out {
        *o *= share;
    }
}

/// Excludes light outside the gate from the pool: the slots before and after the gate take the
/// value of the adjacent bin.
pub(crate) fn shut_out(variance: &mut [f32], slots: usize) {
    for v in variance.chunks_mut(slots) {
        v[0] = v[1];
        v[slots - 1] = v[slots - 2];
    }
}
