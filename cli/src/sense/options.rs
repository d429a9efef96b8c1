//! A sensor's settings: its file, overridden by the options.

use picofarm_sensor::{DeadTime, Jitter, Pulse, Scale, Sensor};

use crate::{
    args::SensorArgs,
    error::{CliError, Result},
    files,
};

/// Reads the settings file and applies the options.
pub fn settings(args: &SensorArgs) -> Result<Sensor> {
    let mut sensor = match &args.sensor {
        None => Sensor::default(),
        Some(path) => {
            let text = files::read_text(path, files::SETTINGS)?;
            let sensor: Sensor = toml::from_str(&text).map_err(|e| {
                CliError::input(format!("{}: {}", path.display(), e.to_string().trim_end()))
            })?;
            sensor
                .check()
                .map_err(|e| CliError::input(format!("{}: {e}", path.display())))?;
            sensor
        }
    };
    if let Some(text) = &args.peak_photons {
        sensor.scale = peak(text)?;
    }
    if let Some(photons_per_unit) = args.photons_per_unit {
        sensor.scale = Scale::Fixed { photons_per_unit };
    }
    if let Some(text) = &args.pulse {
        sensor.pulse = pulse(text)?;
    }
    if let Some(fwhm_ps) = args.jitter_ps {
        sensor.jitter = Jitter::Gaussian { fwhm_ps };
    }
    if args.jitter_sb3d {
        sensor.jitter = Jitter::Sb3dCompat {
            sigma_bins: Jitter::SB3D_SIGMA_BINS,
        };
    }
    if let Some(rate) = args.dark {
        sensor.dark_per_bin = rate;
    }
    if let Some(bins) = args.rebin {
        sensor.rebin = bins;
    }
    if args.no_poisson {
        sensor.poisson = false;
    }
    if let Some(text) = &args.dead_time {
        sensor.dead_time = Some(dead_time(text)?);
    }
    sensor.check().map_err(CliError::input)?;
    Ok(sensor)
}

fn peak(text: &str) -> Result<Scale> {
    let unusable = || {
        CliError::input(format!(
            "--peak-photons {text:?}: expected a number of photons, or two"
        ))
        .hint("e.g. --peak-photons 100, or --peak-photons 10..400")
    };
    let number = |text: &str| text.trim().parse::<f64>().map_err(|_| unusable());
    Ok(match text.split_once("..") {
        Some((low, high)) => Scale::PeakRange {
            low: number(low)?,
            high: number(high)?,
        },
        None => Scale::Peak {
            photons: number(text)?,
        },
    })
}

fn pulse(text: &str) -> Result<Pulse> {
    if text == "none" {
        return Ok(Pulse::None {});
    }
    let fwhm = text.strip_prefix("fwhm:").and_then(|ps| ps.parse().ok());
    let fwhm_ps = fwhm.ok_or_else(|| {
        CliError::input(format!("--pulse {text:?}: expected fwhm:PS or none")).hint(
            "e.g. --pulse fwhm:128; a measured pulse goes into a file for --sensor: \
             pulse = { kind = \"sampled\", bin_width_ps = 8.0, values = [0.1, 0.7, 0.2] }",
        )
    })?;
    Ok(Pulse::Analytic { fwhm_ps })
}

fn dead_time(text: &str) -> Result<DeadTime> {
    let pulses = text.strip_prefix("pulses:").and_then(|n| n.parse().ok());
    pulses
        .map(|pulses| DeadTime::FirstPhoton { pulses })
        .ok_or_else(|| {
            CliError::input(format!("--dead-time {text:?}: expected pulses:N"))
                .hint("e.g. --dead-time pulses:100000")
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_forms_are_understood_or_named() {
        assert_eq!(peak("100").unwrap(), Scale::Peak { photons: 100.0 });
        assert_eq!(peak("10..400").unwrap(), Scale::default());
        assert_eq!(pulse("fwhm:128").unwrap(), Pulse::default());
        assert_eq!(pulse("none").unwrap(), Pulse::None {});
        assert_eq!(
            dead_time("pulses:7").unwrap(),
            DeadTime::FirstPhoton { pulses: 7 }
        );
        for error in [
            peak("10..").unwrap_err(),
            peak("many").unwrap_err(),
            pulse("128").unwrap_err(),
            dead_time("7").unwrap_err(),
        ] {
            assert!(error.message.starts_with("--") && error.message.contains("expected"));
            assert!(error.hint.is_some());
        }
    }

    #[test]
    fn a_sensor_file_may_say_everything() {
        let sensor: Sensor = toml::from_str(
            r#"
            poisson = false
            dark_per_bin = 0.01
            rebin = 4
            [pulse]
            kind = "sampled"
            bin_width_ps = 8.0
            values = [0.1, 0.7, 0.2]
            [jitter]
            kind = "sb3d_compat"
            [scale]
            kind = "peak"
            photons = 100.0
            [dead_time]
            kind = "first_photon"
            pulses = 100000
            "#,
        )
        .unwrap();
        sensor.check().unwrap();
        assert_eq!(sensor.rebin, 4);
    }
}
