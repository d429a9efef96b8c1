//! The square-root code: photon counts as 16-bit codes with an error proportional to the photon
//! noise, its error statistics, and the choice of a scene's photon scale.
//!
//! All arithmetic is IEEE single precision in a fixed order, so that the same histogram gives the
//! same codes on every machine, and numpy's float32 decodes to the same bits.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// The code of a saturated bin. Its exact value is in the manifest's overflow list.
pub const SATURATED: u16 = u16::MAX;

/// The square-root code with step Δ.
#[derive(Debug, Clone, Copy)]
pub struct SquareRoot {
    delta: f32,
    scale: f32,
}

impl SquareRoot {
    /// Returns the code with step Δ (see [`crate::Profile`]) and `scale` photons per unit of h.
    ///
    /// ```
    /// use picofarm_dataset::SquareRoot;
    ///
    /// // 100 photons have a standard deviation of 10; with Δ = 0.2 the error is a tenth of it.
    /// let code = SquareRoot::new(0.2, 1.0);
    /// assert!((code.decode(code.encode(100.3)) - 100.3).abs() < 1.1);
    /// ```
    pub fn new(delta: f32, scale: f32) -> Self {
        Self { delta, scale }
    }

    /// Encodes h, which must be finite and not negative. Returns [`SATURATED`] if 16 bits do not
    /// suffice (above 4.3·10⁷ photons at Δ = 0.2).
    #[inline]
    pub fn encode(self, h: f32) -> u16 {
        let q = (h * self.scale).sqrt() * (2.0 / self.delta) + 0.5;
        // The cast floors and saturates: every value from 65535.0 upwards becomes SATURATED.
        q as u16
    }

    /// Returns the number of photons of a code.
    #[inline]
    pub fn photons(self, q: u16) -> f32 {
        let root = f32::from(q) * (self.delta * 0.5);
        root * root
    }

    /// Returns h of a code other than [`SATURATED`].
    #[inline]
    pub fn decode(self, q: u16) -> f32 {
        self.photons(q) / self.scale
    }

    /// Encodes `h` into `q` and adds the errors to `error`. Returns whether a bin saturated and
    /// whether all values were valid (finite and not negative).
    pub(crate) fn encode_run(self, h: &[f32], q: &mut [u16], error: &mut ErrorSums) -> RunFacts {
        const LANES: usize = 8;
        let mut invalid = [false; LANES];
        let mut saturated = [false; LANES];
        let mut squares = [0.0f32; LANES];
        let mut worst = [0.0f32; LANES];
        let mut one = |lane: usize, h: f32, q: &mut u16| {
            *q = self.encode(h);
            let n = h * self.scale;
            let sat = *q == SATURATED;
            let difference = if sat { 0.0 } else { self.photons(*q) - n };
            // In units of σ² = max(N, 1).
            let square = difference * difference / n.max(1.0);
            invalid[lane] |= !(0.0..=f32::MAX).contains(&h);
            saturated[lane] |= sat;
            squares[lane] += square;
            worst[lane] = worst[lane].max(square);
        };
        let whole = h.len() / LANES * LANES;
        for (h, q) in h[..whole]
            .chunks_exact(LANES)
            .zip(q[..whole].chunks_exact_mut(LANES))
        {
            for lane in 0..LANES {
                one(lane, h[lane], &mut q[lane]);
            }
        }
        for (h, q) in h[whole..].iter().zip(&mut q[whole..]) {
            one(0, *h, q);
        }
        for lane in 0..LANES {
            error.squares += f64::from(squares[lane]);
            error.worst = error.worst.max(worst[lane]);
        }
        error.count += h.len() as u64;
        RunFacts {
            invalid: invalid.contains(&true),
            saturated: saturated.contains(&true),
        }
    }

    /// Decodes `q` into `h`; saturated codes become +∞ until the overflow list is applied. Returns
    /// whether there are any.
    pub(crate) fn decode_run(self, q: &[u16], h: &mut [f32]) -> bool {
        let mut top = 0;
        for (q, h) in q.iter().zip(h) {
            top = top.max(*q);
            *h = if *q == SATURATED {
                f32::INFINITY
            } else {
                self.decode(*q)
            };
        }
        top == SATURATED
    }
}

