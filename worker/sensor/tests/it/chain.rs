//! The sensor model: the order of the chain, determinism, and dropped light.

use picofarm_sensor::{DeadTime, Sensor, crop, intensity, rebin, rebin_counts, rebin_errors};
use proptest::prelude::*;

use crate::common::{counts, fixed, plain, rate, sense, transients};

#[test]
fn counts_add_up_to_the_expected_total() {
    let h = transients(200, 300);
    let sensor = Sensor {
        dark_per_bin: 0.02,
        rebin: 3,
        ..fixed(3.0)
    };
    let s = sense(&sensor, &h, 300, 5);
    let light: f64 = 3.0 * h.iter().map(|h| f64::from(*h)).sum::<f64>();
    let expected = light + 0.02 * h.len() as f64 - s.dropped.outside_photons;
    let counted: f64 = counts(&s).iter().map(|c| f64::from(*c)).sum();
    assert!(s.dropped.outside_photons > 0.0);
    assert!((s.dropped.outside_share * light / s.dropped.outside_photons - 1.0).abs() < 1e-9);
    assert!(
        (counted - expected).abs() < 5.0 * expected.sqrt(),
        "{counted} {expected}"
    );
    // Without noise the sums agree up to rounding.
    let quiet = Sensor {
        poisson: false,
        ..sensor
    };
    let s = sense(&quiet, &h, 300, 5);
    let sum: f64 = rate(&s).iter().map(|r| f64::from(*r)).sum();
    assert!((sum / expected - 1.0).abs() < 1e-6, "{sum} {expected}");
}

