//! The recorded interval of time.

use serde::{Deserialize, Serialize};

/// The recorded interval of optical path length: `bins` bins of `bin_width_m` from `start_m`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Gate {
    /// ℓ_min, metres.
    pub start_m: f64,
    /// Δ, metres of path.
    pub bin_width_m: f64,
    /// B, number of bins.
    pub bins: u32,
}

impl Gate {
    /// Returns ℓ_max, metres.
    pub fn end_m(&self) -> f64 {
        self.start_m + self.bin_width_m * f64::from(self.bins)
    }

    /// Returns bin(ℓ) = floor((ℓ − ℓ_min)/Δ); `None` outside the gate.
    #[inline]
    pub fn bin(&self, path_m: f64) -> Option<u32> {
        let b = (path_m - self.start_m) / self.bin_width_m;
        // A cast with `as` would turn negative values and NaN into bin 0.
        (b >= 0.0 && b < f64::from(self.bins)).then_some(b as u32)
    }
}
