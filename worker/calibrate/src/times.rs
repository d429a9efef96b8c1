//! Times of two-bounce light: for a pixel and a spot the first peak, to a fraction of a bin.

use rayon::prelude::*;

use crate::pulse::{Pulse, STEPS, Template};

/// Bins of a peak before and after its brightest bin that take part.
const BEFORE: i64 = 4;
const AFTER: i64 = 5;
/// Widths of peaks that are tried, bins: a pixel's own width spreads its light.
const WIDTHS: [f64; 6] = [0.0, 0.8, 1.6, 2.4, 3.6, 5.0];
/// Share of the greatest smoothed bin from which on a first peak counts.
const FIRST: f32 = 0.4;
/// Standard deviations above the background from which on a bin has light.
const CLEAR: f32 = 5.0;
/// Error of a time that no count explains, bins: the shape of what a pixel sees.
const FLOOR: f64 = 0.06;

/// The time of a pixel's peak.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Time {
    /// Of the pulse's peak, bins from the begin of the gate.
    pub bin: f64,
    /// Its standard error, bins.
    pub error: f64,
    /// Photons of the peak.
    pub light: f64,
}

/// The pulse at all widths.
pub(crate) struct Finder {
    templates: Vec<Template>,
    /// Photons for each unit of the histograms.
    gain: f32,
}

impl Finder {
    pub fn new(pulse: &Pulse, gain: f32) -> Self {
        Self {
            templates: WIDTHS.iter().map(|w| pulse.template(*w)).collect(),
            gain,
        }
    }

    /// Times of the first peaks of some pixels in the histograms of one spot.
    pub fn first_peaks(
        &self,
        h: &[f32],
        bins: usize,
        pixels: &[usize],
        dark: &[f32],
    ) -> Vec<Option<Time>> {
        pixels
            .par_iter()
            .map(|p| self.first(&h[p * bins..][..bins], dark[*p]))
            .collect()
    }

    /// The first peak of one pixel; `dark` is its background, per bin.
    fn first(&self, h: &[f32], dark: f32) -> Option<Time> {
        let smooth = |b: usize| {
            let left = h[b.saturating_sub(1)];
            let right = h[(b + 1).min(h.len() - 1)];
            (0.25 * left + 0.5 * h[b] + 0.25 * right - dark) * self.gain
        };
        let top = (0..h.len()).map(smooth).fold(0.0f32, f32::max);
        let noise = (dark * self.gain + 1.0).sqrt();
        let least = (FIRST * top).max(CLEAR * 0.61 * noise);
        let first = (0..h.len()).find(|b| smooth(*b) >= least)?;
        let mut peak = first;
        while peak + 1 < h.len() && smooth(peak + 1) > smooth(peak) {
            peak += 1;
        }
        self.fit(h, peak, 1.5, dark)
    }

    /// The best time within `reach` bins of a bin's middle.
    pub fn fit(&self, h: &[f32], peak: usize, reach: f64, dark: f32) -> Option<Time> {
        let middle = peak as i64;
        let (first, last) = (middle - BEFORE, middle + AFTER);
        if first < 0 || last as usize >= h.len() {
            return None;
        }
        let part: Vec<f64> = (first..=last)
            .map(|b| f64::from((h[b as usize] - dark) * self.gain))
            .collect();
        let own = f64::from(dark * self.gain);
        let top = part.iter().copied().fold(0.0, f64::max);
        let weights: Vec<f64> = part
            .iter()
            .map(|x| 1.0 / (x.max(0.0) + own + 1.0 + (0.02 * top).powi(2)))
            .collect();
        let steps = (reach * STEPS as f64) as i64;
        let mut best: Option<(f64, i64, usize, f64)> = None;
        for (w, template) in self.templates.iter().enumerate() {
            for shift in -steps..=steps {
                // Later bounces begin with the peak and stay: the peak's own sum.
                let (mut m, mut r, mut all) = ([0.0; 3], [0.0; 2], 0.0);
                let mut sum = 0.0;
                for (k, x) in part.iter().enumerate() {
                    let at = (first + k as i64 - middle) * STEPS - shift;
                    let y = template.share(at);
                    let after = sum + 0.5 * y;
                    sum += y;
                    let g = weights[k];
                    m[0] += g * y * y;
                    m[1] += g * y * after;
                    m[2] += g * after * after;
                    r[0] += g * y * x;
                    r[1] += g * after * x;
                    all += g * x * x;
                }
                let det = m[0] * m[2] - m[1] * m[1];
                let mut a = (r[0] * m[2] - r[1] * m[1]) / det;
                let mut c = (r[1] * m[0] - r[0] * m[1]) / det;
                if c < 0.0 || !c.is_finite() {
                    (a, c) = (r[0] / m[0], 0.0);
                }
                if a <= 0.0 || !a.is_finite() {
                    continue;
                }
                let left = all - a * r[0] - c * r[1];
                if best.is_none_or(|b| left < b.0) {
                    best = Some((left, shift, w, a));
                }
            }
        }
        let (left, shift, w, a) = best?;
        // A time at the end of the window has no peak within it.
        if shift.abs() == steps {
            return None;
        }
        let template = &self.templates[w];
        let information: f64 = (first..=last)
            .zip(&weights)
            .map(|(b, g)| {
                let at = (b - middle) * STEPS - shift;
                let slope = (template.share(at + 1) - template.share(at - 1)) * STEPS as f64 / 2.0;
                g * (a * slope).powi(2)
            })
            .sum();
        let fit = (left / (part.len() - 4) as f64).max(1.0);
        let error = (fit / information.max(1e-12) + FLOOR * FLOOR).sqrt();
        (error < 1.0).then_some(Time {
            bin: peak as f64 + 0.5 + shift as f64 / STEPS as f64,
            error,
            light: a,
        })
    }
}
