//! The matched filter: correlation with the one-bounce pulse.
//!
//! PlatoNeRF's code (`bf_lidar/bf_lidar_depth.py`) takes the place of the maximum as the time, and
//! log10 of the maximum > −2.5 as lit. Four things differ here. Its histograms have the unit of
//! one renderer, so that the threshold means nothing for others: here each histogram is divided by
//! its sum, as in the preprocessing of PlatoNeRF's own method, and the maximum is a density for a
//! bin of 8 ps. The published threshold is that of the published pulse: a narrower pulse, such as
//! that of a render without one, correlates more with any light, so that the threshold grows with
//! the correlation of the pulse with itself. The background is subtracted from the maximum. Its
//! product of spectra lacks the conjugate, which mirrors the pulse in time: here it is a
//! correlation.

use rayon::prelude::*;

use super::returns::{Return, Timing, UNIT_M, brightest};

/// Least log10 of the correlation of a lit pixel.
const THRESHOLD_LOG10: f32 = -2.5;
/// Correlation with itself of a pulse of 128 ps, as density for a bin of 8 ps: the published
/// threshold is a share of 6 % of it.
const OWN_PUBLISHED: f32 = 0.05;
/// The most by which a narrow pulse raises the threshold: the width of a pixel spreads its light
/// over centimetres of path, whatever the pulse.
const MOST_NARROW: f32 = 8.0;
/// Share of the peak at which the pulse ends on both sides.
const END: f32 = 0.01;

/// The one-bounce pulse, with a sum of 1.
struct Pulse {
    values: Vec<f32>,
    /// Index of its peak.
    peak: usize,
    /// Correlation of the pulse with itself.
    own: f32,
}

impl Pulse {
    fn new(histogram: &[f32], timing: &Timing) -> Self {
        let bins = timing.gate.bins as usize;
        let (pixel, bin) = brightest(histogram, bins);
        let h = &histogram[pixel * bins..][..bins];
        let b = timing.background(h);
        let end = END * (h[bin] - b);
        let first = (0..bin).rev().find(|k| h[*k] - b < end);
        let last = (bin + 1..bins).find(|k| h[*k] - b < end);
        let range = first.map_or(0, |k| k + 1)..last.unwrap_or(bins);
        let peak = bin - range.start;
        let values: Vec<f32> = h[range].iter().map(|x| x - b).collect();
        let sum: f32 = values.iter().sum();
        let values: Vec<f32> = values.iter().map(|x| x / sum).collect();
        let own = values.iter().map(|x| x * x).sum();
        Self { values, peak, own }
    }

    /// Returns the bin of the greatest correlation, and the correlation there.
    fn greatest(&self, h: &[f32]) -> (usize, f32) {
        let mut best = (0, f32::NEG_INFINITY);
        for bin in 0..h.len() {
            let from = bin as isize - self.peak as isize;
            let skip = (-from).max(0) as usize;
            let start = from.max(0) as usize;
            let parts = self.values[skip.min(self.values.len())..].iter();
            let c: f32 = parts.zip(&h[start..]).map(|(a, b)| a * b).sum();
            if c > best.1 {
                best = (bin, c);
            }
        }
        best
    }
}

/// Finds the return of each pixel of one capture.
pub fn returns(histogram: &[f32], timing: &Timing, out: &mut [Return]) {
    let bins = timing.gate.bins as usize;
    let pulse = Pulse::new(histogram, timing);
    let density = (UNIT_M / timing.gate.bin_width_m) as f32;
    let narrower = (density * pulse.own / OWN_PUBLISHED).clamp(1.0, MOST_NARROW);
    out.par_iter_mut()
        .zip(histogram.par_chunks(bins))
        .for_each(|(found, h)| {
            let b = timing.background(h);
            let light: Vec<f32> = h.iter().map(|x| x - b).collect();
            let sum: f32 = h.iter().sum();
            let (bin, c) = pulse.greatest(&light);
            let score = density * c / sum / narrower;
            let lit = sum > 0.0 && score > 0.0 && libm::log10f(score) > THRESHOLD_LOG10;
            *found = Return {
                lit,
                path_m: super::middle(&timing.gate, bin as f64) as f32,
                energy: c.max(0.0) / pulse.own,
                variance_m2: 1.0,
            };
        });
}
