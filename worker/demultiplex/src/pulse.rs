//! The pulse of laser and detector, and histograms without it, because the rest of the method
//! assumes peaks about as narrow as a bin.
//!
//! The spots' own one-bounce returns show the pulse, so that nothing needs to be known of the
//! instrument.

use picofarm_settings::Gate;
use rayon::prelude::*;

use crate::{
    Capture,
    geometry::{Rays, Source},
    sweep::quiet,
};

/// Path before and after the arrival of a spot's own return in which its pulse is looked for,
/// metres.
const BEFORE_M: f64 = 0.25;
const AFTER_M: f64 = 1.2;
/// Difference between calibrated and seen arrival of a return at most, metres.
const OFF_M: f64 = 0.06;
/// Share of the peak below which the pulse has ended on both sides.
const END: f32 = 0.004;
/// Share of the pulse in its greatest bin and both neighbours from which on it needs no removal.
const NARROW: f32 = 0.8;
/// How much brighter than the median pixel's peak a one-bounce return is at least.
const BRIGHT: f32 = 8.0;
/// Rounds of the deconvolution.
const ROUNDS: usize = 80;

/// A pulse: its share in each bin, with a sum of 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Pulse {
    values: Vec<f32>,
    /// Index of the bin of the calibrated arrival.
    zero: usize,
}

impl Pulse {
    /// Returns the pulse that the spots' own one-bounce returns show, in bins of the capture, or
    /// `None` if no return is seen.
    pub fn of_returns(capture: &Capture, rays: &Rays, sources: &[Source]) -> Option<Self> {
        let (gate, bins) = (&capture.gate, capture.gate.bins as usize);
        let width = gate.bin_width_m;
        let whole = |m: f64| (m / width).ceil() as usize;
        let (before, after, off) = (whole(BEFORE_M), whole(AFTER_M), whole(OFF_M));
        let quiet = quiet(gate, sources);
        let least = BRIGHT * median_peak(capture);
        let mut sum = vec![0.0f64; before + after + 1];
        for s in sources {
            let Some(pixel) = rays.pixel_of(s.point) else {
                continue;
            };
            let path = f64::from(s.path_m) + f64::from(s.square).sqrt();
            let Some(arrival) = gate.bin(path).map(|b| b as usize) else {
                continue;
            };
            let near = arrival.saturating_sub(off)..(arrival + off + 1).min(bins);
            let peak = |p: &usize| {
                let h = &capture.histogram[p * bins..][..bins];
                h[near.clone()].iter().copied().fold(0.0f32, f32::max)
            };
            let Some(best) = around(rays, pixel).max_by(|a, b| peak(a).total_cmp(&peak(b))) else {
                continue;
            };
            if peak(&best) < least {
                continue;
            }
            let h = &capture.histogram[best * bins..][..bins];
            let ambient = mean(&h[..quiet]);
            for (k, sum) in sum.iter_mut().enumerate() {
                let bin = (arrival + k).checked_sub(before);
                if let Some(x) = bin.and_then(|b| h.get(b)) {
                    *sum += f64::from((x - ambient).max(0.0));
                }
            }
        }
        let values: Vec<f32> = sum.iter().map(|x| *x as f32).collect();
        Self::cut(values, before)
    }

    /// The pulse without what is before its rise and after its end.
    fn cut(values: Vec<f32>, zero: usize) -> Option<Self> {
        let (mut at, mut peak) = (0, 0.0f32);
        for (k, x) in values.iter().enumerate() {
            if *x > peak {
                (at, peak) = (k, *x);
            }
        }
        if peak <= 0.0 {
            return None;
        }
        let low = |k: &usize| values[*k] < END * peak;
        let first = (0..at).rev().find(low).map_or(0, |k| k + 1).min(zero);
        let last = (at + 1..values.len())
            .find(low)
            .unwrap_or(values.len())
            .max(zero + 1);
        let total: f32 = values[first..last].iter().sum();
        Some(Self {
            values: values[first..last].iter().map(|x| x / total).collect(),
            zero: zero - first,
        })
    }

