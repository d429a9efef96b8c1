//! Peak statistics and the likelihood ratio of bounce-flash lidar (Henley et al., 2022; its
//! `datacubeStats.m`, `computesDepthsAndAlbedos.m` and `twoBounceDetectionProbabilities.m`).
//!
//! Their radiometric constant is that of one laboratory. Here the expected energy of a pair is the
//! pixel's albedo times cos·cos/r², with the albedo from the pixel's own returns. All lengths in
//! bins are those of 8 ps.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use super::{
    Surface,
    returns::{Return, Timing, UNIT_M, brightest},
    shape,
};
use crate::geometry::{Rays, Source};

/// Variance of the Gaussian that smooths a histogram, bins², and half its width, bins.
const VARIANCE: f64 = 51.1;
const REACH: f64 = 50.0;
/// Standard deviations above the background, and photons in a bin, from which a peak is a return.
const SIGMAS: f32 = 5.0;
const FEWEST: f32 = 0.8;
/// Half width of the window around a return, and how far its middle is after the peak, bins.
const HALF: f64 = 30.0;
const AFTER: f64 = 4.0;
/// Distance from the one-bounce return up to which a peak is flare of the lens, bins.
const FLARE: f64 = 10.0;
/// Squared width of a two-bounce return, bins²; three bounces are wider.
const WIDTHS: std::ops::Range<f64> = 2.0..185.0;
/// Widest bins in which the width of a return can be told, metres: 40 ps. The published ones have
/// 8 ps.
pub const WIDEST_M: f64 = 0.012;
/// Probability above which a pixel is lit.
const LIT: f64 = 0.9;

/// Statistics of a return.
struct Peak {
    /// Bin of the maximum.
    bin: usize,
    /// Mean, in bins from the middle of the first.
    mean: f64,
    /// Squared width, bins² of the gate.
    square: f64,
    /// Photons above the background.
    photons: f64,
}

/// Weights of the Gaussian, with a sum of 1.
fn gaussian(timing: &Timing) -> Vec<f32> {
    let variance = VARIANCE * timing.bins(1.0) * timing.bins(1.0);
    let reach = timing.bins(REACH).round().max(1.0) as i32;
    let weight = |k: i32| libm::exp(-f64::from(k * k) / (2.0 * variance));
    let sum: f64 = (-reach..=reach).map(weight).sum();
    (-reach..=reach).map(|k| (weight(k) / sum) as f32).collect()
}

/// Returns the bins of the window whose peak is at `bin`.
fn window(timing: &Timing, bin: f64) -> std::ops::Range<usize> {
    let middle = bin + timing.bins(AFTER);
    let half = timing.bins(HALF);
    let end = f64::from(timing.gate.bins);
    let first = (middle - half).round().clamp(0.0, end);
    let last = ((middle + half).round() + 1.0).clamp(first, end);
    first as usize..last as usize
}

/// Returns the statistics of the return at a peak. `h` has photons.
fn statistics(h: &[f32], b: f64, bin: usize, timing: &Timing) -> Option<Peak> {
    let range = window(timing, bin as f64);
    let part = || range.clone().map(|k| (k as f64, f64::from(h[k]) - b));
    let photons: f64 = part().map(|(_, n)| n).sum();
    if photons <= 0.0 {
        return None;
    }
    let mean = part().map(|(k, n)| n * k).sum::<f64>() / photons;
    let spread: f64 = part().map(|(k, n)| n * (k - mean) * (k - mean)).sum();
    // Light is anywhere in its bin, which counts where bins are wide.
    let square = spread / photons + 1.0 / 12.0;
    Some(Peak {
        bin,
        mean,
        square,
        photons,
    })
}

/// Returns the greatest bin of a smoothed histogram, and its value.
fn greatest(h: &[f32], weights: &[f32]) -> (usize, f32) {
    let reach = weights.len() / 2;
    let mut best = (0, f32::NEG_INFINITY);
    for bin in 0..h.len() {
        let skip = reach.saturating_sub(bin);
        let from = bin.saturating_sub(reach);
        let f: f32 = weights[skip..]
            .iter()
            .zip(&h[from..])
            .map(|(w, x)| w * x)
            .sum();
        if f > best.1 {
            best = (bin, f);
        }
    }
    best
}

fn photons_of(h: &[f32], photons: f32) -> Vec<f32> {
    h.iter().map(|x| x * photons).collect()
}

