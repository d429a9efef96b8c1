//! The histogram of one pixel as peaks over a slow background.

use crate::Settings;

/// Fewest bins from which ambient light is estimated.
const FEWEST: usize = 8;
/// Standard deviations of ambient light that do not count as light of the laser.
const SIGMAS: f32 = 4.0;

/// The histogram of one pixel, separated into a slow background and peaks.
#[derive(Debug, Clone, Default)]
pub struct Peaks {
    /// Slow background of each bin: an opening, smoothed.
    pub slow: Vec<f32>,
    /// A strong bin: the n-th greatest, so that a one-bounce return counts for nothing.
    pub top: f32,
    /// How much a bin stands out: log((h + floor)/(slow + floor)) within limits.
    pub out: Vec<f32>,
    /// The first bin with light.
    pub first: usize,
    sorted: Vec<f32>,
    wide: Vec<f32>,
}

impl Peaks {
    /// Background, strong bin, and what stands out.
    pub fn find(&mut self, h: &[f32], reach: usize, spots: usize, settings: &Settings) {
        self.background(h, reach, spots, settings);
        let floor = settings.floor * self.top;
        self.out.clear();
        self.out
            .extend(h.iter().zip(&self.slow).map(|(x, s)| match floor > 0.0 {
                true if *x > *s => libm::logf((x + floor) / (s + floor)).min(settings.most_out),
                _ => 0.0,
            }));
    }

    /// The first bin by which a share of all light has come, beyond the noise of ambient light.
    /// No light of the laser can be in the first `quiet` bins, which show the ambient light.
    pub fn earliest(&mut self, h: &[f32], share: f32, quiet: usize) {
        let (ambient, variance) = ambient(&h[..quiet.min(h.len())]);
        let light = |x: &f32| x.min(self.top) - ambient;
        let total: f32 = h.iter().map(light).sum();
        let mut sum = 0.0;
        let first = h.iter().enumerate().position(|(k, x)| {
            sum += light(x);
            sum > share * total + SIGMAS * (variance * (k + 1) as f32).sqrt()
        });
        self.first = first.unwrap_or(h.len());
    }

    /// Background and strong bin alone.
    pub fn background(&mut self, h: &[f32], reach: usize, spots: usize, settings: &Settings) {
        self.sorted.clear();
        self.sorted.extend_from_slice(h);
        slide(h, &mut self.slow, reach, f32::min);
        slide(&self.slow, &mut self.wide, reach, f32::max);
        mean(&self.wide, &mut self.slow, reach);
        for (s, x) in self.slow.iter_mut().zip(h) {
            *s = s.min(*x);
        }
        let rank = settings.top_rank.min(spots.div_ceil(2)).clamp(1, h.len()) - 1;
        let by_size = |a: &f32, b: &f32| b.total_cmp(a);
        self.top = *self.sorted.select_nth_unstable_by(rank, by_size).1;
    }
}

/// Mean and variance of the bins before any light of the laser; zero if there are too few.
fn ambient(quiet: &[f32]) -> (f32, f32) {
    if quiet.len() < FEWEST {
        return (0.0, 0.0);
    }
    let n = quiet.len() as f32;
    let mean = quiet.iter().sum::<f32>() / n;
    let squares = quiet.iter().map(|x| (x - mean) * (x - mean)).sum::<f32>();
    (mean, squares / n)
}

/// The least or greatest of each bin's neighbours.
fn slide(from: &[f32], to: &mut Vec<f32>, reach: usize, pick: fn(f32, f32) -> f32) {
    to.clear();
    to.extend_from_slice(from);
    let n = from.len();
    for d in 1..=reach.min(n - 1) {
        for k in 0..n - d {
            to[k] = pick(to[k], from[k + d]);
            to[k + d] = pick(to[k + d], from[k]);
        }
    }
}

/// The mean of each bin's neighbours.
fn mean(from: &[f32], to: &mut Vec<f32>, reach: usize) {
    let n = from.len();
    to.clear();
    let mut sum = 0.0f64;
    for x in &from[..reach.min(n)] {
        sum += f64::from(*x);
    }
    for k in 0..n {
        if k + reach < n {
            sum += f64::from(from[k + reach]);
        }
        if k > reach {
            sum -= f64::from(from[k - reach - 1]);
        }
        let count = (k + reach + 1).min(n) - k.saturating_sub(reach);
        to.push((sum / count as f64).max(0.0) as f32);
    }
}
