//! Pixels: dead, hot, clipped; background; pile-up.

use rayon::prelude::*;

use crate::{
    Measurement,
    cut::{Cut, Lit},
    numeric::quantile,
};

/// Share of a bright pixel's counts below which a pixel counts as unlit.
const DEAD: f64 = 0.002;
/// Share of the usual background below which an unlit pixel counts as dead, and photons of that
/// background from which on it can be seen. A pixel in shadow has the background of the others.
const LACKS: (f64, f64) = (0.3, 12.0);
/// Share of a pixel's counts that come before any light can, and factor over the median's
/// background, from which on a pixel counts as hot.
const HOT: [f64; 2] = [0.5, 5.0];
/// Share of the brightest bin of the mean pixel by which light has come.
const RISE: f64 = 0.02;
/// Bins before that which count as light: a pulse begins before its peak.
const BEFORE: usize = 3;
/// Bins before a pixel's own first bright bin.
const MARGIN: usize = 8;
/// Parts of the bins before the light, whose median part shows the background; the share of the
/// mean below which the rest is the light of a near object, and the least counts.
const PARTS: usize = 8;
const UNEVEN: (f64, f64) = (0.5, 24.0);
/// Rank of the bin that counts as a pixel's brightest, so that a return of one bounce does not.
const RANK: usize = 8;
/// Least count that may be a ceiling, and cells that must be at it.
const CEILING: (f32, usize) = (15.0, 8);
/// Count below which a ceiling must also be more frequent than all counts from this share of it on:
/// the greatest of few counts comes up often by chance.
const RARE: (f32, f32) = (100.0, 0.9);
/// Spread of the greatest totals, over their median, below which a pixel's totals are limited by
/// the number of pulses.
const LEVEL: f64 = 0.03;

/// What the pixels of a capture are like.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Pixels {
    pub dead: Vec<bool>,
    /// Rows and columns at the image's edges without any count.
    pub padding: Vec<bool>,
    /// Whether pixels that count show background, by which shadow differs from a dead pixel.
    pub shade: bool,
    pub hot: Vec<bool>,
    /// Background of each pixel in the histogram of all spots, per bin.
    pub dark: Vec<f32>,
    /// Bins before any light; 0 if the gate begins too late to tell.
    pub dark_bins: usize,
    /// Light of the median pixel over the gate, without background.
    pub light: f64,
    /// Greatest count, and the number of bins that hold it, if it is a ceiling.
    pub ceiling: Option<(f32, usize)>,
    /// Whether the histograms are whole counts.
    pub counts: bool,
    /// Photons for each unit of the histograms.
    pub gain: f32,
    /// Pulses of each histogram, stated or from totals that reach them, if pile-up shows.
    pub pulses: Option<u64>,
    /// Share of the photons of the median pixel that pile-up hides.
    pub lost: f64,
    /// Light that the gate cuts.
    pub cut: Option<Cut>,
}

impl Pixels {
    pub fn good(&self) -> Vec<bool> {
        (0..self.dead.len())
            .map(|p| !self.dead[p] && !self.hot[p] && !self.padding[p])
            .collect()
    }