#[test]
fn counts_have_the_mean_and_the_variance_of_the_rate() {
    // One bin per case; the seeds are the samples.
    let rates = [0.3f32, 7.0, 12.0, 400.0];
    let seeds = 4000;
    let (mut sum, mut squares) = ([0f64; 4], [0f64; 4]);
    let sensor = Sensor {
        poisson: true,
        ..plain(1.0)
    };
    for seed in 0..seeds {
        let s = sense(&sensor, &rates, 1, seed);
        for (i, c) in counts(&s).iter().enumerate() {
            sum[i] += f64::from(*c);
            squares[i] += f64::from(*c).powi(2);
        }
    }
    let n = seeds as f64;
    for (i, r) in rates.iter().enumerate() {
        let r = f64::from(*r);
        let mean = sum[i] / n;
        let var = squares[i] / n - mean * mean;
        assert!((mean - r).abs() < 5.0 * (r / n).sqrt(), "{r}: {mean}");
        // Var of the sample variance of a Poisson count: (r + 2r²)/n.
        let spread = ((r + 2.0 * r * r) / n).sqrt();
        assert!((var - r).abs() < 5.0 * spread, "{r}: {var}");
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let h = transients(500, 120);
    let sensor = Sensor {
        dark_per_bin: 0.1,
        rebin: 4,
        dead_time: None,
        ..Sensor::default()
    };
    let piled = Sensor {
        dead_time: Some(DeadTime::FirstPhoton { pulses: 500 }),
        ..sensor.clone()
    };
    let quiet = Sensor {
        poisson: false,
        ..sensor.clone()
    };
    for sensor in [sensor, piled, quiet] {
        let run = |threads| {
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap()
                .install(|| sense(&sensor, &h, 120, 42))
        };
        let one = run(1);
        assert!(one == run(2) && one == run(7));
        assert!(one != sense(&sensor, &h, 120, 43), "the seed matters");
    }
}

#[test]
fn a_pixels_counts_depend_on_its_place_and_not_on_its_neighbours() {
    let h = transients(30, 90);
    let all = sense(&fixed(2.0), &h, 90, 1);
    let first = sense(&fixed(2.0), &h[..10 * 90], 90, 1);
    assert!(counts(&all)[..10 * 90] == *counts(&first));
}

#[test]
fn adjacent_pixels_and_bins_are_uncorrelated() {
    let bins = 64;
    let h = vec![3.0f32; 4000 * bins];
    let sensor = Sensor {
        poisson: true,
        ..plain(1.0)
    };
    let s = sense(&sensor, &h, bins, 0);
    let c: Vec<f64> = counts(&s).iter().map(|c| f64::from(*c) - 3.0).collect();
    for lag in [1, 2, bins, bins + 1, 1000 * bins] {
        let n = c.len() - lag;
        let r: f64 = (0..n).map(|i| c[i] * c[i + lag]).sum::<f64>() / (3.0 * n as f64);
        assert!(r.abs() < 5.0 / (n as f64).sqrt(), "{lag}: {r}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn without_noise_the_sensor_is_linear(
        a in prop::collection::vec(0f32..1e3, 80),
        b in prop::collection::vec(0f32..1e3, 80),
    ) {
        let quiet = Sensor { poisson: false, rebin: 2, ..fixed(0.5) };
        let both: Vec<f32> = a.iter().zip(&b).map(|(a, b)| a + b).collect();
        let (ra, rb, rs) = (sense(&quiet, &a, 40, 0), sense(&quiet, &b, 40, 0), sense(&quiet, &both, 40, 0));
        for ((a, b), s) in rate(&ra).iter().zip(rate(&rb)).zip(rate(&rs)) {
            prop_assert!((a + b - s).abs() <= 1e-5 * s.abs() + 1e-6);
        }
    }

    #[test]
    fn rebinning_keeps_the_sums_it_says_it_keeps(
        h in prop::collection::vec(0f32..1e4, 3 * 29),
        factor in 1usize..=29,
    ) {
        let r = rebin(&h, 29, factor).unwrap();
        prop_assert_eq!(r.bins, 29 / factor);
        prop_assert_eq!(r.dropped_bins, 29 % factor);
        let kept = crop(&h, 29, 0..29 - r.dropped_bins).unwrap();
        let (a, b) = (intensity(&r.data, r.bins).unwrap(), intensity(&kept, 29 - r.dropped_bins).unwrap());
        for (a, b) in a.iter().zip(&b) {
            prop_assert!((a - b).abs() <= 1e-5 * b);
        }
        let e = rebin_errors(&h, 29, factor).unwrap();
        let squares: Vec<f32> = h.iter().map(|h| h * h).collect();
        for (e, s) in e.data.iter().zip(&rebin(&squares, 29, factor).unwrap().data) {
            prop_assert!((e * e - s).abs() <= 1e-5 * s);
        }
    }

    #[test]
    fn counting_then_summing_bins_is_the_chains_order(seed in 0u64..1000, factor in 1u32..7) {
        let h = transients(5, 100);
        let fine = sense(&fixed(1.5), &h, 100, seed);
        let coarse = sense(&Sensor { rebin: factor, ..fixed(1.5) }, &h, 100, seed);
        let summed = rebin_counts(counts(&fine), 100, factor as usize).unwrap();
        prop_assert_eq!(counts(&coarse), &summed.data[..]);
        prop_assert_eq!(coarse.bins, summed.bins);
        prop_assert_eq!(coarse.dropped.bins, summed.dropped_bins);
    }
}

#[test]
fn real_captures_are_summed_by_four_and_the_last_two_bins_are_dropped() {
    let h: Vec<f32> = (0..2 * 1502).map(|i| (i % 1502) as f32).collect();
    let r = rebin(&h, 1502, 4).unwrap();
    assert_eq!((r.bins, r.dropped_bins), (375, 2));
    assert_eq!(r.data[0], 6.0);
    assert_eq!(r.data[374], 4.0 * 1497.5);
    assert_eq!(r.data[375], 6.0);
    let s = sense(
        &Sensor {
            rebin: 4,
            ..plain(1.0)
        },
        &h,
        1502,
        0,
    );
    assert_eq!(rate(&s), r.data);
    assert_eq!((s.bins, s.bin_width_ps), (375, 32.0));
    assert_eq!(s.dropped.bins, 2);
    assert_eq!(s.dropped.bins_photons, 2.0 * (1500.0 + 1501.0));
}

#[test]
fn what_leaves_the_gate_is_dropped_and_counted() {
    let mut h = vec![0f32; 50];
    (h[0], h[49]) = (100.0, 10.0);
    let s = sense(
        &Sensor {
            poisson: false,
            ..fixed(1.0)
        },
        &h,
        50,
        0,
    );
    let inside: f64 = rate(&s).iter().map(|r| f64::from(*r)).sum();
    assert!((inside + s.dropped.outside_photons - 110.0).abs() < 1e-4);
    assert!((s.dropped.outside_share - s.dropped.outside_photons / 110.0).abs() < 1e-12);
    // A large part of the rise is before the first bin, and nearly all of the tail is after the
    // last.
    assert!(
        s.dropped.outside_photons > 20.0 && s.dropped.outside_photons < 60.0,
        "{s:?}"
    );
}

#[test]
fn a_faint_bin_beside_a_saturated_one_is_exact() {
    let mut h = vec![0f32; 700];
    (h[100], h[600]) = (4e7, 0.1);
    let quiet = Sensor {
        poisson: false,
        ..fixed(1.0)
    };
    let both = sense(&quiet, &h, 700, 0);
    h[100] = 0.0;
    let alone = sense(&quiet, &h, 700, 0);
    for b in 560..700 {
        assert_eq!(rate(&both)[b], rate(&alone)[b], "{b}");
    }
    assert!(rate(&both).iter().all(|r| r.is_finite() && *r >= 0.0));
    assert_eq!(rate(&both)[..50], [0.0; 50]);
    assert_eq!(rate(&both)[450..540], [0.0; 90]);
    // Saturated counts.
    let bright = vec![4e7f32; 64];
    let sensor = Sensor {
        poisson: true,
        rebin: 8,
        ..plain(1.0)
    };
    let s = sense(&sensor, &bright, 64, 3);
    for c in counts(&s) {
        assert!((f64::from(*c) - 3.2e8).abs() < 5.0 * 3.2e8f64.sqrt(), "{c}");
    }
}

#[test]
fn an_empty_scene_gives_nothing_but_dark_counts() {
    let h = vec![0f32; 20 * 30];
    let s = sense(&Sensor::default(), &h, 30, 0);
    assert!(counts(&s).iter().all(|c| *c == 0));
    assert_eq!((s.scale, s.peak_photons), (1.0, None));
    assert_eq!(s.dropped, Default::default());
    let dark = Sensor {
        dark_per_bin: 2.0,
        ..Sensor::default()
    };
    let total: u32 = counts(&sense(&dark, &h, 30, 0)).iter().sum();
    assert!(
        (f64::from(total) - 1200.0).abs() < 5.0 * 1200f64.sqrt(),
        "{total}"
    );
    let none = sense(&Sensor::default(), &[], 30, 0);
    assert!(counts(&none).is_empty());
}
