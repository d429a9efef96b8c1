//! The gate as an array of slots, and the histograms that pixels accumulate in it.

use crate::{
    api::{Gate, Overflow},
    sink::{CLASSES, Place, Way, class},
};

/// How histograms are laid out while they are filled. A *channel* is one histogram: channel 0 holds
/// all spots, each further one a group of spots. A channel has one *slot* a bin, with one more in
/// front for what comes before the gate and one behind for what comes after.
#[derive(Debug)]
pub(crate) struct Film {
    pub gate: Gate,
    /// Slots per channel.
    pub slots: usize,
    /// Channels per pixel.
    pub channels: usize,
    /// Channels beyond 0 that a spot counts in, by emitter.
    pub of_spot: Vec<Vec<u16>>,
    /// Whether channels beyond 0 are path classes instead of groups of spots.
    by_class: bool,
}

impl Film {
    /// A film for a gate, so many groups, and the groups that each emitter belongs to.
    pub fn new(gate: &Gate, groups: usize, of_spot: Vec<Vec<u16>>) -> Self {
        Self {
            gate: *gate,
            slots: gate.bins as usize + 2,
            channels: 1 + groups,
            of_spot,
            by_class: false,
        }
    }

    /// A film that has a channel for each class of paths.
    pub fn by_class(gate: &Gate) -> Self {
        let of_class = (0..CLASSES).map(|c| vec![1 + c as u16]).collect();
        Self {
            by_class: true,
            ..Self::new(gate, CLASSES, of_class)
        }
    }

    /// Returns the index that a contribution is filed under: its spot, or its class.
    #[inline]
    pub fn tag(&self, spot: usize, place: Place, way: Way) -> usize {
        match self.by_class {
            false => spot,
            true => class(place, way),
        }
    }

    /// Returns the number of slots of one pixel.
    pub fn pixel(&self) -> usize {
        self.slots * self.channels
    }

    /// Returns the slot of a path length.
    #[inline]
    pub fn slot(&self, path_m: f64) -> usize {
        let b = (path_m - self.gate.start_m) / self.gate.bin_width_m;
        if b >= f64::from(self.gate.bins) {
            self.slots - 1
        } else if b >= 0.0 {
            1 + b as usize
        } else {
            0
        }
    }

    /// Adds light to a pixel's channels.
    #[inline]
    pub fn add(&self, pixel: &mut [f32], slot: usize, value: f32, spot: usize) {
        pixel[slot] += value;
        if self.channels > 1 {
            self.add_to_groups(pixel, slot, value, spot);
        }
    }

    /// Adds light to the channels of groups only.
    #[inline]
    pub fn add_to_groups(&self, pixel: &mut [f32], slot: usize, value: f32, spot: usize) {
        if self.channels == 1 {
            return;
        }
        for &channel in &self.of_spot[spot] {
            pixel[usize::from(channel) * self.slots + slot] += value;
        }
    }
}

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

impl Overflow {
    /// Adds the light of a pixel outside the gate.
    pub(crate) fn take(&mut self, film: &Film, pixel: &[f32], factor: f64) {
        let outside = f64::from(pixel[0]) + f64::from(pixel[film.slots - 1]);
        self.energy += outside * factor;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_are_half_open_and_nothing_outside_is_clipped() {
        let g = Gate {
            start_m: 1.0,
            bin_width_m: 0.25,
            bins: 4,
        };
        assert_eq!(g.bin(1.0), Some(0));
        assert_eq!(g.bin(1.25), Some(1));
        assert_eq!(g.bin(1.2499999), Some(0));
        assert_eq!(g.bin(1.9999999), Some(3));
        assert_eq!(g.bin(2.0), None);
        assert_eq!(g.bin(0.999), None);
        assert_eq!(g.bin(f64::NAN), None);
        let film = Film::new(&g, 0, vec![]);
        let slots: Vec<usize> = [0.999, 1.0, 1.25, 1.2499999, 1.9999999, 2.0]
            .map(|l| film.slot(l))
            .into();
        assert_eq!(slots, [0, 1, 2, 1, 4, 5]);
    }
}
