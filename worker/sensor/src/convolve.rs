//! Direct convolution of one pixel's histogram. All terms are positive, so a bin of 0.1 photons
//! next to one of 4·10⁷ is as exact as any other, which a Fourier transform would not achieve.

use pulp::{Arch, Simd, WithSimd};

use crate::kernel::Kernel;

/// A kernel prepared for histograms of one length, with its work buffers.
#[derive(Debug, Clone)]
pub(crate) struct Convolver {
    bins: usize,
    /// The taps in reverse order.
    reversed: Vec<f64>,
    /// Bins before the histogram's own in `padded`. If negative, the number of bins of the
    /// histogram that are left out.
    lead: i64,
    padded: Vec<f64>,
    /// Σ of the first n taps.
    before: Vec<f64>,
    /// Σ of the taps from n on.
    after: Vec<f64>,
    first: i64,
}

impl Convolver {
    pub fn new(kernel: &Kernel, bins: usize) -> Self {
        let taps = kernel.taps.len();
        let sums = |taps: &mut dyn Iterator<Item = &f64>| {
            let mut sums = vec![0.0];
            for t in taps {
                sums.push(sums[sums.len() - 1] + t);
            }
            sums
        };
        let mut after = sums(&mut kernel.taps.iter().rev());
        after.reverse();
        Self {
            bins,
            reversed: kernel.taps.iter().rev().copied().collect(),
            lead: taps as i64 - 1 + kernel.first,
            padded: vec![0.0; bins + taps - 1],
            before: sums(&mut kernel.taps.iter()),
            after,
            first: kernel.first,
        }
    }

    /// Computes out = h ⊛ kernel inside the gate and returns the energy outside it. `h` and `out`
    /// have one value per bin.
    pub fn run(&mut self, h: &[f32], out: &mut [f64]) -> f64 {
        debug_assert!(h.len() == self.bins && out.len() == self.bins);
        out.fill(0.0);
        let Some(start) = h.iter().position(|h| *h != 0.0) else {
            return 0.0;
        };
        let end = h.iter().rposition(|h| *h != 0.0).map_or(0, |i| i + 1);
        self.padded.fill(0.0);
        // Bin b is at b + lead, if the buffer includes it.
        let skipped = (start as i64 + self.lead).min(0).unsigned_abs() as usize;
        let at = (start as i64 + self.lead).max(0) as usize;
        let seen = h[start..end].iter().skip(skipped);
        for (padded, h) in self.padded.iter_mut().skip(at).zip(seen) {
            *padded = f64::from(*h);
        }
        // Only the bins that light can reach.
        let reach = |b: i64| b.clamp(0, self.bins as i64) as usize;
        let from = reach(start as i64 + self.first);
        let to = reach(end as i64 + self.first + self.reversed.len() as i64 - 1);
        if from < to {
            Arch::new().dispatch(Sums {
                taps: &self.reversed,
                x: &self.padded[from..],
                out: &mut out[from..to],
            });
        }
        self.outside(&h[start..end], start)
    }

    /// Returns the energy of the bins from `start` on that the kernel moves outside the gate.
    fn outside(&self, h: &[f32], start: usize) -> f64 {
        let taps = self.reversed.len() as i64;
        let share = |i: usize| {
            let target = (start + i) as i64 + self.first;
            let below = (-target).clamp(0, taps) as usize;
            let above = (self.bins as i64 - target).clamp(0, taps) as usize;
            f64::from(h[i]) * (self.before[below] + self.after[above])
        };
        // All energy of the bins between these two stays inside the gate.
        let index = |bin: i64| (bin - start as i64).clamp(0, h.len() as i64) as usize;
        let early = index(-self.first);
        let late = index(self.bins as i64 - self.first - taps + 1).max(early);
        (0..early).chain(late..h.len()).map(share).sum()
    }
}

/// The number of independent sums: four registers of four.
const BLOCK: usize = 16;

/// Computes out[i] = Σ_j taps[j]·x[i + j], summed in the order of j. It uses the machine's widest
/// registers, with the same bits as without them, because products and sums are not fused.
struct Sums<'a> {
    taps: &'a [f64],
    x: &'a [f64],
    out: &'a mut [f64],
}

impl WithSimd for Sums<'_> {
    type Output = ();

    // Inlined into a function that can use these registers; a closure would not be.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { taps, x, out } = self;
        let (blocks, rest) = out.as_chunks_mut::<BLOCK>();
        let done = blocks.len() * BLOCK;
        for (i, block) in blocks.iter_mut().enumerate() {
            let x = &x[i * BLOCK..][..taps.len() + BLOCK - 1];
            let mut sums = [0.0; BLOCK];
            for (j, t) in taps.iter().enumerate() {
                if let Some(x) = x[j..].first_chunk::<BLOCK>() {
                    for (sum, x) in sums.iter_mut().zip(x) {
                        *sum += t * x;
                    }
                }
            }
            *block = sums;
        }
        for (i, out) in rest.iter_mut().enumerate() {
            let x = &x[done + i..][..taps.len()];
            *out = taps.iter().zip(x).fold(0.0, |sum, (t, x)| sum + t * x);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_share_lands_inside_or_is_counted_outside() {
        let h = [1.0f32, 0.0, 4.0, 0.5, 8.0];
        for (first, n) in [(0, 1), (-2, 3), (-1, 7), (3, 4), (-9, 4), (40, 2), (-1, 9)] {
            let taps: Vec<f64> = (0..n)
                .map(|i| f64::from(i + 1) / f64::from(n * (n + 1) / 2))
                .collect();
            let kernel = Kernel { first, taps };
            let mut out = [0.0; 5];
            let outside = Convolver::new(&kernel, 5).run(&h, &mut out);
            let (mut expected, mut lost) = ([0.0f64; 5], 0.0);
            for (b, h) in h.iter().enumerate() {
                for (j, t) in kernel.taps.iter().enumerate() {
                    let at = b as i64 + first + j as i64;
                    match usize::try_from(at).ok().and_then(|at| expected.get_mut(at)) {
                        Some(e) => *e += t * f64::from(*h),
                        None => lost += t * f64::from(*h),
                    }
                }
            }
            assert!((outside - lost).abs() < 1e-12, "{first} {n}");
            for (a, b) in out.iter().zip(expected) {
                assert!((a - b).abs() < 1e-12, "{first} {n}: {out:?}");
            }
        }
    }
}