/// Finds the return of each pixel of one capture.
pub fn returns(histogram: &[f32], photons: f32, timing: &Timing, out: &mut [Return]) {
    let bins = timing.gate.bins as usize;
    let weights = gaussian(timing);
    let width = timing.gate.bin_width_m;
    // The one-bounce return tells the difference between the mean and the peak of the pulse.
    let (pixel, bin) = brightest(histogram, bins);
    let one = photons_of(&histogram[pixel * bins..][..bins], photons);
    let one_b = f64::from(timing.background(&one));
    let Some(one) = statistics(&one, one_b, bin, timing) else {
        return;
    };
    // The threshold refers to bins of 8 ps.
    let density = (UNIT_M / width) as f32;
    out.par_iter_mut()
        .zip(histogram.par_chunks(bins))
        .for_each(|(found, h)| {
            let h = photons_of(h, photons);
            let b = timing.background(&h);
            let (bin, f) = greatest(&h, &weights);
            let (f, ambient) = (f * density, b * density);
            if f <= ambient + SIGMAS * ambient.max(0.0).sqrt() || f <= FEWEST {
                return;
            }
            let Some(peak) = statistics(&h, f64::from(b), bin, timing) else {
                return;
            };
            let flare = (peak.bin as f64 - one.bin as f64).abs() <= timing.bins(FLARE);
            let square = peak.square / (timing.bins(1.0) * timing.bins(1.0));
            let path_m = timing.one_bounce_m + (peak.mean - one.mean) * width;
            *found = Return {
                lit: !flare && WIDTHS.contains(&square),
                path_m: path_m as f32,
                energy: peak.photons as f32,
                variance_m2: (peak.square / peak.photons * width * width) as f32,
            };
        });
}

/// Judges the shadows of one spot.
pub struct Judge<'a> {
    pub timing: Timing,
    pub photons: f32,
    pub source: &'a Source,
    /// Normal of the surface that the spot is on, camera axes.
    pub normal: Vec3,
    pub rays: &'a Rays,
    pub surface: &'a Surface,
    /// Photons for cos·cos/r².
    pub albedo: &'a [f32],
}

impl Judge<'_> {
    /// Writes the probability that the spot lights each pixel. The published limit of 0.9 is moved
    /// to a half by the prior: the answer is the same.
    pub fn lit(&self, histogram: &[f32], out: &mut [f32]) {
        let bins = self.timing.gate.bins as usize;
        out.par_iter_mut()
            .zip(histogram.par_chunks(bins))
            .enumerate()
            .for_each(|(p, (lit, h))| {
                let expected =
                    self.albedo[p] * shape(self.rays, self.surface, self.source, self.normal, p);
                let x = self.rays.unit[p] * (self.surface.depth[p] * self.rays.slant[p]);
                let path = f64::from(self.source.path(x));
                let gate = &self.timing.gate;
                let range = window(&self.timing, (path - gate.start_m) / gate.bin_width_m - 0.5);
                // Half a photon in all quiet bins is the least background that can be told.
                let least = 0.5 / self.timing.quiet.max(1) as f32;
                let b = (self.timing.background(h) * self.photons).max(least);
                let ambient = f64::from(b) * range.len() as f64;
                let seen = f64::from(h[range].iter().sum::<f32>() * self.photons);
                *lit = probability(seen, ambient, f64::from(expected)) as f32;
            });
    }
}

/// Returns the probability of light where `seen` photons arrived, `ambient` are expected without
/// and `ambient + expected` with it. The prior of light is 0.1, so that a half is the published
/// limit of 0.9 at equal priors.
fn probability(seen: f64, ambient: f64, expected: f64) -> f64 {
    if ambient <= 0.0 || expected <= 0.0 {
        return 0.0;
    }
    let odds = seen * libm::log1p(expected / ambient) - expected;
    1.0 / (1.0 + libm::exp(libm::log(LIT / (1.0 - LIT)) - odds))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_half_is_nine_tenths_at_equal_priors() {
        for (seen, ambient, expected) in [(7.0, 3.0, 4.0), (5.0, 3.0, 4.0), (20.0, 9.0, 12.0)] {
            // P = 1/(1 + exp(Q log λ0 − Q log λ1 − λ0 + λ1)), as published.
            let (none, some) = (f64::ln(ambient), f64::ln(ambient + expected));
            let published = 1.0 / (1.0 + f64::exp(seen * none - seen * some + expected));
            let ours = probability(seen, ambient, expected);
            assert_eq!(ours >= 0.5, published >= 0.9, "{ours} for {published}");
            // The odds differ by the ratio of the priors alone.
            let odds = |p: f64| p / (1.0 - p);
            assert!((odds(ours) * 9.0 / odds(published) - 1.0).abs() < 1e-6);
        }
        assert_eq!(probability(100.0, 3.0, 0.0), 0.0);
    }
}
