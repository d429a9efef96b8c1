//! Sensor settings as stored in files, and invalid settings.

use picofarm_sensor::{Histograms, Jitter, PS_PER_M, Pulse, Scale, Sensor, sense};

const FINE_PS: f64 = 8.0;

fn fixed(photons_per_unit: f64) -> Sensor {
    Sensor {
        scale: Scale::Fixed { photons_per_unit },
        ..Sensor::default()
    }
}

#[test]
fn unusable_settings_and_histograms_are_named() {
    let of = |text: &str| {
        let sensor: Sensor = serde_json::from_str(text).unwrap();
        sensor.check().unwrap_err().to_string()
    };
    for (text, start) in [
        (
            r#"{"pulse":{"kind":"analytic","fwhm_ps":-1}}"#,
            "sensor.pulse.fwhm_ps: -1 lies outside",
        ),
        (
            r#"{"pulse":{"kind":"sampled","bin_width_ps":8,"values":[1,-2]}}"#,
            "sensor.pulse.values[1]: expected",
        ),
        (
            r#"{"pulse":{"kind":"sampled","bin_width_ps":8,"values":[0,0]}}"#,
            "sensor.pulse.values: expected some energy",
        ),
        (
            r#"{"pulse":{"kind":"sampled","bin_width_ps":8,"values":[1],"zero_bin":1}}"#,
            "sensor.pulse.zero_bin",
        ),
        (
            r#"{"scale":{"kind":"peak_range","low":5,"high":4}}"#,
            "sensor.scale.high: 4 lies outside 5..=",
        ),
        (r#"{"rebin":0}"#, "sensor.rebin: 0 lies outside 1..="),
        (r#"{"dark_per_bin":-0.1}"#, "sensor.dark_per_bin"),
        (
            r#"{"dead_time":{"kind":"first_photon","pulses":0}}"#,
            "sensor.dead_time.pulses",
        ),
    ] {
        let error = of(text);
        assert!(error.starts_with(start), "{error}");
    }
    for text in [
        r#"{"jitters":1}"#,
        r#"{"jitter":{"kind":"gaussian","fwhm":5}}"#,
        r#"{"pulse":{"kind":"none","fwhm_ps":5}}"#,
    ] {
        let error = serde_json::from_str::<Sensor>(text)
            .unwrap_err()
            .to_string();
        assert!(error.contains("unknown field"), "{error}");
    }
    let fails = |h: &[f32], sensor: &Sensor| {
        let h = Histograms {
            transient: h,
            two_bounce: None,
            bins: 4,
            bin_width_ps: FINE_PS,
        };
        sense(sensor, &h, 0, 0).unwrap_err().to_string()
    };
    let nan = [0.0, 1.0, 1.0, 1.0, 0.0, 1.0, f32::NAN, 0.0];
    let error = fails(&nan, &fixed(1.0));
    assert!(
        error.starts_with("transient[pixel 1][bin 2]: expected a finite"),
        "{error}"
    );
    let unblurred = Sensor {
        pulse: Pulse::None {},
        jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
        ..fixed(5e9)
    };
    let error = fails(&[0.0, 0.0, 1.0, 0.0], &unblurred);
    assert!(error.contains("[bin 2]: 5.000e9 photons"), "{error}");
    let error = fails(&[1.0; 7], &fixed(1.0));
    assert!(
        error.starts_with("transient: expected a whole number"),
        "{error}"
    );
    let error = fails(
        &[1.0; 8],
        &Sensor {
            rebin: 5,
            ..fixed(1.0)
        },
    );
    assert!(error.starts_with("rebin: expected 1 to 4"), "{error}");
    let dark = Histograms {
        transient: &[1.0; 4],
        two_bounce: Some(&[0.0; 4]),
        bins: 4,
        bin_width_ps: FINE_PS,
    };
    let error = sense(&Sensor::default(), &dark, 0, 0)
        .unwrap_err()
        .to_string();
    assert!(
        error.starts_with("sensor.scale: the two-bounce part"),
        "{error}"
    );
}

#[test]
fn settings_survive_a_round_trip_and_the_default_is_the_methods() {
    let sensor: Sensor = serde_json::from_str("{}").unwrap();
    assert_eq!(sensor, Sensor::default());
    sensor.check().unwrap();
    let text = serde_json::to_string(&sensor).unwrap();
    assert_eq!(serde_json::from_str::<Sensor>(&text).unwrap(), sensor);
    assert_eq!(sensor.pulse, Pulse::Analytic { fwhm_ps: 128.0 });
    assert_eq!(sensor.jitter, Jitter::Gaussian { fwhm_ps: 50.0 });
    // 0.0384 m of path are 128.1 ps, 0.00239834 m are 8 ps.
    assert!((0.0384 * PS_PER_M - 128.089).abs() < 1e-3);
    assert!((0.002_398_34 * PS_PER_M - 8.0).abs() < 1e-5);
}