/// Properties of a run of values.
pub(crate) struct RunFacts {
    pub invalid: bool,
    pub saturated: bool,
}

/// Sums of squared coding errors in units of σ².
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ErrorSums {
    squares: f64,
    worst: f32,
    count: u64,
}

impl ErrorSums {
    /// Adds a value of `n` photons with the stored value `stored`.
    pub fn add_value(&mut self, n: f32, stored: f32) {
        let square = (stored - n) * (stored - n) / n.max(1.0);
        self.squares += f64::from(square);
        self.worst = self.worst.max(square);
        self.count += 1;
    }

    /// Adds `count` values without error.
    pub fn add_exact(&mut self, count: usize) {
        self.count += count as u64;
    }

    pub fn add(&mut self, other: &Self) {
        self.squares += other.squares;
        self.worst = self.worst.max(other.worst);
        self.count += other.count;
    }

    /// Returns the error, with `overflowed` values in the overflow list.
    pub fn finish(&self, overflowed: usize) -> EncodeError {
        EncodeError {
            overflowed: Some(overflowed as u64),
            max_sigma: f64::from(self.worst).sqrt(),
            rms_sigma: (self.squares / self.count.max(1) as f64).sqrt(),
        }
    }
}

/// Error of a scene's encoded transient, in standard deviations of the photon noise, σ =
/// √max(N, 1).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct EncodeError {
    /// The maximum over all bins.
    pub max_sigma: f64,
    /// Root mean square over all bins.
    pub rms_sigma: f64,
    /// Number of saturated bins, which are in the overflow list. It is absent in manifests of
    /// encoder-1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub overflowed: Option<u64>,
}

/// Returns the scale (photons per unit of h) at which the median over the lit pixels of the
/// brightest bin is `photons` (400 by convention). `transient` is `[pixel][bin]`. The few pixels
/// that see a spot directly are far brighter, but do not affect the median. Returns 1 if no pixel
/// has any light.
///
/// ```
/// use picofarm_dataset::photon_scale;
///
/// // Three pixels of two bins; the median of their brightest bins is 2.
/// let transient = [1.0, 0.0, 0.5, 2.0, 8.0, 0.0];
/// assert_eq!(photon_scale(&transient, 2, 400.0), 200.0);
/// ```
pub fn photon_scale(transient: &[f32], bins: usize, photons: f32) -> f32 {
    let mut peaks: Vec<f32> = transient
        .par_chunks(bins.max(1))
        .map(|h| h.iter().copied().fold(0.0, f32::max))
        .filter(|peak| *peak > 0.0 && peak.is_finite())
        .collect();
    if peaks.is_empty() {
        return 1.0;
    }
    let middle = (peaks.len() - 1) / 2;
    let (_, median, _) = peaks.select_nth_unstable_by(middle, f32::total_cmp);
    let scale = photons / *median;
    if scale.is_finite() && scale > 0.0 {
        scale
    } else {
        1.0
    }
}

/// The greatest distance from a whole number, as a share of it and in photons, that rounding
/// explains.
const ROUNDED: (f32, f32) = (1e-5, 1e-3);

/// Returns whether all values of a histogram are whole numbers of photons, and some are not 0.
/// `scale` converts values to photons.
///
/// ```
/// use picofarm_dataset::whole_photons;
///
/// assert!(whole_photons(&[0.0, 0.5, 3.5], 2.0));
/// assert!(!whole_photons(&[0.0, 0.5, 3.4], 2.0));
/// ```
pub fn whole_photons(histogram: &[f32], scale: f32) -> bool {
    let whole = |h: &f32| {
        let photons = h * scale;
        (photons - photons.round()).abs() <= (ROUNDED.0 * photons).max(ROUNDED.1)
    };
    let some = histogram.par_iter().any(|h| h * scale >= 1.0 - ROUNDED.1);
    some && histogram.par_iter().all(whole)
}
