//! A finished tile: its sums, variances and draws of its error.

use crate::{
    api::Overflow,
    film::slots::Film,
    render::{
        draws::{Draw, Watched},
        pooling::{MULTI_REACH, Pool, pool, shut_out},
        region::Region,
        spread::Spread,
    },
};

/// A finished tile, in render units.
#[derive(Debug, Default)]
pub(crate) struct Done {
    /// Σ over passes of the 3+ part, slots by pixel.
    pub sum: Vec<f32>,
    /// Σ over passes of the square of the 3+ part, channel 0.
    pub square: Vec<f32>,
    /// Σ over passes with alternating sign, channel 0; empty if not requested.
    pub alternating: Vec<f32>,
    /// Variance of the mean of the 3+ part, channel 0, pooled.
    pub multi_variance: Vec<f32>,
    /// Mean of the two-bounce part.
    pub two: Vec<f32>,
    /// Variance of `two`, channel 0.
    pub two_variance: Vec<f32>,
    /// A draw of the error of `two`, channel 0; empty if not requested.
    pub two_noise: Vec<f32>,
    /// Variance of the sum over slots of the two-bounce mean.
    pub two_total_variance: Vec<f64>,
    /// Sums over the gate's slots of both parts' variances by pixel, before pooling. A sum over so
    /// many slots is precise enough by itself, and pooling would spread the noise of bright pixels
    /// to dim ones.
    pub pixel_variance: Vec<(f64, f64)>,
    pub watched: Watched,
    /// Energy of the whole tile by pass.
    pub all: Vec<f64>,
    pub pooling: Pool,
    pub passes: u32,
    /// All rays, and those of two bounces.
    pub rays: u64,
    pub two_rays: u64,
}

/// Means and variances of one channel-0 slot of one pixel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moments {
    pub two: f64,
    pub two_variance: f64,
    pub multi: f64,
    pub multi_variance: f64,
}

/// Returns the mean and its variance from Σx and Σx² over `n` passes.
fn mean(sum: f64, square: f64, n: f64) -> (f64, f64) {
    if n == 0.0 {
        return (0.0, 0.0);
    }
    let spread = if n > 1.0 {
        (square - sum * sum / n).max(0.0) / (n - 1.0)
    } else {
        square
    };
    (sum / n, spread / n)
}

/// Returns the sum over the gate's slots.
pub(crate) fn inside(film: &Film, slots: &[f32]) -> f64 {
    slots[1..film.slots - 1].iter().map(|&v| f64::from(v)).sum()
}

impl Done {
    pub fn reset(&mut self, film: &Film, region: &Region, split: bool) {
        let pixels = region.pixels();
        let zero = |v: &mut Vec<f32>, n: usize| {
            v.clear();
            v.resize(n, 0.0);
        };
        zero(&mut self.sum, pixels * film.pixel());
        zero(&mut self.square, pixels * film.slots);
        zero(
            &mut self.alternating,
            if split { pixels * film.slots } else { 0 },
        );
        zero(&mut self.two, pixels * film.pixel());
        zero(&mut self.two_variance, pixels * film.slots);
        zero(
            &mut self.two_noise,
            if split { pixels * film.slots } else { 0 },
        );
        self.two_total_variance.clear();
        self.two_total_variance.resize(pixels, 0.0);
        self.pixel_variance.clear();
        self.pixel_variance.resize(pixels, (0.0, 0.0));
        self.watched.reset(region, film.slots);
        self.all.clear();
        self.passes = 0;
    }

    /// Returns the sum of the two-bounce and 3+ means of any channel's slot of pixel `k`.
    pub fn value(&self, film: &Film, k: usize, channel: usize, slot: usize) -> f64 {
        let at = k * film.pixel() + channel * film.slots + slot;
        let n = f64::from(self.passes.max(1));
        f64::from(self.two[at]) + f64::from(self.sum[at]) / n
    }

    /// Returns the means and variances of a slot of pixel `k`, channel 0.
    pub fn moments(&self, film: &Film, k: usize, slot: usize) -> Moments {
        let (wide, narrow) = (k * film.pixel() + slot, k * film.slots + slot);
        let n = f64::from(self.passes.max(1));
        Moments {
            two: f64::from(self.two[wide]),
            two_variance: f64::from(self.two_variance[narrow]),
            multi: f64::from(self.sum[wide]) / n,
            multi_variance: f64::from(self.multi_variance[narrow]),
        }
    }

