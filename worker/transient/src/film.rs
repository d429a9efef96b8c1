//! The gate, and what one pixel collects.

use crate::api::{Gate, Overflow};

/// Contributions of one independent unit (a batch of paths, or a pair of strata) to one pixel, by bin.
#[derive(Debug)]
pub(crate) struct Unit {
    value: Vec<f32>,
    touched: Vec<u32>,
    /// Contributions outside the gate.
    pub outside: u64,
    /// Their sum.
    pub outside_energy: f64,
}

impl Gate {
    /// ℓ_max, metres.
    pub fn end_m(&self) -> f64 {
        self.start_m + self.bin_width_m * f64::from(self.bins)
    }

    /// bin(ℓ) = floor((ℓ − ℓ_min)/Δ); `None` outside the gate.
    #[inline]
    pub fn bin(&self, path_m: f64) -> Option<u32> {
        let b = (path_m - self.start_m) / self.bin_width_m;
        // `as` would turn negatives and NaN into bin 0.
        (b >= 0.0 && b < f64::from(self.bins)).then_some(b as u32)
    }
}

impl Unit {
    pub fn new(bins: u32) -> Self {
        Self {
            value: vec![0.0; bins as usize],
            touched: vec![],
            outside: 0,
            outside_energy: 0.0,
        }
    }

    /// Adds `value` at path length `path_m`. `sign` is −1 for the second stratum of a pair: then the
    /// unit holds the pair's difference, from which the variance follows.
    #[inline]
    pub fn add(&mut self, gate: &Gate, path_m: f64, value: f32, sign: f32, pixel: &mut Pixel) {
        match gate.bin(path_m) {
            Some(b) => {
                let b = b as usize;
                pixel.sum[b] += value;
                if self.value[b] == 0.0 {
                    self.touched.push(b as u32);
                }
                self.value[b] += sign * value;
            }
            None => {
                self.outside += 1;
                self.outside_energy += f64::from(value);
            }
        }
    }

    /// Ends the unit: its squares go to `pixel`.
    pub fn finish(&mut self, pixel: &mut Pixel) {
        let mut total = 0.0f64;
        for b in self.touched.drain(..) {
            let v = std::mem::take(&mut self.value[b as usize]);
            pixel.square[b as usize] += v * v;
            total += f64::from(v);
        }
        pixel.total_square += total * total;
    }
}

/// One pixel's histogram with the sum of squares that gives its standard error.
#[derive(Debug)]
pub(crate) struct Pixel {
    /// Σ of contributions by bin.
    pub sum: Vec<f32>,
    /// Σ over units of (contribution by bin)².
    pub square: Vec<f32>,
    /// Σ over units of (all contributions)².
    pub total_square: f64,
}

impl Pixel {
    pub fn new(bins: u32) -> Self {
        Self {
            sum: vec![0.0; bins as usize],
            square: vec![0.0; bins as usize],
            total_square: 0.0,
        }
    }

    pub fn clear(&mut self) {
        self.sum.fill(0.0);
        self.square.fill(0.0);
        self.total_square = 0.0;
    }
}

impl Overflow {
    /// Adds what a unit left outside, divided by `samples`, and forgets it there.
    pub(crate) fn take(&mut self, unit: &mut Unit, samples: u32) {
        self.count += unit.outside;
        self.energy += unit.outside_energy / f64::from(samples);
        unit.outside = 0;
        unit.outside_energy = 0.0;
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
    }
}
