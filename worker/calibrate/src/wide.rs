//! Captures whose pulse is many bins wide: the check adds bins up until the pulse is two or three
//! bins wide, because its templates and limits are made for such pulses.

use picofarm_demultiplex::Capture;
use picofarm_settings::Gate;
use rayon::prelude::*;

use crate::{
    Checked, Measurement,
    numeric::{median, quantile},
    observe::CONTRAST,
    pulse::brightest,
};

/// Width at half maximum from which on bins are added up, and the width to come to, bins.
const WIDE: (f64, f64) = (4.0, 2.5);
/// Fewest returns of one bounce that tell the width.
const FEWEST: usize = 3;
/// Without returns: the quantile of the widths of two-bounce peaks that tells the width, and the
/// brightest bin of a peak over the mean bin (or one count), at least.
const NARROWEST: f64 = 0.25;
const PEAK: f64 = 20.0;
/// Fewest bins that must be left.
const LEFT: usize = 32;

/// Returns how many bins are added up; 1 = none.
pub(crate) fn factor(m: &Measurement) -> usize {
    let Some(each) = m.per_spot else { return 1 };
    let (bins, cells) = (m.bins(), m.pixels() * m.bins());
    let all = vec![true; m.pixels()];
    let mut widths: Vec<f64> = each
        .par_chunks(cells)
        .filter_map(|h| {
            let found = brightest(h, bins, m.width(), &all)?;
            let own = &h[found.pixel * bins..][..bins];
            (found.contrast >= CONTRAST).then(|| width(own, found.bin as usize))
        })
        .collect();
    if widths.len() < FEWEST {
        // Two-bounce peaks are as wide, or wider where a pixel sees a range of depths.
        let mut peaks: Vec<f64> = each.par_chunks(bins).filter_map(peak_width).collect();
        widths = Vec::from_iter(quantile(&mut peaks, NARROWEST));
    }
    let usual = median(&mut widths).unwrap_or(1.0);
    if usual <= WIDE.0 {
        return 1;
    }
    let added = (usual / WIDE.1).ceil() as usize;
    if bins / added < LEFT { 1 } else { added }
}

/// Width of the brightest peak of a histogram, if it stands out.
fn peak_width(h: &[f32]) -> Option<f64> {
    let (mut peak, mut sum) = (0, 0.0);
    for (b, x) in h.iter().enumerate() {
        sum += f64::from(*x);
        if *x > h[peak] {
            peak = b;
        }
    }
    let mean = sum / h.len() as f64;
    // Few counts have no width.
    (f64::from(h[peak]) > PEAK * mean.max(1.0)).then(|| width(h, peak))
}

/// Full width at half maximum of a peak about a bin, smoothed over three bins, in whole bins.
fn width(h: &[f32], peak: usize) -> f64 {
    let smooth = |b: usize| {
        let (left, right) = (h[b.saturating_sub(1)], h[(b + 1).min(h.len() - 1)]);
        0.25 * left + 0.5 * h[b] + 0.25 * right
    };
    let half = 0.5 * smooth(peak);
    let before = (0..peak).rev().take_while(|b| smooth(*b) > half).count();
    let after = (peak + 1..h.len())
        .take_while(|b| smooth(*b) > half)
        .count();
    (before + 1 + after) as f64
}

/// A measurement with bins added up.
pub(crate) struct Coarse {
    added: usize,
    gate: Gate,
    sum: Vec<f32>,
    per_spot: Option<Vec<f32>>,
}

impl Coarse {
    pub fn new(m: &Measurement, added: usize) -> Self {
        let bins = m.bins();
        let gate = m.capture.gate;
        let add = |h: &[f32]| -> Vec<f32> {
            let kept = bins / added * added;
            h.par_chunks(bins)
                .flat_map_iter(|h| h[..kept].chunks(added).map(|part| part.iter().sum::<f32>()))
                .collect()
        };
        Self {
            added,
            gate: Gate {
                bin_width_m: gate.bin_width_m * added as f64,
                bins: (bins / added) as u32,
                ..gate
            },
            sum: add(m.capture.histogram),
            per_spot: m.per_spot.map(add),
        }
    }

    pub fn measurement<'a>(&'a self, m: &Measurement<'a>) -> Measurement<'a> {
        Measurement {
            capture: Capture {
                histogram: &self.sum,
                gate: self.gate,
                ..m.capture
            },
            per_spot: self.per_spot.as_deref(),
            ..*m
        }
    }

    /// Puts the result into bins of the measurement itself.
    pub fn restore(&self, m: &Measurement, checked: &mut Checked) {
        let (gate, added) = (m.capture.gate, self.added as f64);
        let found = &mut checked.corrected;
        found.gate = match found.gate == self.gate {
            true => gate,
            false => Gate {
                bin_width_m: found.gate.bin_width_m / added,
                bins: gate.bins,
                ..found.gate
            },
        };
        found.dark_bins = found.dark_bins.map(|n| n * self.added);
        if let Some(pulse) = &mut checked.report.pulse {
            pulse.shape.sigma_bins *= added;
            pulse.shape.tail_bins *= added;
        }
    }
}