    pub fn new(m: &Measurement) -> Self {
        let bins = m.bins();
        let h = m.capture.histogram;
        let cells = m.per_spot.unwrap_or(h);
        let counts = cells.par_iter().all(|x| *x >= 0.0 && x.fract() == 0.0);
        let (dark_bins, tops) = first_light(h, bins);
        let mut middle: Vec<f64> = tops.iter().copied().filter(|t| *t > 0.0).collect();
        let typical = quantile(&mut middle, 0.5).unwrap_or(1.0);
        // Light in other units is taken for a bright measurement of 1000 photons in a bin, unless
        // its values have steps, as photons in another unit or of a coarse code have.
        let gain = match counts {
            true => 1.0,
            false => (1000.0 / typical).min(1.0 / step(cells)) as f32,
        };
        let totals: Vec<f64> = h.par_chunks(bins).map(sum).collect();
        let dark: Vec<f32> = h
            .par_chunks(bins)
            .map(|h| match dark_bins {
                0 => 0.0,
                // The pulse of a bright spot's pixel may begin earlier.
                n => {
                    let top = h.iter().copied().fold(0.0f32, f32::max);
                    let own = h.iter().position(|x| *x > 0.3 * top).unwrap_or(n);
                    let n = if own < MARGIN + 4 {
                        n
                    } else {
                        n.min(own - MARGIN)
                    };
                    before_light(&h[..n]) as f32
                }
            })
            .collect();
        let padding = padding(&totals, m.width());
        let shared = |part: &[f32], counts: bool| {
            let part = part
                .iter()
                .enumerate()
                .filter(|(p, _)| !counts || totals[*p] > 0.0);
            let mut all: Vec<f64> = part.map(|(_, x)| f64::from(*x)).collect();
            quantile(&mut all, 0.5).unwrap_or(0.0)
        };
        let usual = shared(&dark, false);
        // The background over the gate of a pixel that counts.
        let shade = shared(&dark, true) * bins as f64;
        let shaded = shade * f64::from(gain) > LACKS.1;
        let light: Vec<f64> = (0..totals.len())
            .map(|p| totals[p] - f64::from(dark[p]) * bins as f64)
            .collect();
        let bright = quantile(&mut light.clone(), 0.9).unwrap_or(0.0).max(0.0);
        let dead: Vec<bool> = (0..totals.len())
            .map(|p| {
                let noise = (3.0 * (totals[p] * f64::from(gain)).max(0.0).sqrt()) / f64::from(gain);
                let unlit = totals[p] == 0.0
                    || totals[p] < DEAD * bright
                    || light[p] < DEAD * bright - noise;
                unlit && !padding[p] && (!shaded || totals[p] < LACKS.0 * shade)
            })
            .collect();
        let hot: Vec<bool> = (0..totals.len())
            .map(|p| {
                let own = f64::from(dark[p]);
                let scatter = 5.0 * (usual / (dark_bins.max(1) as f64 * f64::from(gain))).sqrt();
                let share = own * bins as f64 / totals[p].max(1e-300);
                !dead[p] && share > HOT[0] && own > HOT[1] * usual + scatter
            })
            .collect();
        let good = |p: &usize| !dead[*p] && !hot[*p] && !padding[*p];
        let mut lit: Vec<f64> = (0..totals.len()).filter(good).map(|p| light[p]).collect();
        let (pulses, lost) = pile_up(m, counts, &dead, &hot);
        let cut = Lit {
            histogram: h,
            bins,
            tops: &tops,
            dark: (dark_bins > 0).then_some(&dark),
            gain: f64::from(gain),
        };
        Self {
            cut: cut.cut(),
            ceiling: counts.then(|| ceiling(cells)).flatten(),
            light: quantile(&mut lit, 0.5).unwrap_or(0.0),
            dead,
            padding,
            shade: shaded,
            counts,
            hot,
            dark,
            dark_bins,
            gain,
            pulses,
            lost,
        }
    }

    /// The background of a pixel in the histogram of one spot, per bin.
    pub fn dark_of_spot(&self, h: &[f32], bins: usize) -> Vec<f32> {
        let n = self.dark_bins;
        h.chunks(bins)
            .map(|h| match n {
                0 => 0.0,
                n => (sum(&h[..n]) / n as f64) as f32,
            })
            .collect()
    }
}

/// Returns the background of bins before the usual light: their mean, unless most of it is in a few
/// of them, as the light of a near object is.
fn before_light(h: &[f32]) -> f64 {
    let mean = sum(h) / h.len() as f64;
    let part = (h.len() / PARTS).max(1);
    let parts = h.chunks_exact(part);
    let mut parts: Vec<f64> = parts.map(|h| sum(h) / part as f64).collect();
    let usual = quantile(&mut parts, 0.5).unwrap_or(mean);
    // Few counts are uneven by chance.
    let uneven = usual < UNEVEN.0 * mean && sum(h) > UNEVEN.1;
    if uneven { usual } else { mean }
}