    /// The pulse in bins of `per` of its own, of light that arrives anywhere in one of them.
    pub fn summed(&self, per: usize) -> Self {
        let zero = self.zero.div_ceil(per);
        let count = zero + (self.values.len() - self.zero + per - 1).div_ceil(per) + 1;
        let mut values = vec![0.0; count];
        for a in 0..per {
            for (k, x) in self.values.iter().enumerate() {
                // Bins since the beginning of the wide bin `zero`.
                let at = zero * per + a + k - self.zero;
                values[at / per] += x / per as f32;
            }
        }
        Self { values, zero }
    }

    /// Whether nothing is gained without it.
    pub fn is_narrow(&self) -> bool {
        let near = self.zero.saturating_sub(1)..(self.zero + 2).min(self.values.len());
        self.values[near].iter().sum::<f32>() >= NARROW
    }

    /// Removes the pulse from histograms: what stays is the light of each bin that makes the counts
    /// most likely if they are Poisson (Richardson 1972, Lucy 1974), with the ambient light of the
    /// first `quiet` bins.
    pub fn remove(&self, histogram: &mut [f32], gate: &Gate, quiet: usize) {
        let bins = gate.bins as usize;
        // Shares of each bin's light that the gate holds.
        let held: Vec<f32> = (0..bins)
            .map(|j| {
                let part = self.values.iter().enumerate();
                let inside =
                    part.filter(|(m, _)| (j + m).checked_sub(self.zero).is_some_and(|b| b < bins));
                inside.map(|(_, k)| k).sum::<f32>()
            })
            .collect();
        let empty = || vec![0.0f32; bins];
        histogram.par_chunks_mut(bins).for_each_init(
            || (empty(), empty(), empty()),
            |(counts, model, ratio), pixel| {
                counts.copy_from_slice(pixel);
                let ambient = mean(&counts[..quiet.min(bins)]);
                self.pixel(counts, &held, ambient, pixel, model, ratio)
            },
        );
    }

    fn pixel(
        &self,
        h: &[f32],
        held: &[f32],
        ambient: f32,
        out: &mut [f32],
        model: &mut [f32],
        ratio: &mut [f32],
    ) {
        let bins = h.len();
        let total: f32 = h.iter().sum();
        if total <= 0.0 {
            return;
        }
        let usual = total / bins as f32;
        let floor = 1e-6 * usual;
        out.fill(usual);
        for _ in 0..ROUNDS {
            model.fill(ambient + floor);
            for (j, x) in out.iter().enumerate() {
                if *x <= floor {
                    continue;
                }
                let (skip, start) = self.from(j);
                for (m, k) in model[start..].iter_mut().zip(&self.values[skip..]) {
                    *m += k * x;
                }
            }
            for ((r, h), m) in ratio.iter_mut().zip(h).zip(model.iter()) {
                *r = h / m;
            }
            for (j, x) in out.iter_mut().enumerate() {
                if *x <= floor || held[j] <= 0.01 {
                    *x = 0.0;
                    continue;
                }
                let (skip, start) = self.from(j);
                let part = ratio[start..].iter().zip(&self.values[skip..]);
                *x *= part.map(|(r, k)| r * k).sum::<f32>() / held[j];
            }
        }
    }

    /// The first value of the pulse of a bin's light that the gate holds, and its bin.
    fn from(&self, j: usize) -> (usize, usize) {
        (self.zero.saturating_sub(j), j.saturating_sub(self.zero))
    }
}

fn around(rays: &Rays, pixel: usize) -> impl Iterator<Item = usize> {
    let (width, height) = (rays.width, rays.height);
    let (column, row) = (pixel % width, pixel / width);
    let rows = row.saturating_sub(1)..(row + 2).min(height);
    rows.flat_map(move |v| {
        let columns = column.saturating_sub(1)..(column + 2).min(width);
        columns.map(move |u| v * width + u)
    })
}

/// The brightest bin of the median pixel.
fn median_peak(capture: &Capture) -> f32 {
    let bins = capture.gate.bins as usize;
    let peak = |h: &[f32]| h.iter().copied().fold(0.0f32, f32::max);
    let mut peaks: Vec<f32> = capture.histogram.par_chunks(bins).map(peak).collect();
    let middle = peaks.len() / 2;
    *peaks.select_nth_unstable_by(middle, f32::total_cmp).1
}

fn mean(h: &[f32]) -> f32 {
    h.iter().sum::<f32>() / h.len().max(1) as f32
}
