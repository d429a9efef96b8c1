//! Dead time of a free-running pixel, and afterpulses: closed forms and statistics.

use picofarm_sensor::{Afterpulsing, DeadTime, Histograms, Sensor};

use crate::common::{FINE_PS, counts, plain, rate, sense};

fn free(pulses: u64, dead_bins: f64, period_bins: f64) -> Option<DeadTime> {
    Some(DeadTime::FreeRunning {
        pulses,
        dead_ps: dead_bins * FINE_PS,
        period_ps: period_bins * FINE_PS,
    })
}

fn sum(values: &[f32]) -> f64 {
    values.iter().map(|v| f64::from(*v)).sum()
}

/// Mean counts of each bin over `pixels` equal pixels.
fn means(sensor: &Sensor, pixel: &[f32], pixels: usize, seed: u64) -> Vec<f64> {
    let noisy = Sensor {
        poisson: true,
        ..sensor.clone()
    };
    let s = sense(&noisy, &pixel.repeat(pixels), pixel.len(), seed);
    let mut means = vec![0.0; s.bins];
    for pixel in counts(&s).chunks(s.bins) {
        for (mean, c) in means.iter_mut().zip(pixel) {
            *mean += f64::from(*c) / pixels as f64;
        }
    }
    means
}

#[test]
fn a_constant_rate_is_counted_as_a_non_paralysable_detector_counts_it() {
    // Photons per bin and pulse from weak to fifty times the inverse of the dead time.
    for per_bin in [0.001f64, 0.05, 0.5, 5.0] {
        for (dead, period) in [(10.0, 40.0), (7.3, 40.0), (33.5, 40.25)] {
            let pulses = 20_000u64;
            let n = pulses as f64;
            // Dark counts arrive all the time, also outside the gate.
            let sensor = Sensor {
                dark_per_bin: per_bin * n,
                dead_time: free(pulses, dead, period),
                ..plain(1.0)
            };
            let s = sense(&sensor, &[0.0; 40], 40, 0);
            let expected = 40.0 * n * per_bin / (1.0 + per_bin * dead);
            let found = sum(rate(&s));
            // The pixel is live at the first pulse: at most a detection more than in the long run.
            // Above ten photons in a dead time it ticks like a clock, whose beat with the pulses
            // the expected counts average over 192 pulses.
            assert!(
                (found - expected).abs() < 4e-3 * expected + 1.0,
                "{per_bin} {dead} {period}: {found} {expected}"
            );
            let lost = 40.0 * n * per_bin - found;
            assert!((s.dropped.pile_up_photons - lost).abs() < 1e-3 * expected);
        }
    }
}

#[test]
fn drawn_counts_of_a_free_running_pixel_have_the_expected_mean() {
    let mut pixel: Vec<f32> = (0..60).map(|b| 4.0 + (b % 7) as f32).collect();
    (pixel[20], pixel[21], pixel[45]) = (500.0, 300.0, 200.0);
    let pulses = 400;
    for (dead, period, after) in [
        (12.0, 60.0, None),
        (25.5, 83.4, None),
        (12.0, 60.0, Some((0.02, 30.0))),
    ] {
        let sensor = Sensor {
            dark_per_bin: 2.0,
            dead_time: free(pulses, dead, period),
            afterpulsing: after.map(|(probability, decay)| Afterpulsing {
                probability,
                decay_ps: decay * FINE_PS,
            }),
            ..plain(1.0)
        };
        let expected = sense(&sensor, &pixel, 60, 0);
        let pixels = 2000;
        let found = means(&sensor, &pixel, pixels, 3);
        for (b, (found, expected)) in found.iter().zip(rate(&expected)).enumerate() {
            let expected = f64::from(*expected);
            // A bin has at most one count for a pulse, so its variance is below its mean. The
            // expected counts spread the ends of dead times evenly within a part of a bin.
            let allowed = 5.0 * (expected / pixels as f64).sqrt() + 5e-3 * expected;
            assert!(
                (found - expected).abs() < allowed,
                "{dead} {b}: {found} {expected}"
            );
        }
    }
}

#[test]
fn a_dead_time_that_ends_at_the_next_pulse_gives_the_first_photon_of_each() {
    // All light is in bin 5, and the pixel is blind for one period: it misses no pulse twice.
    let mut pixel = vec![0f32; 30];
    pixel[5] = 90.0;
    let (pulses, n) = (100, 100.0);
    let sensor = Sensor {
        dead_time: free(pulses, 20.0, 30.0),
        ..plain(1.0)
    };
    let coates = Sensor {
        dead_time: Some(DeadTime::FirstPhoton { pulses }),
        ..sensor.clone()
    };
    let (a, b) = (sense(&sensor, &pixel, 30, 0), sense(&coates, &pixel, 30, 0));
    let closed = n * (1.0 - (-90.0f64 / n).exp());
    assert!((sum(rate(&a)) - closed).abs() < 1e-3 && (sum(rate(&b)) - closed).abs() < 1e-3);
    let found = means(&sensor, &pixel, 4000, 1);
    let spread = (closed * (-90.0f64 / n).exp() / 4000.0).sqrt();
    assert!((found[5] - closed).abs() < 5.0 * spread, "{}", found[5]);
}

