//! Zones, the detector's gate and crosstalk.

use picofarm_sensor::{
    Afterpulsing, Crosstalk, DeadTime, Frame, Histograms, PS_PER_M, Preset, Scale, Sensed, Sensor,
    TimeGate, Zones, sense_image,
};

use crate::common::{FINE_PS, counts, fixed, plain, rate, transients};

const FRAME: Frame = Frame {
    width: 6,
    start_ps: 100.0,
};

fn image(sensor: &Sensor, h: &[f32], bins: usize) -> Sensed {
    let h = Histograms {
        transient: h,
        two_bounce: None,
        bins,
        bin_width_ps: FINE_PS,
    };
    sense_image(sensor, &h, &FRAME, 3, 0).unwrap()
}

fn fails(sensor: &Sensor, pixels: usize) -> String {
    let h = vec![1.0; pixels * 10];
    let h = Histograms {
        transient: &h,
        two_bounce: None,
        bins: 10,
        bin_width_ps: FINE_PS,
    };
    sense_image(sensor, &h, &FRAME, 0, 0)
        .unwrap_err()
        .to_string()
}

#[test]
fn an_image_without_wide_pixels_is_measured_as_its_histograms() {
    let h = transients(24, 90);
    for sensor in [Sensor::default(), fixed(3.0)] {
        let plain = crate::common::sense(&sensor, &h, 90, 3);
        assert_eq!(image(&sensor, &h, 90), plain);
    }
}

#[test]
fn a_zone_is_the_mean_of_its_pixels() {
    // 4 rows of 6 pixels; 2x3 zones of 2x2 pixels.
    let h: Vec<f32> = (0..24 * 5).map(|i| (i * i % 97) as f32).collect();
    let sensor = Sensor {
        zones: Some(Zones {
            rows: 2,
            columns: 3,
        }),
        ..plain(1.0)
    };
    let s = image(&sensor, &h, 5);
    assert_eq!(rate(&s).len(), 6 * 5);
    for zone in 0..6 {
        let (row, column) = (zone / 3 * 2, zone % 3 * 2);
        for bin in 0..5 {
            let at = |r: usize, c: usize| h[((row + r) * 6 + column + c) * 5 + bin];
            let mean = (at(0, 0) + at(0, 1) + at(1, 0) + at(1, 1)) / 4.0;
            assert_eq!(rate(&s)[zone * 5 + bin], mean, "{zone} {bin}");
        }
    }
    // One zone for each pixel changes nothing.
    let each = Sensor {
        zones: Some(Zones {
            rows: 4,
            columns: 6,
        }),
        ..plain(1.0)
    };
    assert_eq!(rate(&image(&each, &h, 5)), &h[..]);
}

#[test]
fn the_detectors_bins_divide_the_light_and_count_what_is_outside() {
    // Bins of 8 ps from 100 ps; the detector has three of 20 ps from 110 ps.
    let h: Vec<f32> = (1..=6 * 10).map(|i| i as f32).collect();
    let gate = TimeGate {
        start_ps: 110.0,
        bin_width_ps: 20.0,
        bins: 3,
    };
    let sensor = Sensor {
        gate: Some(gate),
        dark_per_bin: 0.5,
        ..plain(2.0)
    };
    let s = image(&sensor, &h, 10);
    assert_eq!((s.bins, s.bin_width_ps), (3, 20.0));
    // 110 to 130 ps: the rest of bin 1 (6 of 8), bin 2, and 6 of 8 of bin 3.
    let first = 2.0 * (0.75 * 2.0 + 3.0 + 0.75 * 4.0) + 0.5;
    assert!((rate(&s)[0] - first).abs() < 1e-5, "{:?}", &rate(&s)[..3]);
    let inside: f64 = rate(&s).iter().map(|r| f64::from(*r) - 0.5).sum();
    let all: f64 = 2.0 * h.iter().map(|h| f64::from(*h)).sum::<f64>();
    assert!((inside + s.dropped.outside_photons - all).abs() < 1e-3);
    assert!((s.dropped.outside_share - s.dropped.outside_photons / all).abs() < 1e-9);
    // The peak that sets the scale is that of the detector's bins.
    let peak = Sensor {
        scale: Scale::Peak { photons: 50.0 },
        dark_per_bin: 0.0,
        ..sensor
    };
    let s = image(&peak, &h, 10);
    let mut peaks: Vec<f32> = rate(&s)
        .chunks(3)
        .map(|p| p.iter().copied().fold(0.0, f32::max))
        .collect();
    peaks.sort_by(f32::total_cmp);
    assert!((peaks[2] - 50.0).abs() < 1e-3, "{peaks:?}");
}

