//! The return of one spot at a pixel, and the times that both methods share.

use picofarm_settings::Gate;

use crate::geometry::Source;

/// Metres of path in the published bins of 8 ps, to which the published thresholds refer.
pub const UNIT_M: f64 = 8e-12 * 299_792_458.0;
/// Path by which a pulse may rise before its peak, metres.
const RISE_M: f64 = 0.06;
/// Fewest bins from which the background follows.
const FEWEST: usize = 8;

/// The two-bounce return of a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Return {
    /// Whether there is one.
    pub lit: bool,
    /// Its path, metres.
    pub path_m: f32,
    /// Its energy, in the histogram's unit or in photons.
    pub energy: f32,
    /// Variance of its path, m².
    pub variance_m2: f32,
}

impl Return {
    pub const NONE: Self = Self {
        lit: false,
        path_m: 0.0,
        energy: 0.0,
        variance_m2: 0.0,
    };
}

/// The gate, and when light of a spot can arrive.
#[derive(Debug, Clone, Copy)]
pub struct Timing {
    pub gate: Gate,
    /// Bins before any light of the spot: no path is shorter than laser, spot, camera.
    pub quiet: usize,
    /// Path of the one-bounce return, metres.
    pub one_bounce_m: f64,
}

impl Timing {
    pub fn new(gate: &Gate, source: &Source) -> Self {
        let one_bounce_m = f64::from(source.path_m) + f64::from(source.square).sqrt();
        let quiet = (one_bounce_m - RISE_M - gate.start_m) / gate.bin_width_m;
        Self {
            gate: *gate,
            quiet: quiet.clamp(0.0, f64::from(gate.bins)) as usize,
            one_bounce_m,
        }
    }

    /// Returns the number of bins of the gate in so many published ones.
    pub fn bins(&self, published: f64) -> f64 {
        published * UNIT_M / self.gate.bin_width_m
    }

    /// Returns the mean of the quiet bins; 0 if there are too few.
    pub fn background(&self, h: &[f32]) -> f32 {
        match self.quiet >= FEWEST {
            true => h[..self.quiet].iter().sum::<f32>() / self.quiet as f32,
            false => 0.0,
        }
    }
}

/// Returns the pixel with the brightest bin, and that bin.
pub fn brightest(histogram: &[f32], bins: usize) -> (usize, usize) {
    let mut best = (0, f32::NEG_INFINITY);
    for (at, x) in histogram.iter().enumerate() {
        if *x > best.1 {
            best = (at, *x);
        }
    }
    (best.0 / bins, best.0 % bins)
}