    /// Returns a draw of the 3+ part's error in a slot of pixel `k`, channel 0, including the
    /// correlations between pixels and bins; 0 with fewer than two passes.
    pub fn noise(&self, film: &Film, k: usize, slot: usize) -> f64 {
        let pairs = f64::from(self.passes / 2 * 2);
        let x = f64::from(self.alternating[k * film.slots + slot]);
        // Σ±x over n passes has n times the variance of a pass; the mean has 1/n of it.
        x / (pairs * f64::from(self.passes)).sqrt().max(1.0)
    }

    /// Like `noise`, for the two-bounce part.
    pub fn two_noise(&self, film: &Film, k: usize, slot: usize) -> f64 {
        f64::from(self.two_noise[k * film.slots + slot])
    }

    /// Updates the variances to the completed passes.
    pub fn estimate(&mut self, film: &Film, region: &Region) {
        let n = f64::from(self.passes);
        self.multi_variance.clear();
        for (sum, square) in self
            .sum
            .chunks(film.pixel())
            .zip(self.square.chunks(film.slots))
        {
            let both = sum[..film.slots].iter().zip(square);
            self.multi_variance.extend(
                both.map(|(&sum, &square)| mean(f64::from(sum), f64::from(square), n).1 as f32),
            );
        }
        shut_out(&mut self.multi_variance, film.slots);
        for (out, v) in self
            .pixel_variance
            .iter_mut()
            .zip(self.multi_variance.chunks(film.slots))
        {
            out.1 = inside(film, v);
        }
        let (variance, pooling) = (&mut self.multi_variance, &mut self.pooling);
        pool(variance, region, film.slots, MULTI_REACH, pooling);
    }

    /// Returns Σ over the gate's slots of both parts' variances in pixel `k`.
    pub fn pixel_variance(&self, k: usize) -> (f64, f64) {
        self.pixel_variance[k]
    }

    /// Returns draws of the errors of the watched pixels' 3+ part.
    pub fn draws(&self) -> Vec<Draw> {
        self.watched
            .draws(self.passes, |k| self.pixel_variance[k].1)
    }

    /// Returns ‖draw of the error of the watched pixels' two-bounce part‖².
    pub fn two_draws(&self) -> Vec<f64> {
        self.watched.two_draws()
    }

    /// Returns the indices of the watched pixels.
    pub fn watched(&self) -> &[usize] {
        self.watched.pixels()
    }

    /// Returns the tile's energy of three bounces and more, and its spread. Pixels that share
    /// vertices have correlated errors, so this is not the sum of their spreads.
    pub fn multi_energy(&self) -> (f64, Spread) {
        let n = f64::from(self.passes.max(1));
        (self.all.iter().sum::<f64>() / n, Spread::of(&self.all))
    }

    /// Returns the variance of the tile's energy of two bounces.
    pub fn two_energy_variance(&self) -> f64 {
        self.two_total_variance.iter().sum()
    }

    /// Returns the energy outside the gate, of two bounces and of more bounces.
    pub fn overflow(&self, film: &Film) -> (f64, f64) {
        let (mut two, mut multi) = (Overflow::default(), Overflow::default());
        let n = f64::from(self.passes.max(1));
        for (sum, of_two) in self
            .sum
            .chunks(film.pixel())
            .zip(self.two.chunks(film.pixel()))
        {
            multi.take(film, sum, 1.0 / n);
            two.take(film, of_two, 1.0);
        }
        (two.energy, multi.energy)
    }

    /// Returns the two-bounce means of all slots, pixel by pixel.
    pub fn two(&self) -> &[f32] {
        &self.two
    }

    /// Returns the 3+ mean of any channel's slot of pixel `k`.
    pub fn multi(&self, film: &Film, k: usize, channel: usize, slot: usize) -> f64 {
        let at = k * film.pixel() + channel * film.slots + slot;
        f64::from(self.sum[at]) / f64::from(self.passes.max(1))
    }
}
