//! The pulse and the jitter on a histogram's bins.

use picofarm_sensor::{Jitter, Kernel, Pulse, Sensor};

const FINE_PS: f64 = 8.0;

fn variance(k: &Kernel) -> f64 {
    let at = |i: usize| (k.first + i as i64) as f64;
    let mean: f64 = k.taps.iter().enumerate().map(|(i, t)| at(i) * t).sum();
    let squares = k.taps.iter().enumerate();
    squares.map(|(i, t)| (at(i) - mean).powi(2) * t).sum()
}

/// Returns the full width at half maximum in bins, between interpolated crossings.
fn fwhm(k: &Kernel) -> f64 {
    let largest = k.taps.iter().copied().fold(0.0, f64::max);
    let half = largest / 2.0;
    let left = k.taps.iter().position(|t| *t >= half).unwrap();
    let right = k.taps.iter().rposition(|t| *t >= half).unwrap();
    let up = (k.taps[left] - half) / (k.taps[left] - k.taps[left - 1]);
    let down = (k.taps[right] - half) / (k.taps[right] - k.taps[right + 1]);
    (right - left) as f64 + up + down
}

#[test]
fn the_pulse_sums_to_one_has_the_stated_width_and_peaks_at_zero() {
    for (fwhm_ps, bin_ps) in [(128.0, 1.0), (128.0, 8.0), (60.0, 0.5), (1000.0, 8.0)] {
        let sensor = Sensor {
            pulse: Pulse::Analytic { fwhm_ps },
            jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
            ..Sensor::default()
        };
        let k = Kernel::new(&sensor, bin_ps).unwrap();
        assert!((k.taps.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!(k.taps.iter().all(|t| *t >= 0.0 && t.is_finite()));
        let measured = fwhm(&k) * bin_ps;
        assert!(
            (measured / fwhm_ps - 1.0).abs() < 0.01,
            "{fwhm_ps}: {measured}"
        );
        let largest = k.taps.iter().copied().fold(0.0, f64::max);
        assert_eq!(k.taps[(-k.first) as usize], largest);
        // A Gaussian rise and an exponential tail.
        let tail = |t: f64| k.taps[((t / bin_ps) as i64 - k.first) as usize];
        let tau = fwhm_ps * 2.0 / 2.813_725;
        let (a, b) = (tail(fwhm_ps), tail(2.0 * fwhm_ps));
        assert!(
            ((a / b).ln() * tau / fwhm_ps - 1.0).abs() < 0.03,
            "{fwhm_ps} {bin_ps}"
        );
    }
}

#[test]
fn jitter_of_50_ps_is_a_gaussian_of_21_23_ps() {
    let sensor = |fwhm_ps| Sensor {
        pulse: Pulse::None {},
        jitter: Jitter::Gaussian { fwhm_ps },
        ..Sensor::default()
    };
    let k = Kernel::new(&sensor(50.0), 1.0).unwrap();
    // Integration over bins adds the bin's own variance, 1/12.
    let sigma = (variance(&k) - 1.0 / 12.0).sqrt();
    assert!((sigma / (50.0 / 2.354_82) - 1.0).abs() < 1e-3, "{sigma}");
    assert!((fwhm(&k) / 50.0 - 1.0).abs() < 0.01);
    // With bins of 8 ps: 2.654 bins.
    let k = Kernel::new(&sensor(50.0), FINE_PS).unwrap();
    let sigma = (variance(&k) - 1.0 / 12.0).sqrt();
    assert!((sigma / 2.654 - 1.0).abs() < 2e-3, "{sigma}");
    // The kernel is symmetric.
    let n = k.taps.len();
    assert_eq!(k.first, -(n as i64 / 2));
    for i in 0..n {
        assert!((k.taps[i] - k.taps[n - 1 - i]).abs() < 1e-9);
    }
}

#[test]
fn variances_of_pulse_and_jitter_add() {
    let of = |pulse, jitter| {
        let sensor = Sensor {
            pulse,
            jitter: Jitter::Gaussian { fwhm_ps: jitter },
            ..Sensor::default()
        };
        variance(&Kernel::new(&sensor, 2.0).unwrap())
    };
    let both = of(Pulse::default(), 50.0);
    let apart = of(Pulse::default(), 0.0) + of(Pulse::None {}, 50.0) - 1.0 / 12.0;
    assert!((both / apart - 1.0).abs() < 1e-3, "{both} {apart}");
}

#[test]
fn a_pulse_sampled_in_the_histograms_bins_is_kept_as_it_is() {
    let values = vec![0.0, 1.0, 4.0, 10.0, 3.0, 2.0];
    let sensor = |bin_width_ps, zero_bin| Sensor {
        pulse: Pulse::Sampled {
            bin_width_ps,
            values: values.clone(),
            zero_bin,
        },
        jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
        ..Sensor::default()
    };
    let k = Kernel::new(&sensor(FINE_PS, None), FINE_PS).unwrap();
    assert_eq!(k.first, -2);
    for (tap, v) in k.taps.iter().zip(&values[1..]) {
        assert!((tap - v / 20.0).abs() < 1e-12, "{k:?}");
    }
    assert_eq!(
        Kernel::new(&sensor(FINE_PS, Some(1.0)), FINE_PS)
            .unwrap()
            .first,
        0
    );
    // With bins of 24 ps and the zero in a bin's middle, whole samples add up.
    let k = Kernel::new(&sensor(FINE_PS, Some(1.0)), 3.0 * FINE_PS).unwrap();
    for (tap, sum) in k.taps.iter().zip([5.0, 15.0]) {
        assert!((tap - sum / 20.0).abs() < 1e-9, "{k:?}");
    }
}
