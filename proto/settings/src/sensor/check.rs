//! The limits of a sensor's settings.

use super::{
    Afterpulsing, Crosstalk, DeadTime, Jitter, Pulse, Scale, Sensor, SensorError, TimeGate, Zones,
};

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
        self.check_counting()?;
        self.check_image()
    }

    fn check_counting(&self) -> Result<(), SensorError> {
        if let Some(DeadTime::FirstPhoton { pulses } | DeadTime::FreeRunning { pulses, .. }) =
            self.dead_time
            && !(1..=MAX_PULSES).contains(&pulses)
        {
            return Err(SensorError::new(
                "sensor.dead_time.pulses",
                format!("{pulses} lies outside 1..={MAX_PULSES} pulses"),
            ));
        }
        if let Some(DeadTime::FreeRunning {
            dead_ps, period_ps, ..
        }) = self.dead_time
        {
            within(
                "sensor.dead_time.period_ps",
                period_ps,
                1e-3,
                1e9,
                "picoseconds",
            )?;
            within(
                "sensor.dead_time.dead_ps",
                dead_ps,
                1e-3,
                period_ps,
                "picoseconds: at most the period; a pixel that is blind until the next pulse is \
                 { kind = \"first_photon\" }",
            )?;
        }
        if let Some(Afterpulsing {
            probability,
            decay_ps,
        }) = self.afterpulsing
        {
            within(
                "sensor.afterpulsing.probability",
                probability,
                0.0,
                0.9,
                "(a probability)",
            )?;
            within(
                "sensor.afterpulsing.decay_ps",
                decay_ps,
                1e-3,
                1e9,
                "picoseconds",
            )?;
            if matches!(self.dead_time, Some(DeadTime::FirstPhoton { .. })) {
                return Err(SensorError::new(
                    "sensor.afterpulsing",
                    "a pixel that records the first photon of a pulse records no afterpulse of it; \
                     use dead_time = { kind = \"free_running\" }, or leave one of the two out",
                ));
            }
        }
        Ok(())
    }

    fn check_image(&self) -> Result<(), SensorError> {
        if let Some(Zones { rows, columns }) = self.zones
            && (rows == 0 || columns == 0)
        {
            return Err(SensorError::new(
                "sensor.zones",
                format!("expected at least one row and column, found {rows}x{columns}"),
            ));
        }
        if let Some(TimeGate {
            start_ps,
            bin_width_ps,
            bins,
        }) = self.gate
        {
            within(
                "sensor.gate.start_ps",
                start_ps,
                -1e9,
                1e9,
                "picoseconds after the pulse",
            )?;
            within(
                "sensor.gate.bin_width_ps",
                bin_width_ps,
                1e-3,
                1e6,
                "picoseconds",
            )?;
            if !(1..=MAX_REBIN).contains(&bins) {
                return Err(SensorError::new(
                    "sensor.gate.bins",
                    format!("{bins} lies outside 1..={MAX_REBIN} bins"),
                ));
            }
        }
        if let Some(Crosstalk { probability }) = self.crosstalk {
            within(
                "sensor.crosstalk.probability",
                probability,
                0.0,
                0.25,
                "(a probability for each of four neighbours)",
            )?;
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
