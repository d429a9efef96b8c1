//! The gate as an array of slots, and the histograms that pixels accumulate in it.

use crate::{
    api::{Gate, Overflow},
    film::class::{CLASSES, Connection, PathPlace, class},
};

/// The layout of histograms while they are filled. A *channel* is one histogram: channel 0 is of
/// all spots, each further one of a group of spots. A channel has one *slot* for each bin, one in
/// front for light before the gate, and one behind for light after it.
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
    /// Returns a film for a gate and `groups` groups of spots; `of_spot` has those of each emitter.
    pub fn new(gate: &Gate, groups: usize, of_spot: Vec<Vec<u16>>) -> Self {
        Self {
            gate: *gate,
            slots: gate.bins as usize + 2,
            channels: 1 + groups,
            of_spot,
            by_class: false,
        }
    }

    /// Returns a film with a channel for each class of paths.
    pub fn by_class(gate: &Gate) -> Self {
        let of_class = (0..CLASSES).map(|c| vec![1 + c as u16]).collect();
        Self {
            by_class: true,
            ..Self::new(gate, CLASSES, of_class)
        }
    }

    /// Returns the index that a contribution is filed under: its spot, or its class.
    #[inline]
    pub fn tag(&self, spot: usize, place: PathPlace, way: Connection) -> usize {
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