#[test]
fn a_free_running_pixel_without_photons_counts_nothing() {
    let sensor = Sensor {
        poisson: true,
        dead_time: free(1 << 40, 20.0, 30.0),
        ..plain(1.0)
    };
    let s = sense(&sensor, &[0.0; 30], 30, 0);
    assert!(counts(&s).iter().all(|c| *c == 0));
    // A single photon in 2^40 pulses is found.
    let mut pixel = vec![0f32; 30];
    pixel[7] = 1.0;
    let found = means(&sensor, &pixel, 3000, 2);
    assert!(
        (found[7] - 1.0).abs() < 5.0 / 3000f64.sqrt(),
        "{}",
        found[7]
    );
}

#[test]
fn afterpulses_are_geometric_clusters() {
    // All within the gate: a count has 1/(1 − p) descendants, and the sum of Poisson many such
    // clusters has the variance λ(1 + p)/(1 − p)² (Pólya–Aeppli).
    let (p, light) = (0.3f64, 40.0f64);
    let mut pixel = vec![0f32; 400];
    pixel[10] = light as f32;
    let sensor = Sensor {
        afterpulsing: Some(Afterpulsing {
            probability: p,
            decay_ps: 6.0 * FINE_PS,
        }),
        ..plain(1.0)
    };
    let quiet = sense(&sensor, &pixel, 400, 0);
    let mean = light / (1.0 - p);
    assert!((sum(rate(&quiet)) - mean).abs() < 1e-4 * mean);
    let pixels = 8000;
    let noisy = Sensor {
        poisson: true,
        ..sensor.clone()
    };
    let s = sense(&noisy, &pixel.repeat(pixels), 400, 4);
    let totals: Vec<f64> = counts(&s)
        .chunks(400)
        .map(|c| c.iter().map(|c| f64::from(*c)).sum())
        .collect();
    let n = pixels as f64;
    let found = totals.iter().sum::<f64>() / n;
    let variance = totals.iter().map(|t| (t - found).powi(2)).sum::<f64>() / n;
    let expected = light * (1.0 + p) / (1.0 - p).powi(2);
    assert!(
        (found - mean).abs() < 5.0 * (expected / n).sqrt(),
        "{found} {mean}"
    );
    // The sum is near to normal: its variance has the relative error √(2/n).
    assert!(
        (variance / expected - 1.0).abs() < 6.0 * (2.0 / n).sqrt(),
        "{variance} {expected}"
    );
    for (b, (found, expected)) in means(&sensor, &pixel, pixels, 5)
        .iter()
        .zip(rate(&quiet))
        .enumerate()
    {
        let expected = f64::from(*expected);
        let allowed = 6.0 * (2.0 * expected / n).sqrt() + 1e-3;
        assert!(
            (found - expected).abs() < allowed,
            "{b}: {found} {expected}"
        );
    }
    // The tail falls with the time constant.
    let tail = rate(&quiet);
    let decay = f64::from(tail[30] / tail[36]).ln();
    let kernel = 6.0 * (1.0 - p) / 6.0;
    assert!((decay / kernel - 1.0).abs() < 0.1, "{decay} {kernel}");
}

#[test]
fn timing_that_does_not_fit_the_bins_is_named() {
    let h = [1.0f32; 40];
    let histograms = Histograms {
        transient: &h,
        two_bounce: None,
        bins: 40,
        bin_width_ps: FINE_PS,
    };
    let fails = |dead, period, after: bool| {
        let sensor = Sensor {
            dead_time: free(10, dead, period),
            afterpulsing: after.then_some(Afterpulsing {
                probability: 0.95,
                decay_ps: 1.0,
            }),
            ..plain(1.0)
        };
        picofarm_sensor::sense(&sensor, &histograms, 0, 0)
            .unwrap_err()
            .to_string()
    };
    let error = fails(10.0, 39.0, false);
    assert!(
        error.starts_with("sensor.dead_time.period_ps: 312 ps are less than the gate"),
        "{error}"
    );
    let error = fails(10.0, 2e5, false);
    assert!(
        error.contains("200000 bins of 8.0 ps, at most 100000"),
        "{error}"
    );
    let error = fails(0.5, 40.0, false);
    assert!(
        error.starts_with("sensor.dead_time.dead_ps: 4 ps are less than a bin"),
        "{error}"
    );
    let error = fails(50.0, 40.0, false);
    assert!(error.contains("first_photon"), "{error}");
    let error = fails(10.0, 40.0, true);
    assert!(
        error.starts_with("sensor.afterpulsing.probability"),
        "{error}"
    );
    let both = Sensor {
        dead_time: Some(DeadTime::FirstPhoton { pulses: 5 }),
        afterpulsing: Some(Afterpulsing {
            probability: 0.1,
            decay_ps: 1.0,
        }),
        ..plain(1.0)
    };
    let error = both.check().unwrap_err().to_string();
    assert!(error.contains("free_running"), "{error}");
    // More detections than anyone would wait for.
    let endless = Sensor {
        dead_time: free(1 << 30, 1.0, 40.0),
        ..plain(1e8)
    };
    let error = picofarm_sensor::sense(&endless, &histograms, 0, 0)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("detections or afterpulses are more than"),
        "{error}"
    );
}