fn sum(h: &[f32]) -> f64 {
    h.iter().map(|x| f64::from(*x)).sum()
}

/// Whole rows and columns without any count, from the image's edges inwards: padding.
fn padding(totals: &[f64], width: usize) -> Vec<bool> {
    let height = totals.len() / width;
    let empty_row = |v: &usize| totals[v * width..(v + 1) * width].iter().all(|t| *t == 0.0);
    let empty_column = |u: &usize| (0..height).all(|v| totals[v * width + u] == 0.0);
    let top = (0..height).take_while(empty_row).count();
    let left = (0..width).take_while(empty_column).count();
    if top == height {
        return vec![false; totals.len()];
    }
    let bottom = height - (0..height).rev().take_while(empty_row).count();
    let right = width - (0..width).rev().take_while(empty_column).count();
    let inside =
        |p: usize| (top..bottom).contains(&(p / width)) && (left..right).contains(&(p % width));
    (0..totals.len()).map(|p| !inside(p)).collect()
}

/// The number of bins before any light, and a bright bin of each pixel.
fn first_light(h: &[f32], bins: usize) -> (usize, Vec<f64>) {
    let tops: Vec<f64> = h
        .par_chunks(bins)
        .map(|h| {
            let mut all = h.to_vec();
            let rank = RANK.min(bins) - 1;
            f64::from(*all.select_nth_unstable_by(rank, |a, b| b.total_cmp(a)).1)
        })
        .collect();
    let mut profile = vec![0.0; bins];
    for (h, top) in h.chunks(bins).zip(&tops) {
        for (sum, x) in profile.iter_mut().zip(h) {
            *sum += f64::from(*x).min(*top);
        }
    }
    let windows = profile.windows(4).map(|w| w.iter().sum::<f64>() / 4.0);
    let base = windows.fold(f64::INFINITY, f64::min);
    let top = profile.iter().copied().fold(0.0, f64::max);
    let noise = 6.0 * base.max(0.0).sqrt();
    let least = base + (RISE * (top - base)).max(noise);
    let first = profile.iter().position(|x| *x > least).unwrap_or(0);
    let dark = first.saturating_sub(BEFORE);
    (if dark < 4 { 0 } else { dark }, tops)
}

/// Returns the least difference between two values of a sample, zero among them. Differences that
/// rounding to 32 bits explains do not count.
fn step(cells: &[f32]) -> f64 {
    const SAMPLE: usize = 200_000;
    // Odd, so that not the same bins are read in every histogram.
    let each = (cells.len() / SAMPLE) | 1;
    let sample = cells.iter().step_by(each).map(|x| f64::from(*x));
    let mut values: Vec<f64> = sample.filter(|x| x.is_finite() && *x > 0.0).collect();
    values.push(0.0);
    values.sort_by(f64::total_cmp);
    let pairs = values.windows(2).map(|w| (w[1] - w[0], w[1]));
    let steps = pairs.filter(|(step, value)| *step > 1e-5 * value);
    steps.map(|(step, _)| step).fold(f64::INFINITY, f64::min)
}

/// The greatest count, if many bins hold exactly it.
fn ceiling(cells: &[f32]) -> Option<(f32, usize)> {
    let most = cells.iter().copied().fold(0.0f32, f32::max);
    let held = cells.iter().filter(|x| **x == most).count();
    let near = RARE.1 * most..most;
    let below = || cells.iter().filter(|x| near.contains(*x)).count();
    let heaped = most >= RARE.0 || held > below();
    (most >= CEILING.0 && held >= CEILING.1 && heaped).then_some((most, held))
}

