//! What a capture shows: returns of one bounce, the pulse, and the times of two-bounce light.

use picofarm_demultiplex::Demultiplexed;
use rayon::prelude::*;

use crate::{
    Measurement,
    fit::Observed,
    model::Model,
    numeric::{along, length, sub},
    pixels::{Pixels, unpile},
    pulse::{Pulse, Return, brightest, estimate},
    times::{Finder, Time},
};

/// The greatest number of pixels that take part.
const MOST: usize = 2500;
/// A return's brightest bin over those of all other pixels, at least.
pub(crate) const CONTRAST: f64 = 4.0;
/// Share of the pulses from which on pile-up spoils the shape of a return.
const SPOILT: f64 = 0.3;
/// Pulse that is assumed where no return shows one, bins.
pub(crate) const ASSUMED: Pulse = Pulse {
    sigma_bins: 0.35,
    tail_bins: 0.5,
};
/// Probability of light from which on a spot's peak is looked for in a histogram of all spots.
const LIT: f32 = 0.7;
/// Bins by which peaks of two spots must differ there.
const APART: f64 = 4.0;
/// Distance in which a peak is looked for there, bins.
const REACH: f64 = 1.5;

/// What a capture shows.
pub(crate) struct Seen {
    pub observed: Observed,
    pub pulse: Option<Pulse>,
    /// Bins and shares of the returns' light: (bins after the pulse's peak, share of the return).
    pub samples: Vec<[f64; 2]>,
}

/// Good pixels that take part, evenly over the image.
fn chosen(pixels: &Pixels) -> Vec<usize> {
    let good = pixels.good();
    let all: Vec<usize> = (0..good.len()).filter(|p| good[*p]).collect();
    let step = all.len().div_ceil(MOST).max(1);
    all.into_iter().step_by(step).collect()
}

/// Observes the histograms of each spot alone.
pub(crate) fn each(m: &Measurement, per_spot: &[f32], pixels: &Pixels) -> Seen {
    let (bins, cells) = (m.bins(), m.pixels() * m.bins());
    let good = pixels.good();
    let mut corrected = per_spot.to_vec();
    if let Some(pulses) = pixels.pulses {
        corrected
            .par_chunks_mut(bins)
            .for_each(|h| unpile(h, pulses));
    }
    let captures: Vec<&[f32]> = corrected.chunks(cells).collect();
    let mut returns: Vec<Option<Return>> = captures
        .par_iter()
        .map(|h| brightest(h, bins, m.width(), &good).filter(|r| r.contrast >= CONTRAST))
        .collect();
    let whole: Vec<bool> = returns
        .iter()
        .enumerate()
        .map(|(k, r)| {
            let (Some(r), Some(pulses)) = (r, pixels.pulses) else {
                return r.is_some();
            };
            let h = &per_spot[k * cells + r.pixel * bins..][..bins];
            let total: f64 = h.iter().map(|x| f64::from(*x)).sum();
            total < SPOILT * pulses as f64
        })
        .collect();
    let of_pixel = |k: usize, p: usize| &captures[k][p * bins..][..bins];
    let known = whole.iter().filter(|w| **w).count() >= 3;
    let pulse = match known {
        true => estimate(&mut returns, &whole, of_pixel),
        false => None,
    };
    if pulse.is_none() {
        // The rise of a spoilt return still tells its pixel, and its time to a bin.
        returns
            .iter_mut()
            .flatten()
            .for_each(|r| r.bin = r.bin.floor() + 0.5);
    }
    let samples = samples(&returns, &whole, of_pixel);
    let finder = Finder::new(&pulse.unwrap_or(ASSUMED), pixels.gain);
    let list = chosen(pixels);
    let times = captures
        .iter()
        .map(|h| {
            let dark = pixels.dark_of_spot(h, bins);
            finder.first_peaks(h, bins, &list, &dark)
        })
        .collect();
    Seen {
        observed: Observed {
            pixels: list,
            times,
            returns,
        },
        pulse,
        samples,
    }
}

fn samples<'a>(
    returns: &[Option<Return>],
    whole: &[bool],
    histogram: impl Fn(usize, usize) -> &'a [f32],
) -> Vec<[f64; 2]> {
    let mut all = Vec::new();
    for (k, r) in returns.iter().enumerate().filter(|(k, _)| whole[*k]) {
        let Some(r) = r else { continue };
        let h = histogram(k, r.pixel);
        let first = (r.bin as usize).saturating_sub(5);
        for (b, x) in h.iter().enumerate().take(r.bin as usize + 9).skip(first) {
            let share = f64::from(*x) / r.light.max(1e-30);
            all.push([b as f64 + 0.5 - r.bin, share]);
        }
    }
    all
}

/// Observes the histogram of all spots at once: peaks at the times that one flash taken apart with
/// the calibration `model` predicts.
pub(crate) fn together(
    m: &Measurement,
    found: &Demultiplexed,
    model: &Model,
    pixels: &Pixels,
    finder: &Finder,
) -> Observed {
    let (bins, cells) = (m.bins(), m.pixels());
    let h = m.capture.histogram;
    let list = chosen(pixels);
    let spots: Vec<_> = (0..model.beams.len()).map(|k| model.spot(k)).collect();
    let rows: Vec<Vec<Option<Time>>> = list
        .par_iter()
        .map(|p| {
            let ray = model.ray(*p);
            let range = f64::from(found.depth_m[*p]) / ray[2];
            let x = along([0.0; 3], ray, range);
            let sure = found.confidence[*p] >= 0.5 && found.mirror_probability[*p] < 0.5;
            let bin: Vec<Option<f64>> = (0..spots.len())
                .map(|k| {
                    let path = spots[k].1 + length(sub(spots[k].0, x)) + length(x);
                    let lit = found.lit[k * cells + p];
                    (lit > 0.3).then(|| (path - model.start) / model.width)
                })
                .collect();
            (0..spots.len())
                .map(|k| {
                    let own = bin[k].filter(|_| sure && found.lit[k * cells + p] >= LIT)?;
                    let others = bin.iter().enumerate().filter(|(j, _)| *j != k);
                    let alone = others
                        .filter_map(|(_, b)| *b)
                        .all(|b| (b - own).abs() > APART);
                    let peak = own.floor();
                    (alone && peak >= 0.0)
                        .then(|| finder.fit(&h[p * bins..][..bins], peak as usize, REACH, 0.0))
                        .flatten()
                })
                .collect()
        })
        .collect();
    let times = (0..spots.len())
        .map(|k| rows.iter().map(|row| row[k]).collect())
        .collect();
    Observed {
        pixels: list,
        times,
        returns: vec![None; spots.len()],
    }
}
