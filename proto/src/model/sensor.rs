//! A sensor as jobs describe it: plain data with the names, defaults and limits of the renderer's sensor model, which
//! the worker turns it into. Unknown fields are refused.

use serde::{Deserialize, Serialize};

use super::job::{SpecError, within as bounded};

/// Settings of a sensor, in the order in which they act: pulse, jitter, scale, dark counts, pile-up, noise, rebinning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorSettings {
    /// The laser's pulse together with the detector's response.
    pub pulse: PulseSettings,
    /// Timing jitter.
    pub jitter: JitterSettings,
    /// How many photons the light is.
    pub scale: ScaleSettings,
    /// Ambient and dark counts: photons a bin (before rebinning) and pixel.
    pub dark_per_bin: f64,
    /// Draw counts; otherwise the expected rates are the result.
    pub poisson: bool,
    /// How many adjacent bins are summed at the end; 1 = none.
    pub rebin: u32,
    /// Pile-up; `None` = every photon is counted.
    pub dead_time: Option<DeadTimeSettings>,
}

/// A pulse shape; always normalised to sum 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum PulseSettings {
    /// No blur at all.
    None {},
    /// A Gaussian rise with an exponential tail.
    Analytic {
        /// Full width at half maximum, picoseconds.
        fwhm_ps: f64,
    },
    /// A measured pulse.
    Sampled {
        /// Width of a bin of `values`, picoseconds.
        bin_width_ps: f64,
        /// Energy of each bin, at least 0, in any unit.
        values: Vec<f64>,
        /// The bin whose centre is time zero; absent = the largest value's.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        zero_bin: Option<f64>,
    },
}

/// Timing jitter.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum JitterSettings {
    /// Every photon is displaced on its own.
    Gaussian {
        /// Full width at half maximum, picoseconds. 0 = none.
        fwhm_ps: f64,
    },
    /// The pulse is shifted by floor(N(0, σ)) bins, once a scene, as the method's published code does it.
    Sb3dCompat {
        /// σ in bins.
        #[serde(default = "sb3d_sigma")]
        sigma_bins: f64,
    },
}

/// How many photons a unit of h is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum ScaleSettings {
    /// The same factor for every scene.
    Fixed {
        /// Photons for a unit of h.
        photons_per_unit: f64,
    },
    /// The median pixel's brightest bin has this many photons.
    Peak {
        /// Photons.
        photons: f64,
    },
    /// Uniform in [low, high), drawn for each scene.
    PeakRange {
        /// Fewest photons.
        low: f64,
        /// Most photons.
        high: f64,
    },
}

/// Pile-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum DeadTimeSettings {
    /// At most the first photon after each pulse is seen.
    FirstPhoton {
        /// Pulses in a histogram.
        pulses: u64,
    },
}

impl Default for SensorSettings {
    fn default() -> Self {
        Self {
            pulse: PulseSettings::Analytic { fwhm_ps: 128.0 },
            jitter: JitterSettings::Gaussian { fwhm_ps: 50.0 },
            scale: ScaleSettings::PeakRange {
                low: 10.0,
                high: 400.0,
            },
            dark_per_bin: 0.0,
            poisson: true,
            rebin: 1,
            dead_time: None,
        }
    }
}

impl Default for PulseSettings {
    fn default() -> Self {
        SensorSettings::default().pulse
    }
}

impl Default for JitterSettings {
    fn default() -> Self {
        SensorSettings::default().jitter
    }
}

impl Default for ScaleSettings {
    fn default() -> Self {
        SensorSettings::default().scale
    }
}

fn sb3d_sigma() -> f64 {
    2.654
}

impl SensorSettings {
    /// Checks every field; `at` is the path of these settings in the job, e.g. `reprocess.sensor`.
    ///
    /// # Errors
    /// [`SpecError`] naming the first field that cannot be used.
    pub fn check(&self, at: &str) -> Result<(), SpecError> {
        let within = |field: &str, value: f64, low: f64, high: f64, unit: &str| {
            if (low..=high).contains(&value) {
                return Ok(());
            }
            Err(SpecError::new(
                format!("{at}.{field}"),
                format!("{value} lies outside {low}..={high} {unit}"),
            ))
        };
        match &self.pulse {
            PulseSettings::None {} => {}
            PulseSettings::Analytic { fwhm_ps } => {
                within("pulse.fwhm_ps", *fwhm_ps, 1e-3, 1e6, "picoseconds")?;
            }
            PulseSettings::Sampled {
                bin_width_ps,
                values,
                zero_bin,
            } => {
                within(
                    "pulse.bin_width_ps",
                    *bin_width_ps,
                    1e-3,
                    1e6,
                    "picoseconds",
                )?;
                let usable = values.iter().all(|v| (0.0..=1e30).contains(v));
                let sum = values.iter().sum::<f64>();
                if !(1..=1 << 16).contains(&values.len()) || !usable || sum < 1e-30 {
                    return Err(SpecError::new(
                        format!("{at}.pulse.values"),
                        "must be 1 to 65536 finite values of at least 0 with some energy; subtract the background \
                         and clip it first",
                    ));
                }
                if let Some(zero) = zero_bin {
                    let last = (values.len() - 1) as f64;
                    within("pulse.zero_bin", *zero, 0.0, last, "(a bin of the pulse)")?;
                }
            }
        }
        match self.jitter {
            JitterSettings::Gaussian { fwhm_ps } => {
                within("jitter.fwhm_ps", fwhm_ps, 0.0, 1e6, "picoseconds")?;
            }
            JitterSettings::Sb3dCompat { sigma_bins } => {
                within("jitter.sigma_bins", sigma_bins, 0.0, 1e3, "bins")?;
            }
        }
        match self.scale {
            ScaleSettings::Fixed {
                photons_per_unit: p,
            } => {
                within(
                    "scale.photons_per_unit",
                    p,
                    1e-30,
                    1e30,
                    "photons for a unit of h",
                )?;
            }
            ScaleSettings::Peak { photons } => {
                within("scale.photons", photons, 1e-6, 1e8, "photons")?;
            }
            ScaleSettings::PeakRange { low, high } => {
                within("scale.low", low, 1e-6, 1e8, "photons")?;
                within("scale.high", high, low, 1e8, "photons")?;
            }
        }
        within("dark_per_bin", self.dark_per_bin, 0.0, 1e8, "photons a bin")?;
        let unit = "bins summed to one; 1 leaves them as they are";
        bounded(format!("{at}.rebin"), self.rebin, (1, 65_536), unit)?;
        match self.dead_time {
            Some(DeadTimeSettings::FirstPhoton { pulses }) if !(1..=1 << 40).contains(&pulses) => {
                Err(SpecError::new(
                    format!("{at}.dead_time.pulses"),
                    format!("{pulses} lies outside 1..={} pulses", 1u64 << 40),
                ))
            }
            _ => Ok(()),
        }
    }
}
