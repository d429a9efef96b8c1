//! The gate, and what one pixel collects.

use crate::api::{Gate, Overflow};

/// A sparse histogram of one path or sample: contributions by bin, and what fell outside the gate.
#[derive(Debug, Default)]
pub(crate) struct Sparse {
    /// (bin, value); a bin may occur more than once.
    pub entries: Vec<(u32, f32)>,
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

impl Sparse {
    /// Adds `value` at path length `path_m`.
    #[inline]
    pub fn add(&mut self, gate: &Gate, path_m: f64, value: f32) {
        match gate.bin(path_m) {
            Some(b) => self.entries.push((b, value)),
            None => {
                self.outside += 1;
                self.outside_energy += f64::from(value);
            }
        }
    }

    /// Sums entries of equal bin, so that each bin occurs once.
    pub fn merge(&mut self) {
        let e = &mut self.entries;
        let mut kept = 0;
        for i in 0..e.len() {
            let (bin, value) = e[i];
            match e[..kept].iter_mut().find(|x| x.0 == bin) {
                Some(x) => x.1 += value,
                None => {
                    e[kept] = (bin, value);
                    kept += 1;
                }
            }
        }
        e.truncate(kept);
    }
}

/// One pixel's histogram with the sum of squares that gives its standard error.
#[derive(Debug)]
pub(crate) struct Pixel {
    /// Σ of contributions by bin.
    pub sum: Vec<f32>,
    /// Σ of squares of one path's (or one pair of strata's) contribution by bin.
    pub square: Vec<f32>,
    /// Σ over paths of (whole path's energy)².
    pub total_square: f64,
}

impl Pixel {
    pub fn new(bins: usize) -> Self {
        Self {
            sum: vec![0.0; bins],
            square: vec![0.0; bins],
            total_square: 0.0,
        }
    }

    pub fn clear(&mut self) {
        self.sum.fill(0.0);
        self.square.fill(0.0);
        self.total_square = 0.0;
    }

    /// Adds one path.
    pub fn add(&mut self, path: &mut Sparse) {
        path.merge();
        let mut total = 0.0f64;
        for &(b, v) in &path.entries {
            self.sum[b as usize] += v;
            self.square[b as usize] += v * v;
            total += f64::from(v);
        }
        self.total_square += total * total;
        path.entries.clear();
    }

    /// Adds two neighbouring strata: their difference estimates the variance within strata (collapsed
    /// strata; never too small on average).
    pub fn add_pair(&mut self, a: &mut Sparse, b: &mut Sparse) {
        let mut total = 0.0f64;
        for &(bin, v) in a.entries.iter().chain(&b.entries) {
            self.sum[bin as usize] += v;
        }
        for &(bin, v) in &b.entries {
            a.entries.push((bin, -v));
        }
        a.merge();
        for &(bin, v) in &a.entries {
            self.square[bin as usize] += v * v;
            total += f64::from(v);
        }
        self.total_square += total * total;
        a.entries.clear();
        b.entries.clear();
    }
}

impl Overflow {
    /// Adds what a sparse histogram left outside, divided by `samples`, and forgets it there.
    pub(crate) fn take(&mut self, s: &mut Sparse, samples: u32) {
        self.count += s.outside;
        self.energy += s.outside_energy / f64::from(samples);
        s.outside = 0;
        s.outside_energy = 0.0;
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
