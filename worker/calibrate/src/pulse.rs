//! The pulse: laser, detector and jitter together, estimated from the returns of one bounce.

use serde::{Deserialize, Serialize};

use crate::numeric::V3;

/// Steps of a template per bin.
pub(crate) const STEPS: i64 = 16;
/// Bins of a template before and after its zero.
const REACH: i64 = 14;
/// Bins of a return before and after its brightest bin that take part.
const BEFORE: usize = 4;
const AFTER: usize = 7;

/// Share of squared light beyond which a return has another shape than the pulse.
const ODD: f64 = 0.03;
/// Share of odd returns from which on the pulse is unknown.
const UNLIKE: f64 = 0.999;

/// A pulse as a Gaussian convolved with an exponential tail. Its zero, to which every time refers,
/// is its peak.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pulse {
    /// Standard deviation of the Gaussian, bins.
    pub sigma_bins: f64,
    /// Time constant of the tail, bins; 0 = none.
    pub tail_bins: f64,
}

/// The share of a pulse that falls into each bin, for pulses that begin between bins, widened by
/// the depth of what a pixel sees.
#[derive(Debug, Clone)]
pub(crate) struct Template {
    /// Share of the bin whose middle is at (index / STEPS − REACH) bins from the pulse's peak.
    values: Vec<f64>,
}

impl Template {
    /// Share of a bin whose middle is `steps` sixteenths of a bin after the peak.
    pub fn share(&self, steps: i64) -> f64 {
        let index = steps + REACH * STEPS;
        match usize::try_from(index) {
            Ok(index) => self.values.get(index).copied().unwrap_or(0.0),
            Err(_) => 0.0,
        }
    }
}

impl Pulse {
    fn density(&self, t: f64) -> f64 {
        let s = self.sigma_bins;
        if self.tail_bins < 1e-3 {
            return libm::exp(-0.5 * t * t / (s * s));
        }
        let tau = self.tail_bins;
        let z = (s / tau - t / s) / std::f64::consts::SQRT_2;
        // exp(a)·erfc(z) overflows and underflows far from the peak; there the Gaussian decides.
        let a = 0.5 * s * s / (tau * tau) - t / tau;
        if z > 5.0 {
            let bell = libm::exp(-0.5 * t * t / (s * s));
            return bell / (z * std::f64::consts::PI.sqrt()) / tau * 0.5;
        }
        0.5 / tau * libm::exp(a) * libm::erfc(z)
    }

    /// Density on sixteenths of a bin, from −REACH to REACH bins about the peak, of sum 1.
    fn fine(&self) -> Vec<f64> {
        let n = 2 * REACH * STEPS + 1;
        let from = |first: f64, k: i64| first + k as f64 / STEPS as f64;
        // The peak is between 0 and the mean.
        let mut peak = (0.0, -1.0);
        for k in 0..400 {
            let t = -0.2 + k as f64 / 400.0 * (self.tail_bins + 0.4);
            let x = self.density(t);
            if x > peak.1 {
                peak = (t, x);
            }
        }
        let mut fine: Vec<f64> = (0..n)
            .map(|k| self.density(from(peak.0 - REACH as f64, k)))
            .collect();
        let sum: f64 = fine.iter().sum();
        fine.iter_mut().for_each(|x| *x /= sum);
        fine
    }

    /// Template of light spread evenly over `width` bins.
    pub(crate) fn template(&self, width: f64) -> Template {
        let fine = self.fine();
        let boxed = |from: &[f64], bins: f64| -> Vec<f64> {
            let half = (0.5 * bins * STEPS as f64).round() as i64;
            if half == 0 {
                return from.to_vec();
            }
            let n = from.len() as i64;
            let count = 2 * half;
            (0..n)
                .map(|k| {
                    // The two ends count by a half, so that the mean stays where it is.
                    let value = |j: i64| from.get(usize::try_from(j).unwrap_or(usize::MAX));
                    let sum: f64 = (k - half..=k + half)
                        .map(|j| {
                            let end = (j - k).abs() == half;
                            value(j).copied().unwrap_or(0.0) * if end { 0.5 } else { 1.0 }
                        })
                        .sum();
                    sum / count as f64
                })
                .collect()
        };
        let mut values = boxed(&boxed(&fine, 1.0), width);
        // Shares of whole bins have the sum 1.
        values.iter_mut().for_each(|x| *x *= STEPS as f64);
        Template { values }
    }

    /// Returns the share of the pulse that falls into a bin whose middle is so many bins after the
    /// pulse's peak, at steps of a sixteenth of a bin.
    pub fn share(&self, bins: f64) -> f64 {
        let steps = (bins * STEPS as f64).round() as i64;
        self.template(0.0).share(steps)
    }

    /// Full width at half maximum, bins.
    pub fn fwhm_bins(&self) -> f64 {
        let fine = self.fine();
        let top = fine.iter().copied().fold(0.0, f64::max);
        let above = fine.iter().filter(|x| **x >= 0.5 * top).count();
        above as f64 / STEPS as f64
    }
}

