//! Captures as counted by a detector: with photon noise and ambient light.

use picofarm_sensor::{Histograms, Values, sense};
use picofarm_settings::{PS_PER_M, Sensor};
use picofarm_transient::Gate;
use rayon::prelude::*;

use crate::ReconstructError;

/// A detector, and the seed of its noise.
#[derive(Debug, Clone)]
pub(super) struct Detector {
    pub sensor: Sensor,
    pub seed: u64,
}

/// A capture's photons without the ambient light, `[row][column][bin]`, and each pixel's ambient
/// photons a bin.
pub(super) struct Counted {
    pub light: Vec<f32>,
    pub ambient: Vec<f32>,
}

impl Detector {
    /// Returns the detector's counts for a capture with the given number of bins a pixel.
    pub fn count(
        &self,
        beam: usize,
        histogram: &[f32],
        gate: &Gate,
    ) -> Result<Counted, ReconstructError> {
        let bins = gate.bins as usize;
        let input = Histograms {
            transient: histogram,
            two_bounce: None,
            bins,
            bin_width_ps: gate.bin_width_m * PS_PER_M,
        };
        let sensed = sense(&self.sensor, &input, self.seed, beam as u64)
            .map_err(|e| ReconstructError::invalid("sensor", e.to_string()))?;
        let light: Vec<f32> = match sensed.values {
            Values::Counts(counts) => counts.into_iter().map(|n| n as f32).collect(),
            Values::Rate(rate) => rate,
        };
        Ok(Counted::of_counts(light, bins))
    }
}

impl Counted {
    /// Subtracts the ambient light of each pixel from its counts. Most bins contain only ambient
    /// light, so its level is estimated from the lower half of the bins.
    pub fn of_counts(mut light: Vec<f32>, bins: usize) -> Self {
        let ambient = |h: &mut [f32]| -> f32 {
            let level = lower_mean(h);
            h.iter_mut().for_each(|n| *n -= level);
            level
        };
        let ambient = light.par_chunks_mut(bins).map(ambient).collect();
        Self { light, ambient }
    }
}

/// Returns the level of ambient light: the mean of the bins up to two spreads above the median. The
/// median itself is too coarse, because it is a whole number for counts of ambient light alone.
fn lower_mean(h: &[f32]) -> f32 {
    let mut sorted = h.to_vec();
    let middle = (sorted.len() - 1) / 2;
    let median = *sorted.select_nth_unstable_by(middle, f32::total_cmp).1;
    let most = median + 2.0 * median.max(1.0).sqrt();
    let kept = h.iter().filter(|n| **n <= most);
    let (sum, count) = kept.fold((0.0f64, 0u32), |(sum, count), n| {
        (sum + f64::from(*n), count + 1)
    });
    (sum / f64::from(count.max(1))) as f32
}

#[cfg(test)]
mod tests {
    use picofarm_settings::{Jitter, Pulse, Scale};

    use super::*;

    #[test]
    fn ambient_light_is_taken_off_and_light_is_kept() {
        let bins = 400;
        let gate = Gate {
            start_m: 0.0,
            bin_width_m: 0.0384,
            bins,
        };
        let mut histogram = vec![0.0f32; 64 * bins as usize];
        for h in histogram.chunks_exact_mut(bins as usize) {
            h[100] = 1.0;
        }
        for dark in [0.0, 0.3, 4.0] {
            let sensor = Sensor {
                pulse: Pulse::None {},
                jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
                scale: Scale::Peak { photons: 200.0 },
                dark_per_bin: dark,
                ..Sensor::default()
            };
            let detector = Detector { sensor, seed: 1 };
            let counted = detector.count(0, &histogram, &gate).unwrap();
            let mean = counted.ambient.iter().sum::<f32>() / 64.0;
            // The cutoff at two spreads excludes some of the ambient light.
            assert!(
                (f64::from(mean) - dark).abs() < 0.05 * dark + 0.02,
                "{mean} {dark}"
            );
            let peaks = counted.light.chunks_exact(bins as usize).map(|h| h[100]);
            let peak = peaks.sum::<f32>() / 64.0;
            assert!((peak - 200.0).abs() < 8.0, "{peak}");
        }
    }
}
