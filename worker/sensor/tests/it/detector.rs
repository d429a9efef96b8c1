//! Pile-up and jitter.

use picofarm_sensor::{DeadTime, Jitter, Sensor};

use crate::common::{counts, plain, rate, sense};

#[test]
fn first_photon_pile_up_follows_coates() {
    let bins = 20;
    let pixel: Vec<f32> = (0..bins).map(|b| 10.0 * (b % 5) as f32).collect();
    let pulses = 300u64;
    let n = pulses as f64;
    let pixels = 4000;
    let h = pixel.repeat(pixels);
    let sensor = Sensor {
        dead_time: Some(DeadTime::FirstPhoton { pulses }),
        ..plain(1.0)
    };
    // Coates 1968: N·exp(−Σ earlier)·(1 − exp(−r)).
    let mut earlier = 0.0f64;
    let expected: Vec<f64> = pixel
        .iter()
        .map(|r| {
            let r = f64::from(*r) / n;
            let e = n * (-earlier).exp() * (1.0 - (-r).exp());
            earlier += r;
            e
        })
        .collect();
    let quiet = sense(&sensor, &h, bins, 0);
    for (r, e) in rate(&quiet).iter().zip(&expected) {
        assert!((f64::from(*r) - e).abs() < 1e-4);
    }
    let lost = quiet.dropped.pile_up_photons / pixels as f64;
    let all: f64 = pixel.iter().map(|r| f64::from(*r)).sum();
    assert!((all - lost - expected.iter().sum::<f64>()).abs() < 1e-6);
    let noisy = Sensor {
        poisson: true,
        ..sensor.clone()
    };
    let s = sense(&noisy, &h, bins, 9);
    for (b, e) in expected.iter().enumerate() {
        let c: Vec<f64> = counts(&s).chunks(bins).map(|c| f64::from(c[b])).collect();
        let m = pixels as f64;
        let mean = c.iter().sum::<f64>() / m;
        let var = c.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / m;
        // Each bin of a multinomial is binomial.
        let wanted = e * (1.0 - e / n);
        assert!((mean - e).abs() <= 5.0 * (wanted / m).sqrt(), "{b}");
        assert!((var - wanted).abs() <= 6.0 * (wanted + 2.0 * wanted * wanted).sqrt() / m.sqrt());
    }
    let most = counts(&s).chunks(bins).map(|c| c.iter().sum::<u32>()).max();
    assert!(u64::from(most.unwrap()) <= pulses);
    // Many pulses, so no pile-up.
    let many = Sensor {
        dead_time: Some(DeadTime::FirstPhoton { pulses: 1 << 40 }),
        ..sensor
    };
    for (a, b) in rate(&sense(&many, &pixel, bins, 0)).iter().zip(&pixel) {
        assert!((a - b).abs() < 1e-4);
    }
}

#[test]
fn sb3d_jitter_shifts_all_pixels_alike_by_a_floored_normal_number() {
    let mut h = vec![0f32; 3 * 101];
    for p in 0..3 {
        h[p * 101 + 50] = 1.0;
    }
    let sensor = Sensor {
        jitter: Jitter::Sb3dCompat { sigma_bins: 2.654 },
        ..plain(1.0)
    };
    let seeds = 4000;
    let (mut sum, mut squares) = (0.0, 0.0);
    for seed in 0..seeds {
        let s = sense(&sensor, &h, 101, seed);
        let at = rate(&s).iter().position(|r| *r == 1.0).unwrap() as i64;
        assert_eq!(at - 50, s.shift_bins);
        assert!(rate(&s)[..101] == rate(&s)[202..]);
        sum += s.shift_bins as f64;
        squares += (s.shift_bins as f64).powi(2);
    }
    let n = f64::from(seeds as u32);
    let mean = sum / n;
    let sigma = (squares / n - mean * mean - 1.0 / 12.0).sqrt();
    assert!((mean + 0.5).abs() < 5.0 * 2.654 / n.sqrt(), "{mean}");
    assert!((sigma / 2.654 - 1.0).abs() < 0.06, "{sigma}");
}
