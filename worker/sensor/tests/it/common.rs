//! Sensors and histograms for the tests.

use picofarm_sensor::{Histograms, Jitter, Pulse, Scale, Sensed, Sensor, Values};

/// Bins of 8 ps in metres, as in the real capture.
pub const FINE_PS: f64 = 8.0;

pub fn fixed(photons_per_unit: f64) -> Sensor {
    Sensor {
        scale: Scale::Fixed { photons_per_unit },
        ..Sensor::default()
    }
}

/// No blur, no noise.
pub fn plain(photons_per_unit: f64) -> Sensor {
    Sensor {
        pulse: Pulse::None {},
        jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
        poisson: false,
        ..fixed(photons_per_unit)
    }
}

pub fn sense(sensor: &Sensor, h: &[f32], bins: usize, seed: u64) -> Sensed {
    let h = Histograms {
        transient: h,
        two_bounce: None,
        bins,
        bin_width_ps: FINE_PS,
    };
    picofarm_sensor::sense(sensor, &h, seed, 0).unwrap()
}

pub fn counts(s: &Sensed) -> &[u32] {
    match &s.values {
        Values::Counts(c) => c,
        Values::Rate(_) => panic!("expected counts"),
    }
}

pub fn rate(s: &Sensed) -> &[f32] {
    match &s.values {
        Values::Rate(r) => r,
        Values::Counts(_) => panic!("expected rates"),
    }
}

/// Returns values like a pixel's transient, with a rise, a peak and a tail, in `pixels` variations.
pub fn transients(pixels: usize, bins: usize) -> Vec<f32> {
    (0..pixels * bins)
        .map(|i| {
            let (p, b) = ((i / bins) as f32, (i % bins) as f32);
            let at = b - 40.0 - p % 17.0;
            if at < 0.0 {
                0.0
            } else {
                (1.0 + p % 3.0) * (-at / 60.0).exp() + if at == 0.0 { 20.0 } else { 0.0 }
            }
        })
        .collect()
}