/// Pulses of a histogram and the share of photons that the median pixel loses. A pixel that records
/// one photon a pulse counts at most so many, so that the brightest pixels, those of the returns,
/// all have the same total.
fn pile_up(m: &Measurement, counts: bool, dead: &[bool], hot: &[bool]) -> (Option<u64>, f64) {
    let (bins, pixels) = (m.bins(), m.pixels());
    let histograms = m.per_spot.unwrap_or(m.capture.histogram);
    if !counts {
        return (None, 0.0);
    }
    let mut totals: Vec<f64> = histograms.par_chunks(bins).map(sum).collect();
    for (k, total) in totals.iter_mut().enumerate() {
        if dead[k % pixels] || hot[k % pixels] {
            *total = 0.0;
        }
    }
    let mut brightest: Vec<f64> = match m.per_spot {
        Some(_) => totals
            .chunks(pixels)
            .map(|t| t.iter().copied().fold(0.0, f64::max))
            .collect(),
        None => {
            let mut all = totals.clone();
            all.sort_by(|a, b| b.total_cmp(a));
            all.truncate(m.capture.spots.len());
            all
        }
    };
    brightest.sort_by(f64::total_cmp);
    let (half, most) = (
        brightest[brightest.len() / 2],
        brightest[brightest.len() - 1],
    );
    let level = brightest.len() >= 4 && half >= 100.0 && most - half <= LEVEL * half;
    let pulses = match m.pulses {
        Some(n) => n as f64,
        None if level => most,
        None => return (None, 0.0),
    };
    let mut seen: Vec<f64> = totals.into_iter().filter(|t| *t > 0.0).collect();
    let usual = quantile(&mut seen, 0.5).unwrap_or(0.0) / pulses;
    let arrived = -libm::log((1.0 - usual).max(1e-6));
    (Some(pulses as u64), 1.0 - usual / arrived.max(1e-12))
}

/// Corrects the pile-up of one pixel: Coates, J. Phys. E 1, 878 (1968). Bins after every pulse has
/// been used hold nothing.
pub(crate) fn unpile(h: &mut [f32], pulses: u64) {
    let pulses = pulses as f64;
    let mut left = pulses;
    for x in h {
        let seen = f64::from(*x);
        let share = if left > 0.0 { seen / left } else { 0.0 };
        // The last pulses say nothing of what would have come.
        *x = (pulses * -libm::log1p(-share.min(0.99))) as f32;
        left -= seen;
    }
}

#[cfg(test)]
mod tests {
    use super::{step, unpile};

    #[test]
    fn coates_correction_returns_the_arriving_photons() {
        let arriving = [0.3f64, 0.0, 0.9, 0.2];
        let pulses = 1e6;
        let mut left = pulses;
        let mut seen: Vec<f32> = arriving
            .iter()
            .map(|a| {
                let detected = left * (1.0 - (-a).exp());
                left -= detected;
                detected as f32
            })
            .collect();
        unpile(&mut seen, pulses as u64);
        for (x, a) in seen.iter().zip(arriving) {
            assert!((f64::from(*x) / pulses - a).abs() < 1e-4, "{x} {a}");
        }
    }

    #[test]
    fn photons_in_any_unit_and_code_have_steps_and_smooth_light_has_none() {
        let counts: Vec<f32> = (0..5_000u32).map(|n| (n * 7919 % 61) as f32).collect();
        let scaled: Vec<f32> = counts.iter().map(|n| n * 0.37).collect();
        assert!((step(&scaled) - 0.37).abs() < 1e-4);
        let code = |n: &f32| ((10.0 * n.sqrt()).round() / 10.0).powi(2);
        let coded: Vec<f32> = counts.iter().map(code).collect();
        assert!((0.5..=1.0).contains(&step(&coded)), "{}", step(&coded));
        let bright: Vec<f32> = counts.iter().map(|n| (n + 400.0) * 0.37).collect();
        assert!((step(&bright) - 0.37).abs() < 1e-3);
        let smooth: Vec<f32> = (0..5_000u32)
            .map(|n| (n as f32 * 0.7).sin().abs())
            .collect();
        assert!(step(&smooth) < 1e-3);
    }
}
