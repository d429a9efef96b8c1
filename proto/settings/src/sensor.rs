//! Settings of a sensor.

mod check;
mod preset;

use serde::{Deserialize, Serialize};

pub use preset::Preset;

/// Picoseconds that light takes for a metre of path.
pub const PS_PER_M: f64 = 1e12 / 299_792_458.0;

/// Settings of a sensor. The defaults are the method's: an analytic pulse of 128 ps, 50 ps of
/// jitter, a two-bounce peak of 10 to 400 photons, no dark counts, Poisson noise, no rebinning, no
/// dead time. In a file, `preset` names a [`Preset`], and the other fields replace its values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "preset::SensorText")]
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
    /// Wide pixels; `None` keeps the pixels of the histograms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zones: Option<Zones>,
    /// The detector's own bins; `None` keeps the bins of the histograms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gate: Option<TimeGate>,
    /// Counts caused by those of the neighbours.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crosstalk: Option<Crosstalk>,
    /// Counts caused by earlier ones of the same pixel.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub afterpulsing: Option<Afterpulsing>,
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
            zones: None,
            gate: None,
            crosstalk: None,
            afterpulsing: None,
        }
    }
}

impl Sensor {
    /// Returns the number of bins after the gate and the sums, of histograms with `source` bins.
    pub fn bins(&self, source: u32) -> u32 {
        self.gate.map_or(source, |gate| gate.bins) / self.rebin.max(1)
    }

    /// Returns the first field that makes the result other than a selection and sums of the input's
    /// bins: `None` only for a sensor that may read photon counts without spoiling them.
    pub fn disturbs(&self) -> Option<&'static str> {
        let no_jitter = matches!(self.jitter, Jitter::Gaussian { fwhm_ps } if fwhm_ps == 0.0);
        let as_it_is =
            matches!(self.scale, Scale::Fixed { photons_per_unit } if photons_per_unit == 1.0);
        match () {
            () if self.pulse != (Pulse::None {}) => Some("pulse"),
            () if !no_jitter => Some("jitter"),
            () if !as_it_is => Some("scale"),
            () if self.dark_per_bin > 0.0 => Some("dark_per_bin"),
            () if self.crosstalk.is_some() => Some("crosstalk"),
            () if self.dead_time.is_some() => Some("dead_time"),
            () if self.afterpulsing.is_some() => Some("afterpulsing"),
            () if self.poisson => Some("poisson"),
            () => None,
        }
    }

    /// Returns the first field that needs an image with a time axis, such as `zones`: such a sensor
    /// cannot read single histograms.
    pub fn needs_image(&self) -> Option<&'static str> {
        match () {
            () if self.zones.is_some() => Some("zones"),
            () if self.gate.is_some() => Some("gate"),
            () if self.crosstalk.is_some() => Some("crosstalk"),
            () => None,
        }
    }
}

/// Wide pixels: a zone's histogram is the mean over the pixels of its part of the image. The
/// numbers must divide those of the image. With zones, [`Sensor::scale`] refers to the brightest
/// bin of all bounces in the median zone, because a zone sees the spots themselves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Zones {
    /// Rows of zones.
    pub rows: u32,
    /// Columns of zones.
    pub columns: u32,
}

/// The time in which the detector counts, and its bins. A bin of the histograms is spread evenly
/// over its width and divided among the detector's bins. Light outside is dropped and counted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimeGate {
    /// Time after the pulse leaves the laser at which bin 0 starts, picoseconds; may be negative.
    pub start_ps: f64,
    /// Width of a bin, picoseconds.
    pub bin_width_ps: f64,
    /// Number of bins, before `rebin`.
    pub bins: u32,
}

/// Crosstalk: an avalanche triggers the pixels above, below, left and right at the same time. The
/// rate of a pixel becomes r + k·Σ(rates of these neighbours), to first order in k. Source: Rech et
/// al., "Optical crosstalk in single photon avalanche diode arrays", Opt. Express 16 (2008).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Crosstalk {
    /// Probability k that an avalanche triggers a given neighbour.
    pub probability: f64,
}

/// Afterpulsing: a detection causes another one with this probability, after the dead time (if any)
/// and an exponential delay. Each may cause a next one, so that the mean counts grow by 1/(1 − p)
/// as far as the gate contains them, and their variance by (1 + p)/(1 − p)². Source: Ziarkash et
/// al., "Comparative study of afterpulsing behavior and models in single photon counting avalanche
/// photo diode detectors", Sci. Rep. 8 (2018), the model with one time constant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Afterpulsing {
    /// Probability p.
    pub probability: f64,
    /// Time constant of the delay, picoseconds.
    pub decay_ps: f64,
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
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
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
    /// Free running and non-paralysable: after each detection, a pixel is blind for a fixed time,
    /// also across the next pulses, and then detects again. Photons that arrive meanwhile do not
    /// prolong it. A constant rate λ is counted as λ/(1 + λd). Source: Rapp, Ma, Dawson, Goyal,
    /// "Dead time compensation for high-flux ranging", IEEE TSP 67 (2019), section II.
    FreeRunning {
        /// Pulses in a histogram, N. The pixel is live at the first.
        pulses: u64,
        /// Dead time d, picoseconds: at least a bin, at most the period.
        dead_ps: f64,
        /// Time from pulse to pulse, picoseconds: at least the gate. Outside the gate only dark
        /// counts arrive; they are not recorded.
        period_ps: f64,
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