#[test]
fn crosstalk_gives_each_neighbour_its_share() {
    // A single bright pixel of a 4x6 image, and dark counts.
    let (bins, k, dark) = (4, 0.02f32, 0.1f32);
    let mut h = vec![0f32; 24 * bins];
    h[(6 + 2) * bins + 1] = 1000.0;
    let sensor = Sensor {
        dark_per_bin: f64::from(dark),
        crosstalk: Some(Crosstalk {
            probability: f64::from(k),
        }),
        ..plain(1.0)
    };
    let s = image(&sensor, &h, bins);
    for pixel in 0..24usize {
        let (row, column) = (pixel / 6, pixel % 6);
        let others = usize::from(row > 0)
            + usize::from(row < 3)
            + usize::from(column > 0)
            + usize::from(column < 5);
        let dark = dark * (1.0 + k * others as f32);
        let light = match row.abs_diff(1) + column.abs_diff(2) {
            0 => 1000.0,
            1 => 20.0,
            _ => 0.0,
        };
        for bin in 0..bins {
            let expected = dark + if bin == 1 { light } else { 0.0 };
            assert!(
                (rate(&s)[pixel * bins + bin] - expected).abs() < 1e-4,
                "{pixel} {bin}"
            );
        }
    }
    // The scale is that of a pixel's own light, and counts have the mean of the rate.
    let own = Sensor {
        scale: Scale::Peak { photons: 300.0 },
        poisson: true,
        ..sensor
    };
    let totals: f64 = (0..200)
        .map(|seed| {
            let h = Histograms {
                transient: &h,
                two_bounce: None,
                bins,
                bin_width_ps: FINE_PS,
            };
            let s = sense_image(&own, &h, &FRAME, seed, 0).unwrap();
            assert!((s.scale - 0.3).abs() < 1e-9);
            f64::from(counts(&s)[(6 + 3) * bins + 1])
        })
        .sum();
    let expected = 200.0 * (6.0 + 0.1 * 1.08);
    assert!(
        (totals - expected).abs() < 5.0 * expected.sqrt(),
        "{totals} {expected}"
    );
}

#[test]
fn an_image_is_the_same_on_any_number_of_threads() {
    let h = transients(24 * 25, 90);
    let sensor = Sensor {
        zones: Some(Zones {
            rows: 20,
            columns: 30,
        }),
        gate: Some(TimeGate {
            start_ps: 60.0,
            bin_width_ps: 12.0,
            bins: 64,
        }),
        crosstalk: Some(Crosstalk { probability: 0.01 }),
        afterpulsing: Some(Afterpulsing {
            probability: 0.05,
            decay_ps: 40.0,
        }),
        dark_per_bin: 0.2,
        rebin: 2,
        ..Sensor::default()
    };
    let free = Sensor {
        dead_time: Some(DeadTime::FreeRunning {
            pulses: 1000,
            dead_ps: 100.0,
            period_ps: 900.0,
        }),
        ..sensor.clone()
    };
    for sensor in [sensor, free] {
        let frame = Frame { width: 30, ..FRAME };
        let run = |threads| {
            let h = Histograms {
                transient: &h,
                two_bounce: None,
                bins: 90,
                bin_width_ps: FINE_PS,
            };
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap()
                .install(|| sense_image(&sensor, &h, &frame, 1, 0).unwrap())
        };
        let one = run(1);
        assert!(one == run(3) && counts(&one).iter().any(|c| *c > 0));
        assert_eq!(one.bins, 32);
    }
}

