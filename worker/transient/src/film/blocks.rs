//! Two-bounce contributions of a pixel, by blocks of strata.

use crate::film::slots::Film;

/// Two-bounce contributions of one pixel: sums, and squared contrasts. In each block of 2×2 strata,
/// one stratum, chosen at random, is sampled twice. The difference of its two samples is the
/// block's contrast, scaled so that its square is an unbiased estimate of the block's variance,
/// regardless of edges within the block.
#[derive(Debug)]
pub(crate) struct Blocks {
    /// Σ of contributions, in the slots of [`Film::pixel`].
    pub sum: Vec<f32>,
    /// Σ over blocks of (contrast by slot of channel 0)².
    pub square: Vec<f32>,
    /// Σ over blocks of (contrast of the total)².
    pub total_square: f64,
    /// Σ over blocks of ± contrast by slot of channel 0; it preserves the correlation between
    /// slots.
    pub noise: Vec<f32>,
    contrast: Vec<f32>,
    touched: Vec<u32>,
}

/// √(7/4). Of four strata of variance v each, three have one sample and one has the mean of two:
/// their sum has variance 3.5 v, and the mean squared difference of the two samples is 2 v.
const CONTRAST: f32 = 1.322_875_7;

impl Blocks {
    pub fn new(film: &Film) -> Self {
        Self {
            sum: vec![0.0; film.pixel()],
            square: vec![0.0; film.slots],
            total_square: 0.0,
            noise: vec![0.0; film.slots],
            contrast: vec![0.0; film.slots],
            touched: vec![],
        }
    }

    pub fn clear(&mut self) {
        self.sum.fill(0.0);
        self.square.fill(0.0);
        self.noise.fill(0.0);
        self.total_square = 0.0;
    }

    /// Adds a contribution from the only sample of its stratum.
    #[inline]
    pub fn add(&mut self, film: &Film, slot: usize, value: f32, spot: usize) {
        film.add(&mut self.sum, slot, value, spot);
    }

    /// Adds a contribution from one of a stratum's two samples; `sign` distinguishes them.
    #[inline]
    pub fn add_half(&mut self, film: &Film, slot: usize, value: f32, sign: f32, spot: usize) {
        film.add(&mut self.sum, slot, 0.5 * value, spot);
        if self.contrast[slot] == 0.0 {
            self.touched.push(slot as u32);
        }
        self.contrast[slot] += sign * CONTRAST * value;
    }

    /// Ends a block; `sign` is the sign of its contrast in `noise`.
    pub fn finish(&mut self, sign: f32) {
        let mut total = 0.0f64;
        for b in self.touched.drain(..) {
            let v = std::mem::take(&mut self.contrast[b as usize]);
            self.square[b as usize] += v * v;
            self.noise[b as usize] += sign * v;
            total += f64::from(v);
        }
        self.total_square += total * total;
    }
}
