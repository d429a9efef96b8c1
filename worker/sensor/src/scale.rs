//! The scale from units of h to photons.

use picofarm_settings::{Scale, Sensor, SensorError};
use rayon::prelude::*;

use crate::{
    convolve::Convolver,
    draw::{PixelKey, Purpose},
    resample::Resampler,
    sense::Histograms,
};

/// Photons per unit of h, and the peak that determines it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scaled {
    /// Photons per unit of h.
    pub per_unit: f64,
    /// Photons of the peak, and the peak in units of h.
    pub photons: Option<f64>,
    pub peak: Option<f64>,
}

/// Returns the scale that the settings ask for. `known` is the peak if an earlier call found it.
pub(crate) fn scale_of(
    sensor: &Sensor,
    h: &Histograms<'_>,
    (convolver, gate, known): (&Convolver, Option<&Resampler>, Option<f64>),
    seed: u64,
    scene: u64,
) -> Result<Scaled, SensorError> {
    let without_peak = |per_unit| Scaled {
        per_unit,
        photons: None,
        peak: None,
    };
    let photons = match sensor.scale {
        Scale::Fixed { photons_per_unit } => return Ok(without_peak(photons_per_unit)),
        Scale::Peak { photons } => photons,
        Scale::PeakRange { low, high } => {
            let u = PixelKey::new(seed, Purpose::Peak, scene, 0)
                .bin(0)
                .uniform();
            low + (high - low) * u
        }
    };
    let part = h.two_bounce.unwrap_or(h.transient);
    match known.or_else(|| median_peak(part, h.bins, convolver, gate)) {
        Some(peak) => Ok(Scaled {
            per_unit: photons / peak,
            photons: Some(photons),
            peak: Some(peak),
        }),
        // There is no light, so any scale gives the same image.
        None if h.transient.iter().all(|h| *h == 0.0) => Ok(without_peak(1.0)),
        None => {
            let what = match gate {
                None => {
                    "the two-bounce part has no light although the transient has; \
                     use a fixed scale (photons_per_unit) for this scene"
                }
                Some(_) => {
                    "no light that sets the scale arrives within the detector's gate; use another gate \
                     (start_ps, bin_width_ps, bins), a scene nearer to the sensor, or a fixed scale \
                     (photons_per_unit)"
                }
            };
            Err(SensorError::new("sensor.scale", what))
        }
    }
}

/// Returns the median over the pixels with light of the brightest bin, or `None` if no pixel has
/// any.
fn median_peak(
    h: &[f32],
    bins: usize,
    convolver: &Convolver,
    gate: Option<&Resampler>,
) -> Option<f64> {
    let gated = gate.map_or(0, Resampler::bins);
    let mut peaks: Vec<f64> = h
        .par_chunks(bins)
        .map_init(
            || (convolver.clone(), vec![0.0; bins], vec![0.0; gated]),
            |(convolver, rate, gated), h| {
                convolver.run(h, rate);
                let seen = match gate {
                    None => rate,
                    Some(gate) => {
                        gated.fill(0.0);
                        gate.add(rate, gated);
                        gated
                    }
                };
                seen.iter().copied().fold(0.0, f64::max)
            },
        )
        .filter(|peak| *peak > 0.0)
        .collect();
    let middle = peaks.len().checked_sub(1)? / 2;
    Some(*peaks.select_nth_unstable_by(middle, f64::total_cmp).1)
}
