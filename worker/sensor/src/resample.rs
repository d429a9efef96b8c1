//! Histograms on another time axis: gate, width of the bins, scale of the path.
//!
//! A bin's photons are spread evenly over its width and divided among the bins that it overlaps,
//! so none is lost or made: what falls outside the new gate is counted. Edges within a millionth
//! of a bin of each other are the same edge, so that whole bins stay whole.

use picofarm_settings::{Gate, SensorError};
use rayon::prelude::*;

use crate::bins::pixels;

/// Edges nearer than this, in new bins, are the same.
const SAME_EDGE: f64 = 1e-6;

/// A part of an old bin's photons that goes to a new bin.
#[derive(Debug, Clone, Copy)]
struct Share {
    from: u32,
    to: u32,
    part: f64,
}

/// Moves the photons of one histogram after another to the bins of another gate.
#[derive(Debug, Clone)]
pub struct Resampler {
    bins: usize,
    shares: Vec<Share>,
    /// Old bins that fall outside, in part.
    outside: Vec<(u32, f64)>,
    identity: bool,
}

/// Histograms on another time axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Resampled {
    /// `[pixel][bin]`.
    pub data: Vec<f32>,
    /// Photons outside the new gate.
    pub outside: f64,
}

impl Resampler {
    /// Prepares for histograms of the gate `from`, whose paths are multiplied by `scale` and then
    /// lengthened by `shift_m`, and bins of the gate `to`.
    ///
    /// # Errors
    /// Returns [`SensorError::Invalid`] for a scale that is not positive, and for gates without
    /// bins or with a width that is not positive.
    pub fn new(from: &Gate, to: &Gate, scale: f64, shift_m: f64) -> Result<Self, SensorError> {
        for (field, gate) in [("from", from), ("to", to)] {
            let sound = gate.start_m.is_finite() && gate.bin_width_m.is_finite();
            if !(sound && gate.bin_width_m > 0.0 && gate.bins > 0) {
                let what = format!("expected bins of a positive width, found {gate:?}");
                return Err(SensorError::new(field, what));
            }
        }
        if !(scale.is_finite() && scale > 0.0 && shift_m.is_finite()) {
            let what = format!(
                "expected a positive scale and a finite shift, found {scale} and {shift_m}"
            );
            return Err(SensorError::new("scale", what));
        }
        let edge = |k: u32| {
            let path = (from.start_m + f64::from(k) * from.bin_width_m) * scale + shift_m;
            let at = (path - to.start_m) / to.bin_width_m;
            let whole = at.round();
            match (at - whole).abs() < SAME_EDGE {
                true => whole,
                false => at,
            }
        };
        let last = f64::from(to.bins);
        let (mut shares, mut outside) = (Vec::new(), Vec::new());
        for bin in 0..from.bins {
            let (lo, hi) = (edge(bin), edge(bin + 1));
            let width = hi - lo;
            let (first, end) = (lo.clamp(0.0, last), hi.clamp(0.0, last));
            // The parts of a bin add up to 1: the last takes what the others leave.
            let mut left = 1.0;
            let gone = width - (end - first).max(0.0);
            if gone > 0.0 {
                let part = (gone / width).min(1.0);
                outside.push((bin, part));
                left -= part;
            }
            let mut at = first;
            while at < end && left > 0.0 {
                let next = (at.floor() + 1.0).min(end);
                let part = match next >= end {
                    true => left,
                    false => ((next - at) / width).min(left),
                };
                left -= part;
                shares.push(Share {
                    from: bin,
                    to: at.floor() as u32,
                    part,
                });
                at = next;
            }
        }
        let identity = from.bins == to.bins
            && outside.is_empty()
            && shares.len() == from.bins as usize
            && shares.iter().all(|s| s.from == s.to && s.part == 1.0);
        Ok(Self {
            bins: to.bins as usize,
            shares,
            outside,
            identity,
        })
    }

    /// Returns whether every histogram stays as it is.
    pub fn is_identity(&self) -> bool {
        self.identity
    }

    /// Adds a histogram to `out`, which has the new bins. Returns the photons outside of them.
    pub fn add<T: Copy + Into<f64>>(&self, h: &[T], out: &mut [f64]) -> f64 {
        for share in &self.shares {
            let photons: f64 = h[share.from as usize].into();
            out[share.to as usize] += photons * share.part;
        }
        let gone = self.outside.iter();
        gone.map(|(from, part)| {
            let photons: f64 = h[*from as usize].into();
            photons * part
        })
        .sum()
    }

    /// Returns the number of new bins.
    pub(crate) fn bins(&self) -> usize {
        self.bins
    }
}

/// Puts histograms `[pixel][bin]` of the gate `from` on the bins of the gate `to`. All paths are
/// multiplied by `scale`.
///
/// # Errors
/// Returns [`SensorError::Invalid`] if `data` is not a whole number of pixels, and for unsound
/// gates or scales.
///
/// # Examples
/// ```
/// use picofarm_sensor::resample;
/// use picofarm_settings::Gate;
///
/// let from = Gate { start_m: 1.0, bin_width_m: 0.1, bins: 4 };
/// let to = Gate { start_m: 1.1, bin_width_m: 0.2, bins: 1 };
/// let made = resample(&[1.0, 2.0, 3.0, 4.0], &from, &to, 1.0)?;
/// assert_eq!(made.data, [5.0]);
/// assert_eq!(made.outside, 5.0);
/// # Ok::<(), picofarm_sensor::SensorError>(())
/// ```
pub fn resample(
    data: &[f32],
    from: &Gate,
    to: &Gate,
    scale: f64,
) -> Result<Resampled, SensorError> {
    let bins = from.bins as usize;
    pixels(data.len(), bins)?;
    let resampler = Resampler::new(from, to, scale, 0.0)?;
    if resampler.is_identity() {
        return Ok(Resampled {
            data: data.to_vec(),
            outside: 0.0,
        });
    }
    let new = resampler.bins;
    let mut out = vec![0.0f32; data.len() / bins * new];
    let outside: Vec<f64> = out
        .par_chunks_mut(new)
        .zip(data.par_chunks(bins))
        .map_init(
            || vec![0.0f64; new],
            |sums, (out, h)| {
                sums.fill(0.0);
                let gone = resampler.add(h, sums);
                for (out, sum) in out.iter_mut().zip(sums.iter()) {
                    *out = *sum as f32;
                }
                gone
            },
        )
        .collect();
    // Summed in the order of the pixels, so that threads do not change it.
    Ok(Resampled {
        data: out,
        outside: outside.into_iter().sum(),
    })
}
