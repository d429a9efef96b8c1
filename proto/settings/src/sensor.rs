//! Settings of a sensor, in the order of their effect, and their limits.

use serde::{Deserialize, Serialize};

/// Picoseconds that light takes for a metre of path.
pub const PS_PER_M: f64 = 1e12 / 299_792_458.0;

/// Settings of a sensor. The defaults are the method's: an analytic pulse of 128 ps, 50 ps of
/// jitter, a two-bounce peak of 10 to 400 photons, no dark counts, Poisson noise, no rebinning, no
/// dead time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Sensor {
    /// The laser's pulse together with the detector's response.
    pub pulse: Pulse,
    /// Timing jitter.
    pub jitter: Jitter,
    /// Conversion of light to photons.
    pub scale: Scale,
    /// Ambient and dark counts: photons for each bin (before rebinning) and pixel.
    pub dark_per_bin: f64,
    /// Whether counts are drawn. Otherwise the expected rates are the result.
    pub poisson: bool,
    /// Number of adjacent bins that are summed at the end. Bins left over at the end of the gate
    /// are dropped. 1 means none.
    pub rebin: u32,
    /// Pile-up; `None` means that every photon is counted.
    pub dead_time: Option<DeadTime>,
}

impl Default for Sensor {
    fn default() -> Self {
        Self {
            pulse: Pulse::default(),
            jitter: Jitter::default(),
            scale: Scale::default(),
            dark_per_bin: 0.0,
            poisson: true,
            rebin: 1,
            dead_time: None,
        }
    }
}

/// A pulse shape. Always normalised to sum 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Pulse {
    /// No blur.
    None {},
    /// A Gaussian with a smooth transition to an exponential tail, as single-photon detectors show.
    /// With τ = 2s the tail's time constant and t₁ = s²/τ = s/2 where the slopes are equal: p(t) ∝
    /// exp(−t²/2s²) for t < t₁, exp(−t₁²/2s²)·exp(−(t−t₁)/τ) from there on. Its FWHM is s·(√(2 ln
    /// 2) + ¼ + 2 ln 2) ≈ 2.8137 s. Its peak, t = 0, is the arrival of the light.
    Analytic {
        /// Full width at half maximum, picoseconds.
        fwhm_ps: f64,
    },
    /// A measured pulse: energy by bin, constant within each of its bins.
    Sampled {
        /// Width of a bin of `values`, picoseconds; may differ from the histogram's.
        bin_width_ps: f64,
        /// Energy of each bin, at least 0, in any unit.
        values: Vec<f64>,
        /// The bin centred at time zero (fractions are allowed); defaults to the bin of the largest
        /// value.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        zero_bin: Option<f64>,
    },
}

impl Default for Pulse {
    fn default() -> Self {
        Self::Analytic { fwhm_ps: 128.0 }
    }
}

/// Timing jitter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Jitter {
    /// Every photon is displaced independently: a Gaussian blur of the rate.
    Gaussian {
        /// Full width at half maximum, picoseconds; σ = FWHM / (2√(2 ln 2)). 0 means none.
        fwhm_ps: f64,
    },
    /// Like the published code: the pulse is rolled by floor(N(0, σ)) bins of the histogram, once
    /// for all pixels. The pulse is shifted instead of rolled around its own array, so that no tail
    /// appears before its rise.
    Sb3dCompat {
        /// σ in bins of the histogram; defaults to [`Jitter::SB3D_SIGMA_BINS`].
        #[serde(default = "sb3d_sigma")]
        sigma_bins: f64,
    },
}

impl Jitter {
    /// σ of the published code: 50 ps FWHM in bins of 8 ps.
    pub const SB3D_SIGMA_BINS: f64 = 2.654;
}

fn sb3d_sigma() -> f64 {
    Jitter::SB3D_SIGMA_BINS
}

impl Default for Jitter {
    fn default() -> Self {
        Self::Gaussian { fwhm_ps: 50.0 }
    }
}

/// The number of photons for a unit of h. A peak refers to the rate without dark counts: the median
/// over the lit pixels of the brightest bin of the blurred two-bounce part. The few pixels close to
/// a spot are far brighter and do not affect the median.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Scale {
    /// The same factor for every scene.
    Fixed {
        /// Photons for a unit of h.
        photons_per_unit: f64,
    },
    /// Each scene's peak has this many photons.
    Peak {
        /// Photons.
        photons: f64,
    },
    /// Each scene's peak is uniform in [low, high), drawn from (seed, scene).
    PeakRange {
        /// Fewest photons.
        low: f64,
        /// Most photons.
        high: f64,
    },
}

impl Default for Scale {
    fn default() -> Self {
        Self::PeakRange {
            low: 10.0,
            high: 400.0,
        }
    }
}