#[test]
fn what_does_not_fit_an_image_is_named() {
    let zones = |rows, columns| Sensor {
        zones: Some(Zones { rows, columns }),
        ..Sensor::default()
    };
    let error = fails(&zones(3, 3), 24);
    assert!(
        error.starts_with("sensor.zones: 3x3 zones do not divide the image of 4x6"),
        "{error}"
    );
    let error = fails(&zones(0, 3), 24);
    assert!(
        error.starts_with("sensor.zones: expected at least one"),
        "{error}"
    );
    let error = fails(&Sensor::default(), 25);
    assert!(error.starts_with("width: expected whole rows"), "{error}");
    let gate = |bin_width_ps, bins| Sensor {
        gate: Some(TimeGate {
            start_ps: 0.0,
            bin_width_ps,
            bins,
        }),
        ..Sensor::default()
    };
    assert!(fails(&gate(0.0, 5), 24).starts_with("sensor.gate.bin_width_ps"));
    assert!(fails(&gate(8.0, 0), 24).starts_with("sensor.gate.bins"));
    // Bins that start after all light.
    let late = Sensor {
        gate: Some(TimeGate {
            start_ps: 1e6,
            bin_width_ps: 8.0,
            bins: 5,
        }),
        ..Sensor::default()
    };
    assert!(fails(&late, 24).contains("within the detector's gate"));
    let loud = Sensor {
        crosstalk: Some(Crosstalk { probability: 0.5 }),
        ..Sensor::default()
    };
    assert!(fails(&loud, 24).starts_with("sensor.crosstalk.probability"));
    // Without an image.
    let h = Histograms {
        transient: &[1.0; 240],
        two_bounce: None,
        bins: 10,
        bin_width_ps: FINE_PS,
    };
    let error = picofarm_sensor::sense(&zones(2, 2), &h, 0, 0)
        .unwrap_err()
        .to_string();
    assert!(error.starts_with("sensor.zones: needs an image"), "{error}");
}

#[test]
fn presets_are_sound_and_files_may_differ_from_them() {
    for preset in Preset::ALL {
        let sensor = preset.sensor();
        sensor.check().unwrap();
        let text = format!(r#"{{"preset":{:?}}}"#, preset.name());
        assert_eq!(serde_json::from_str::<Sensor>(&text).unwrap(), sensor);
        assert!(!preset.source().is_empty() && !preset.assumed().is_empty());
        let zones = sensor.zones.unwrap();
        let text = format!(r#"{{"preset":{:?},"dark_per_bin":0.25}}"#, preset.name());
        let differs: Sensor = serde_json::from_str(&text).unwrap();
        assert_eq!((differs.dark_per_bin, differs.zones), (0.25, Some(zones)));
    }
    // A bin of ST's driver is 37.5348 mm of distance; 24 sums of four bins are 3.6 m.
    let st = Preset::Vl53l8ch.sensor().gate.unwrap();
    let reach = f64::from(st.bins) * st.bin_width_ps / PS_PER_M / 2.0;
    assert!((reach - 24.0 * 4.0 * 0.037_534_8).abs() < 1e-9);
    let error = serde_json::from_str::<Sensor>(r#"{"preset":"vl53l9"}"#)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("unknown variant `vl53l9`, expected one of `vl53l8ch`"),
        "{error}"
    );
    // Without the new fields, a sensor is written as before: keys of results stay the same.
    let text = serde_json::to_string(&Sensor::default()).unwrap();
    assert!(text.ends_with(r#""rebin":1,"dead_time":null}"#), "{text}");
}