/// A return of one bounce.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Return {
    /// Its pixel.
    pub pixel: usize,
    /// Time of the pulse's peak, bins from the begin of the gate.
    pub bin: f64,
    /// Sum of its counts.
    pub light: f64,
    /// Brightest bin over that of the brightest pixel elsewhere.
    pub contrast: f64,
}

/// Finds the brightest pixel and bin of a histogram among good pixels.
pub(crate) fn brightest(h: &[f32], bins: usize, width: usize, good: &[bool]) -> Option<Return> {
    let (mut best, mut value) = (None, 0.0f32);
    let mut tops = vec![0.0f32; good.len()];
    for (p, h) in h.chunks_exact(bins).enumerate().filter(|(p, _)| good[*p]) {
        for (b, x) in h.iter().enumerate() {
            if *x > value {
                (best, value) = (Some((p, b)), *x);
            }
            tops[p] = tops[p].max(*x);
        }
    }
    let (pixel, bin) = best?;
    let far = |p: usize| {
        let column = (p % width).abs_diff(pixel % width);
        column > 1 || (p / width).abs_diff(pixel / width) > 1
    };
    let elsewhere = (0..tops.len()).filter(|p| far(*p));
    let other = elsewhere.map(|p| tops[p]).fold(0.0f32, f32::max);
    let near = &h[pixel * bins..][bin.saturating_sub(BEFORE)..(bin + AFTER).min(bins)];
    Some(Return {
        pixel,
        bin: bin as f64 + 0.5,
        light: near.iter().map(|x| f64::from(*x)).sum(),
        contrast: f64::from(value) / f64::from(other).max(1e-30),
    })
}

/// Least squares of one return: the pulse's time in sixteenths of a bin from the middle of bin
/// `peak`, and the share of the squared light that is left over.
fn place(h: &[f32], peak: usize, template: &Template) -> (i64, f64) {
    let first = peak.saturating_sub(BEFORE);
    let part = &h[first..(peak + AFTER).min(h.len())];
    let base = f64::from(part[0].min(part[1]));
    let all: f64 = part.iter().map(|x| (f64::from(*x) - base).powi(2)).sum();
    let mut best = (0, f64::INFINITY);
    for shift in -STEPS..=STEPS {
        let (mut xy, mut yy) = (0.0, 0.0);
        for (k, x) in part.iter().enumerate() {
            let y = template.share((first + k) as i64 * STEPS - peak as i64 * STEPS - shift);
            xy += (f64::from(*x) - base) * y;
            yy += y * y;
        }
        let left = all - xy.max(0.0).powi(2) / yy.max(1e-300);
        if left < best.1 {
            best = (shift, left);
        }
    }
    (best.0, best.1 / all.max(1e-300))
}

/// Estimates the pulse from returns, and moves their times to the pulse's peak. `histogram`
/// returns the bins of a return's pixel in its own capture. `None` if the returns show no pulse.
pub(crate) fn estimate<'a>(
    returns: &mut [Option<Return>],
    usable: &[bool],
    histogram: impl Fn(usize, usize) -> &'a [f32],
) -> Option<Pulse> {
    let peaks: Vec<(&[f32], usize)> = returns
        .iter()
        .enumerate()
        .filter(|(k, _)| usable[*k])
        .filter_map(|(k, r)| r.map(|r| (histogram(k, r.pixel), r.bin as usize)))
        .filter(|(h, bin)| *bin >= BEFORE && bin + AFTER < h.len())
        .collect();
    let cost = |sigma: f64, tail: f64| {
        let pulse = Pulse {
            sigma_bins: sigma,
            tail_bins: tail,
        };
        let template = pulse.template(0.0);
        let left = peaks.iter().map(|(h, bin)| place(h, *bin, &template).1);
        // A return that is none must not decide.
        left.map(|l| l.min(ODD)).sum::<f64>()
    };
    let mut best: V3 = [0.3, 0.0, f64::INFINITY];
    let mut span = [2.0f64, 1.3, 1.12];
    for (round, span) in span.iter_mut().enumerate() {
        let around = best;
        for i in -4i32..=4 {
            for j in -4i32..=4 {
                let (sigma, tail) = match round {
                    0 => (
                        0.4 * span.powi(i),
                        [0.0, 0.8 * span.powi(j)][usize::from(j > -4)],
                    ),
                    _ => (around[0] * span.powi(i), around[1] * span.powi(j)),
                };
                let left = cost(sigma.clamp(0.05, 4.0), tail.min(6.0));
                if left < best[2] {
                    best = [sigma.clamp(0.05, 4.0), tail.min(6.0), left];
                }
            }
        }
    }
    // No pulse of any width is like the returns.
    if best[2] > UNLIKE * ODD * peaks.len() as f64 || peaks.is_empty() {
        return None;
    }
    let pulse = Pulse {
        sigma_bins: best[0],
        tail_bins: best[1],
    };
    let template = pulse.template(0.0);
    for (k, r) in returns.iter_mut().enumerate() {
        if let Some(r) = r {
            let bin = r.bin as usize;
            let (shift, _) = place(histogram(k, r.pixel), bin, &template);
            r.bin = bin as f64 + 0.5 + shift as f64 / STEPS as f64;
        }
    }
    Some(pulse)
}