/// Pile-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum DeadTime {
    /// A pixel records the first photon after each pulse and is blind until the next pulse: the
    /// dead time is longer than the gate and shorter than the repetition period. With N pulses and
    /// rate_b/N expected photons a bin, a pulse without a photon so far gives one in bin b with
    /// probability 1 − exp(−rate_b/N), so that the counts are multinomial. N → ∞ gives plain
    /// Poisson counts. Source: Coates, J. Phys. E 1, 878 (1968); Pediredla et al., "Signal
    /// processing based pile-up compensation for gated SPADs" (2018), section 2.
    FirstPhoton {
        /// Pulses in a histogram, N.
        pulses: u64,
    },
}

/// The reason why a sensor cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SensorError {
    /// A setting or an argument is invalid.
    #[error("{field}: {what}")]
    Invalid {
        /// The field, e.g. `sensor.pulse.fwhm_ps` or `transient`.
        field: String,
        /// The expected value, the actual value, and the correction.
        what: String,
    },
}

impl SensorError {
    /// Creates an error about a field or argument.
    pub fn new(field: impl Into<String>, what: impl Into<String>) -> Self {
        Self::Invalid {
            field: field.into(),
            what: what.into(),
        }
    }
}

/// Most bins summed to one.
const MAX_REBIN: u32 = 1 << 16;
/// Most values of a sampled pulse.
const MAX_SAMPLES: usize = 1 << 16;
/// Most pulses in a histogram: all numbers up to it are exact in f64.
const MAX_PULSES: u64 = 1 << 40;

impl Sensor {
    /// Checks every field.
    ///
    /// # Errors
    /// Returns [`SensorError::Invalid`] for the first invalid field.
    pub fn check(&self) -> Result<(), SensorError> {
        match &self.pulse {
            Pulse::None {} => {}
            Pulse::Analytic { fwhm_ps } => {
                within("sensor.pulse.fwhm_ps", *fwhm_ps, 1e-3, 1e6, "picoseconds")?;
            }
            Pulse::Sampled {
                bin_width_ps,
                values,
                zero_bin,
            } => {
                within(
                    "sensor.pulse.bin_width_ps",
                    *bin_width_ps,
                    1e-3,
                    1e6,
                    "picoseconds",
                )?;
                check_samples(values, *zero_bin)?;
            }
        }
        match self.jitter {
            Jitter::Gaussian { fwhm_ps } => {
                within("sensor.jitter.fwhm_ps", fwhm_ps, 0.0, 1e6, "picoseconds")?;
            }
            Jitter::Sb3dCompat { sigma_bins } => {
                within("sensor.jitter.sigma_bins", sigma_bins, 0.0, 1e3, "bins")?;
            }
        }
        match self.scale {
            Scale::Fixed { photons_per_unit } => within(
                "sensor.scale.photons_per_unit",
                photons_per_unit,
                1e-30,
                1e30,
                "photons for a unit of h",
            )?,
            Scale::Peak { photons } => {
                within("sensor.scale.photons", photons, 1e-6, 1e8, "photons")?;
            }
            Scale::PeakRange { low, high } => {
                within("sensor.scale.low", low, 1e-6, 1e8, "photons")?;
                within("sensor.scale.high", high, low, 1e8, "photons")?;
            }
        }
        within(
            "sensor.dark_per_bin",
            self.dark_per_bin,
            0.0,
            1e8,
            "photons a bin",
        )?;
        if !(1..=MAX_REBIN).contains(&self.rebin) {
            return Err(SensorError::new(
                "sensor.rebin",
                format!(
                    "{} lies outside 1..={MAX_REBIN} bins summed to one; 1 leaves them as they are",
                    self.rebin
                ),
            ));
        }
        if let Some(DeadTime::FirstPhoton { pulses }) = self.dead_time
            && !(1..=MAX_PULSES).contains(&pulses)
        {
            return Err(SensorError::new(
                "sensor.dead_time.pulses",
                format!("{pulses} lies outside 1..={MAX_PULSES} pulses"),
            ));
        }
        Ok(())
    }
}

fn within(field: &str, value: f64, low: f64, high: f64, unit: &str) -> Result<(), SensorError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(SensorError::new(
        field,
        format!("{value} lies outside {low}..={high} {unit}"),
    ))
}

fn check_samples(values: &[f64], zero_bin: Option<f64>) -> Result<(), SensorError> {
    let field = "sensor.pulse.values";
    if !(1..=MAX_SAMPLES).contains(&values.len()) {
        let what = format!("expected 1 to {MAX_SAMPLES} values, found {}", values.len());
        return Err(SensorError::new(field, what));
    }
    if let Some(i) = values.iter().position(|v| !(0.0..=1e30).contains(v)) {
        return Err(SensorError::new(
            format!("{field}[{i}]"),
            format!(
                "expected a finite value of at least 0, found {}; subtract the background and clip it first",
                values[i]
            ),
        ));
    }
    let sum: f64 = values.iter().sum();
    if sum < 1e-30 {
        return Err(SensorError::new(
            field,
            format!("expected some energy, found a sum of {sum}"),
        ));
    }
    match zero_bin {
        Some(zero) => within(
            "sensor.pulse.zero_bin",
            zero,
            0.0,
            (values.len() - 1) as f64,
            "(a bin of the pulse)",
        ),
        None => Ok(()),
    }
}
