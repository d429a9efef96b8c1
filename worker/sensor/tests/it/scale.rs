//! The peak that sets the scale.

use picofarm_sensor::{Histograms, Jitter, Scale, Sensing, Sensor, Values};

use crate::common::{FINE_PS, fixed, rate, sense, transients};

#[test]
fn a_peak_that_was_found_before_gives_the_same_bits_in_every_draw() {
    let h = |p: usize, b: usize| {
        if b > 3 {
            1.0 / (1.0 + (p * 7 + b * 3) as f32 % 13.0)
        } else {
            0.0
        }
    };
    let values: Vec<f32> = (0..40 * 24).map(|i| h(i / 24, i % 24)).collect();
    let seen = Histograms {
        transient: &values,
        two_bounce: None,
        bins: 24,
        bin_width_ps: 128.0,
    };
    let compat = Jitter::Sb3dCompat { sigma_bins: 1.5 };
    let range = Scale::PeakRange {
        low: 100.0,
        high: 900.0,
    };
    for (sensor, known) in [
        (Sensor::default(), true),
        (
            Sensor {
                scale: range,
                ..Sensor::default()
            },
            true,
        ),
        // Each draw shifts the pulse differently.
        (
            Sensor {
                jitter: compat,
                scale: range,
                ..Sensor::default()
            },
            false,
        ),
        (
            Sensor {
                poisson: false,
                scale: range,
                ..Sensor::default()
            },
            true,
        ),
        (
            Sensor {
                scale: Scale::Fixed {
                    photons_per_unit: 50.0,
                },
                ..Sensor::default()
            },
            false,
        ),
    ] {
        let sensing = Sensing::new(sensor.clone(), seen.bins, seen.bin_width_ps).unwrap();
        let radiance = |seed, peak| {
            let mut out = vec![f32::NAN; 3];
            let found = sensing.radiance(&values, (seed, 4), peak, &mut out);
            (out, found.unwrap())
        };
        let (first, peak) = radiance(1, None);
        assert_eq!(peak.is_some(), known, "{sensor:?}");
        for seed in 2..6 {
            let plain = picofarm_sensor::sense(&sensor, &seen, seed, 4).unwrap();
            let photons: Vec<f32> = match &plain.values {
                Values::Counts(counts) => counts.iter().map(|n| *n as f32).collect(),
                Values::Rate(rate) => rate.clone(),
            };
            let expected: Vec<f32> = photons.iter().map(|n| n / plain.scale as f32).collect();
            let (again, _) = radiance(seed, peak);
            assert_eq!(again, expected, "{sensor:?}");
            assert_ne!(again, first);
        }
    }
}

#[test]
fn the_peak_of_the_median_pixel_is_what_was_asked_for() {
    let bins = 100;
    let h = transients(51, bins);
    // The two-bounce part alone sets the scale.
    let mut all = h.clone();
    all[7] = 1e6;
    let peak_of = |scale, seed, scene| {
        let sensor = Sensor {
            scale,
            poisson: false,
            ..Sensor::default()
        };
        let input = Histograms {
            transient: &all,
            two_bounce: Some(&h),
            bins,
            bin_width_ps: FINE_PS,
        };
        let s = picofarm_sensor::sense(&sensor, &input, seed, scene).unwrap();
        let two = sense(
            &Sensor {
                poisson: false,
                ..fixed(s.scale)
            },
            &h,
            bins,
            0,
        );
        let mut peaks: Vec<f32> = rate(&two)
            .chunks(bins)
            .map(|r| r.iter().copied().fold(0.0, f32::max))
            .collect();
        peaks.sort_unstable_by(f32::total_cmp);
        assert!((f64::from(peaks[25]) / s.peak_photons.unwrap() - 1.0).abs() < 1e-5);
        s.peak_photons.unwrap()
    };
    assert_eq!(peak_of(Scale::Peak { photons: 123.0 }, 1, 2), 123.0);
    let drawn: Vec<f64> = (0..40)
        .map(|i| peak_of(Scale::default(), i / 20, i % 20))
        .collect();
    assert!(drawn.iter().all(|p| (10.0..400.0).contains(p)));
    let mean = drawn.iter().sum::<f64>() / 40.0;
    assert!((mean - 205.0).abs() < 5.0 * 390.0 / (12.0f64 * 40.0).sqrt());
    assert!((0..40).all(|i| (0..i).all(|j| drawn[i] != drawn[j])));
}
