//! A sensor's settings: its file or preset, overridden by the options.

use std::path::Path;

use picofarm_sensor::{
    Afterpulsing, Crosstalk, DeadTime, Jitter, Pulse, Scale, Sensor, TimeGate, Zones,
};

use crate::{
    args::SensorArgs,
    error::{CliError, Result},
    files,
};

/// Reads the settings file and applies the options.
pub fn settings(args: &SensorArgs) -> Result<Sensor> {
    let mut sensor = match &args.sensor {
        None => args.preset.map_or_else(Sensor::default, |p| p.0.sensor()),
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
    if let Some(text) = &args.zones {
        sensor.zones = Some(zones(text)?);
    }
    if let Some(text) = &args.gate {
        sensor.gate = Some(gate(text)?);
    }
    if let Some(probability) = args.crosstalk {
        sensor.crosstalk = Some(Crosstalk { probability });
    }
    if let Some(text) = &args.afterpulsing {
        sensor.afterpulsing = Some(afterpulsing(text)?);
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
    if let Some(path) = text.strip_prefix("file:") {
        return measured(Path::new(path));
    }
    let fwhm = text.strip_prefix("fwhm:").and_then(|ps| ps.parse().ok());
    let fwhm_ps = fwhm.ok_or_else(|| {
        CliError::input(format!(
            "--pulse {text:?}: expected fwhm:PS, file:PATH or none"
        ))
        .hint("e.g. --pulse fwhm:128, or --pulse file:pulse.csv for a measured pulse")
    })?;
    Ok(Pulse::Analytic { fwhm_ps })
}

/// Reads a measured pulse: lines of a time in picoseconds and an energy. A first line that is no
/// number is a header; empty lines and those after # are comments.
fn measured(path: &Path) -> Result<Pulse> {
    let text = files::read_text(path, files::SETTINGS)?;
    let failed = |line: usize, what: String| {
        CliError::input(format!("--pulse file:{}: line {line}: {what}", path.display())).hint(
            "e.g. -8,0.1 then 0,0.7 then 8,0.2: a time in picoseconds and an energy, in equal steps, time 0 among them",
        )
    };
    let mut rows: Vec<(usize, f64, f64)> = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let mut cells = line.split(',').map(|cell| cell.trim().parse::<f64>().ok());
        match (cells.next().flatten(), cells.next().flatten(), cells.next()) {
            (Some(time), Some(energy), None) if time.is_finite() => {
                rows.push((number + 1, time, energy));
            }
            (None, None, _) if rows.is_empty() => {}
            _ => {
                let what = format!("expected a time and an energy, found {line:?}");
                return Err(failed(number + 1, what));
            }
        }
    }
    let (Some(first), Some(second)) = (rows.first(), rows.get(1)) else {
        let what = format!(
            "expected at least two lines of numbers, found {}",
            rows.len()
        );
        return Err(failed(1, what));
    };
    let (start, step) = (first.1, second.1 - first.1);
    // Times are often printed with few digits.
    let even = |(k, row): (usize, &(usize, f64, f64))| {
        let wanted = start + k as f64 * step;
        (row.1 - wanted).abs() <= 0.01 * step * (k as f64).max(1.0)
    };
    if step.is_nan() || step <= 0.0 {
        return Err(failed(
            second.0,
            format!("expected a time after {start}, found {}", second.1),
        ));
    }
    if let Some(k) = (0..rows.len()).find(|k| !even((*k, &rows[*k]))) {
        let what = format!(
            "expected the time {} in steps of {step}, found {}",
            start + k as f64 * step,
            rows[k].1
        );
        return Err(failed(rows[k].0, what));
    }
    // The mean step is more exact than the first.
    let last = rows.len() - 1;
    let step = (rows[last].1 - start) / last as f64;
    let zero = -start / step;
    if !(0.0..=last as f64).contains(&zero) {
        let what = format!(
            "expected time 0, at which the light arrives, within the pulse, found {start} to {}; shift the times",
            rows[last].1
        );
        return Err(failed(first.0, what));
    }
    Ok(Pulse::Sampled {
        bin_width_ps: step,
        values: rows.iter().map(|row| row.2).collect(),
        zero_bin: Some(zero),
    })
}

/// Splits a text into numbers, of which there must be `N`.
fn numbers<const N: usize>(text: &str, separator: char) -> Option<[f64; N]> {
    let all: Option<Vec<f64>> = text
        .split(separator)
        .map(|cell| cell.trim().parse().ok())
        .collect();
    all?.try_into().ok()
}

/// A number that is whole and fits `T`.
fn whole<T: TryFrom<u64>>(x: f64) -> Option<T> {
    let fits = x.fract() == 0.0 && (0.0..=9e15).contains(&x);
    fits.then(|| T::try_from(x as u64).ok()).flatten()
}

fn dead_time(text: &str) -> Result<DeadTime> {
    let first = || {
        let pulses = text.strip_prefix("pulses:")?.parse().ok()?;
        Some(DeadTime::FirstPhoton { pulses })
    };
    let free = || {
        let [pulses, dead_ps, period_ps] = numbers(text.strip_prefix("free:")?, ',')?;
        Some(DeadTime::FreeRunning {
            pulses: whole(pulses)?,
            dead_ps,
            period_ps,
        })
    };
    first().or_else(free).ok_or_else(|| {
        CliError::input(format!(
            "--dead-time {text:?}: expected pulses:N or free:N,DEAD,PERIOD"
        ))
        .hint(
            "e.g. --dead-time pulses:100000, or --dead-time free:100000,20000,100000 (picoseconds)",
        )
    })
}

fn zones(text: &str) -> Result<Zones> {
    let all = || {
        let [rows, columns] = numbers(text, 'x')?;
        Some(Zones {
            rows: whole(rows)?,
            columns: whole(columns)?,
        })
    };
    all().ok_or_else(|| {
        CliError::input(format!("--zones {text:?}: expected ROWSxCOLUMNS")).hint("e.g. --zones 8x8")
    })
}

fn gate(text: &str) -> Result<TimeGate> {
    let all = || {
        let [start_ps, bin_width_ps, bins] = numbers(text, ',')?;
        Some(TimeGate {
            start_ps,
            bin_width_ps,
            bins: whole(bins)?,
        })
    };
    all().ok_or_else(|| {
        CliError::input(format!("--gate {text:?}: expected START,WIDTH,BINS"))
            .hint("e.g. --gate 0,250,128 for 128 bins of 250 ps from the laser's pulse on")
    })
}

fn afterpulsing(text: &str) -> Result<Afterpulsing> {
    let [probability, decay_ps] = numbers(text, ',').ok_or_else(|| {
        CliError::input(format!("--afterpulsing {text:?}: expected P,DECAY"))
            .hint("e.g. --afterpulsing 0.01,50000 for 1 % and 50 ns")
    })?;
    Ok(Afterpulsing {
        probability,
        decay_ps,
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
        assert_eq!(
            dead_time("free:100,20000,1e5").unwrap(),
            DeadTime::FreeRunning {
                pulses: 100,
                dead_ps: 2e4,
                period_ps: 1e5
            }
        );
        assert_eq!(
            zones("8x4").unwrap(),
            Zones {
                rows: 8,
                columns: 4
            }
        );
        assert_eq!(gate("-1144,88,128").unwrap().start_ps, -1144.0);
        assert_eq!(afterpulsing("0.01,50000").unwrap().probability, 0.01);
        for error in [
            zones("8").unwrap_err(),
            zones("8.5x2").unwrap_err(),
            gate("0,250").unwrap_err(),
            gate("0,250,-1").unwrap_err(),
            afterpulsing("0.1").unwrap_err(),
            dead_time("free:0.5,1,2").unwrap_err(),
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
    fn a_measured_pulse_is_read_from_a_table_whose_time_0_is_the_arrival() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pulse.csv");
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            pulse(&format!("file:{}", path.display()))
        };
        let made = read("time_ps,energy\n# measured\n-8,0.1\n0,0.7\n\n8,0.2\n").unwrap();
        let expected = Pulse::Sampled {
            bin_width_ps: 8.0,
            values: vec![0.1, 0.7, 0.2],
            zero_bin: Some(1.0),
        };
        assert_eq!(made, expected);
        for (text, says) in [
            ("1,2\n", "at least two lines"),
            ("-8,1\n0,2\n9,3\n", "line 3: expected the time 8"),
            ("0,1\n0,2\n", "expected a time after 0"),
            ("10,1\n20,2\n", "expected time 0"),
            ("-8,1\n0,x\n", "line 2: expected a time and an energy"),
            ("-8,1,4\n0,1,4\n", "line 1: expected a time and an energy"),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.message.contains(says), "{text:?}: {}", error.message);
            assert!(error.message.contains("pulse.csv"));
        }
    }

    #[test]
    fn a_preset_is_the_base_that_options_change() {
        use crate::args::PresetArg;
        use picofarm_sensor::Preset;
        let args = SensorArgs {
            preset: Some(PresetArg(Preset::Tmf8828)),
            zones: Some("4x4".into()),
            ..SensorArgs::default()
        };
        let made = settings(&args).unwrap();
        let expected = Sensor {
            zones: Some(Zones {
                rows: 4,
                columns: 4,
            }),
            ..Preset::Tmf8828.sensor()
        };
        assert_eq!(made, expected);
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
