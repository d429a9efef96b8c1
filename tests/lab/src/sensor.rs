//! Measures the speed of the sensor model on one thread, for a scene of 256×256×637:
//! `just lab sensor`.

use picofarm_sensor::{
    Afterpulsing, Crosstalk, DeadTime, Frame, Histograms, Jitter, PS_PER_M, Pulse, Scale, Sensor,
    TimeGate, Values, Zones, sense_image,
};

/// Returns histograms similar to those of a furnished room: a dark start, a two-bounce peak, and a
/// tail of many bounces.
fn room(pixels: usize, bins: usize) -> (Vec<f32>, Vec<f32>) {
    let mut two = vec![0f32; pixels * bins];
    let mut all = vec![0f32; pixels * bins];
    for p in 0..pixels {
        let h = &mut all[p * bins..][..bins];
        let peak = bins / 8 + (p * 7919) % (bins / 3);
        for (b, h) in h.iter_mut().enumerate().skip(peak) {
            *h = 0.1 * (-((b - peak) as f32) / (bins as f32 / 6.0)).exp();
        }
        for spot in 0..25 {
            let at = (peak + spot * spot / 3).min(bins - 1);
            two[p * bins + at] += 1.0 / (1.0 + spot as f32);
        }
        for (h, two) in h.iter_mut().zip(&two[p * bins..]) {
            *h += two;
        }
    }
    (all, two)
}

/// Returns the CPU seconds of this process so far (Linux), so that other work on the machine does
/// not count.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").expect("the bench runs on Linux");
    let after_name = stat.rsplit(')').next().unwrap_or_default();
    let ticks = after_name.split_whitespace().skip(11).take(2);
    ticks
        .map(|t| t.parse::<f64>().expect("a number of ticks"))
        .sum::<f64>()
        / 100.0
}

/// Prints the table.
pub fn run() {
    let pixels = 256 * 256;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .expect("one thread can be started");
    let analytic = Sensor::default();
    let dark = Sensor {
        dark_per_bin: 0.01,
        ..analytic.clone()
    };
    let cases = [
        ("default", 637, 0.0384, analytic.clone()),
        (
            "no noise",
            637,
            0.0384,
            Sensor {
                poisson: false,
                ..analytic.clone()
            },
        ),
        (
            "noise alone",
            637,
            0.0384,
            Sensor {
                pulse: Pulse::None {},
                jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
                ..analytic.clone()
            },
        ),
        (
            "fixed scale",
            637,
            0.0384,
            Sensor {
                scale: Scale::Fixed {
                    photons_per_unit: 200.0,
                },
                ..analytic.clone()
            },
        ),
        ("dark counts", 637, 0.0384, dark),
        (
            "pile-up",
            637,
            0.0384,
            Sensor {
                dead_time: Some(DeadTime::FirstPhoton { pulses: 100_000 }),
                ..analytic.clone()
            },
        ),
        (
            "free running",
            637,
            0.0384,
            Sensor {
                dead_time: Some(DeadTime::FreeRunning {
                    pulses: 100_000,
                    dead_ps: 20_000.0,
                    period_ps: 100_000.0,
                }),
                ..analytic.clone()
            },
        ),
        (
            "afterpulsing",
            637,
            0.0384,
            Sensor {
                afterpulsing: Some(Afterpulsing {
                    probability: 0.01,
                    decay_ps: 10_000.0,
                }),
                ..analytic.clone()
            },
        ),
        (
            "crosstalk",
            637,
            0.0384,
            Sensor {
                crosstalk: Some(Crosstalk { probability: 0.01 }),
                ..analytic.clone()
            },
        ),
        (
            "250 ps gate",
            637,
            0.0384,
            Sensor {
                gate: Some(TimeGate {
                    start_ps: 0.0,
                    bin_width_ps: 250.0,
                    bins: 340,
                }),
                ..analytic.clone()
            },
        ),
        (
            "8x8 zones",
            637,
            0.0384,
            Sensor {
                zones: Some(Zones {
                    rows: 8,
                    columns: 8,
                }),
                ..analytic.clone()
            },
        ),
        ("427 ps", 128, 0.128, analytic.clone()),
        (
            "8 ps to 32 ps",
            1502,
            0.002_398_34,
            Sensor {
                rebin: 4,
                ..analytic
            },
        ),
    ];
    for (name, bins, bin_width_m, sensor) in cases {
        let (transient, two) = room(pixels, bins);
        let input = Histograms {
            transient: &transient,
            two_bounce: Some(&two),
            bins,
            bin_width_ps: bin_width_m * PS_PER_M,
        };
        let frame = Frame {
            width: 256,
            start_ps: PS_PER_M,
        };
        let start = cpu_seconds();
        let sensed = pool
            .install(|| sense_image(&sensor, &input, &frame, 1, 0))
            .expect("the settings are sound");
        let seconds = cpu_seconds() - start;
        let photons: f64 = match &sensed.values {
            Values::Counts(c) => c.iter().map(|c| f64::from(*c)).sum(),
            Values::Rate(r) => r.iter().map(|r| f64::from(*r)).sum(),
        };
        let mb = transient.len() as f64 * 4.0 / 1e6;
        println!(
            "{name:14} {bins:5} bins: {seconds:6.2} CPU-s, {:5.0} MB/CPU-s of f32 transient, {photons:.2e} photons",
            mb / seconds
        );
    }
}
