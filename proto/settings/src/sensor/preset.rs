//! Sensors of data sheets, and the settings of a file, which may name one.

use serde::{Deserialize, Serialize};

use super::{
    Afterpulsing, Crosstalk, DeadTime, Jitter, PS_PER_M, Pulse, Scale, Sensor, TimeGate, Zones,
};

/// Distance of a bin of the VL53L8CH's histograms, metres (`VL53LMZ_CNH_BIN_WIDTH_MM` of ST's
/// driver, `vl53lmz_plugin_cnh.h`).
const VL53L8CH_BIN_M: f64 = 0.037_534_8;

/// Settings of a sensor that one can buy. What no source states is an assumption, and
/// [`Preset::assumed`] lists it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// ST VL53L8CH: 4×4 zones.
    Vl53l8ch,
    /// ams OSRAM TMF8828: 8×8 zones.
    Tmf8828,
    /// Adaps ADS6311: 256×192 pixels.
    Ads6311,
}

impl Preset {
    /// All presets.
    pub const ALL: [Self; 3] = [Self::Vl53l8ch, Self::Tmf8828, Self::Ads6311];

    /// Returns the name that files and options use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vl53l8ch => "vl53l8ch",
            Self::Tmf8828 => "tmf8828",
            Self::Ads6311 => "ads6311",
        }
    }

    /// Returns the maker's name for the device.
    pub fn device(self) -> &'static str {
        match self {
            Self::Vl53l8ch => "ST VL53L8CH",
            Self::Tmf8828 => "ams OSRAM TMF8828",
            Self::Ads6311 => "Adaps ADS6311",
        }
    }

    /// Returns the field of view, which the render's camera must have.
    pub fn view(self) -> &'static str {
        match self {
            Self::Vl53l8ch => "45° × 45°",
            Self::Tmf8828 => "63° on the diagonal",
            Self::Ads6311 => "that of the lens",
        }
    }

    /// Returns whether one wide flash lights the whole view, rather than separate spots.
    pub fn floods(self) -> bool {
        match self {
            Self::Vl53l8ch | Self::Tmf8828 => true,
            Self::Ads6311 => false,
        }
    }

    /// Returns where the values are from.
    pub fn source(self) -> &'static str {
        match self {
            Self::Vl53l8ch => {
                "zones and view: data sheet DS14161; bins of 37.5348 mm, and 24 sums of four of them at 4×4 zones: ST's \
                 driver for its histograms and the example there (vl53lmz_plugin_cnh)"
            }
            Self::Tmf8828 => {
                "zones and view: data sheet DS000693; bins, start, width of the pulse, peak and background: \
                 calibration and captures of sidsoma/consumer-nlos (3×3 zones, short range)"
            }
            Self::Ads6311 => "pixels and bins: Goyal et al., ICCV 2025 (arXiv 2508.00169)",
        }
    }

    /// Returns what no source states.
    pub fn assumed(self) -> &'static str {
        match self {
            Self::Vl53l8ch => {
                "pulse of 1252 ps FWHM, half of the driver's pulse width of 10 bins; the photons"
            }
            Self::Tmf8828 => "that 8×8 zones have the same bins and photons as 3×3",
            Self::Ads6311 => {
                "bins of 1 ns, so that 672 span 100 m; pulse of 2 ns FWHM; the photons"
            }
        }
    }

    /// Returns the settings. Pulses include the detector's jitter. Dead time, crosstalk and
    /// afterpulsing are unpublished, and off.
    pub fn sensor(self) -> Sensor {
        let square = |side: u32| Zones {
            rows: side,
            columns: side,
        };
        let seen = |fwhm_ps: f64, zones: Zones, gate: TimeGate| Sensor {
            pulse: Pulse::Analytic { fwhm_ps },
            jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
            zones: Some(zones),
            gate: Some(gate),
            ..Sensor::default()
        };
        match self {
            Self::Vl53l8ch => {
                let bin_ps = 2.0 * VL53L8CH_BIN_M * PS_PER_M;
                let gate = TimeGate {
                    start_ps: 0.0,
                    bin_width_ps: 4.0 * bin_ps,
                    bins: 24,
                };
                seen(5.0 * bin_ps, square(4), gate)
            }
            Self::Tmf8828 => {
                // The peak is the median of 27 zones, and so are 3.0 bins and 520 counts.
                let gate = TimeGate {
                    start_ps: -13.0 * 88.0,
                    bin_width_ps: 88.0,
                    bins: 128,
                };
                Sensor {
                    scale: Scale::Peak { photons: 3e5 },
                    dark_per_bin: 520.0,
                    ..seen(3.0 * 88.0, square(8), gate)
                }
            }
            Self::Ads6311 => {
                let zones = Zones {
                    rows: 192,
                    columns: 256,
                };
                let gate = TimeGate {
                    start_ps: 0.0,
                    bin_width_ps: 1000.0,
                    bins: 672,
                };
                seen(2000.0, zones, gate)
            }
        }
    }
}

/// The settings of a file: a preset, and the fields that differ from it.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct SensorText {
    preset: Option<Preset>,
    pulse: Option<Pulse>,
    jitter: Option<Jitter>,
    scale: Option<Scale>,
    dark_per_bin: Option<f64>,
    poisson: Option<bool>,
    rebin: Option<u32>,
    dead_time: Option<DeadTime>,
    zones: Option<Zones>,
    gate: Option<TimeGate>,
    crosstalk: Option<Crosstalk>,
    afterpulsing: Option<Afterpulsing>,
}

impl From<SensorText> for Sensor {
    fn from(text: SensorText) -> Self {
        let base = text.preset.map_or_else(Self::default, Preset::sensor);
        Self {
            pulse: text.pulse.unwrap_or(base.pulse),
            jitter: text.jitter.unwrap_or(base.jitter),
            scale: text.scale.unwrap_or(base.scale),
            dark_per_bin: text.dark_per_bin.unwrap_or(base.dark_per_bin),
            poisson: text.poisson.unwrap_or(base.poisson),
            rebin: text.rebin.unwrap_or(base.rebin),
            dead_time: text.dead_time.or(base.dead_time),
            zones: text.zones.or(base.zones),
            gate: text.gate.or(base.gate),
            crosstalk: text.crosstalk.or(base.crosstalk),
            afterpulsing: text.afterpulsing.or(base.afterpulsing),
        }
    }
}
