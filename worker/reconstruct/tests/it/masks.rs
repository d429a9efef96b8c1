//! Shadow masks from rendered captures.

use crate::common;

use common::{Unstopped, measured, room};
use picofarm_reconstruct::{
    Measured,
    source::{CaptureSettings, Captures, Given, LIT_THRESHOLD, Times, given},
};
use picofarm_scene::{Scene, plato::PlatoObject};
use picofarm_settings::{Jitter, Pulse, Scale, Sensor};
use picofarm_transient::{Gate, render};

/// Renders a capture of each beam and adds it to all of these.
fn capture<const N: usize>(scene: &Scene, behind: [Option<Sensor>; N]) -> [Captures; N] {
    let settings = CaptureSettings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 0.0384,
            bins: 391,
        },
        samples: 2,
        seed: 3,
        sensor: None,
    };
    let mut all = behind.map(|sensor| {
        let laser = scene.laser.clone();
        let captures = Captures::new(scene.camera, laser, settings.gate, LIT_THRESHOLD);
        match sensor {
            Some(sensor) => captures.behind(&sensor, 7).unwrap(),
            None => captures,
        }
    });
    let mut alone = scene.clone();
    for (beam, of) in scene.laser.beams.iter().enumerate() {
        alone.laser.beams = vec![*of];
        let capture = render(&alone, &settings.render_settings(), &Unstopped).unwrap();
        for captures in &mut all {
            captures.add(beam, &capture.transient).unwrap();
        }
    }
    all
}

/// Counts the pixels and spots that are classified as lit (1) or shadowed (0), but are the
/// opposite.
fn wrong(truth: &Measured, of: &Measured, lit: u8) -> usize {
    let wrong = |q: &usize| {
        truth.used[*q] != 0 && of.used[*q] != 0 && truth.lit[*q] == 1 - lit && of.lit[*q] == lit
    };
    (0..truth.lit.len()).filter(wrong).count()
}

fn used(of: &Measured) -> usize {
    of.used.iter().filter(|u| **u != 0).count()
}

#[test]
fn fewer_pixels_are_falsely_lit_than_by_the_plain_threshold() {
    let (scene, rendered) = room(PlatoObject::Chair, 8, 64);
    let truth = measured(&scene, &rendered);
    let [plain, expected] = capture(&scene, [None, None]);
    let (plain, expected) = (plain.finish_plain(), expected.finish());
    assert_eq!(expected.spots.len(), truth.spots.len());
    let falsely_lit = [&plain, &expected].map(|m| wrong(&truth, m, 1));
    assert!(falsely_lit[1] * 2 < falsely_lit[0], "{falsely_lit:?}");
    // Most pixels are still used.
    let used = [&plain, &expected].map(used);
    assert!(used[1] * 10 > used[0] * 8, "{used:?}");
    expected.check().unwrap();
}

#[test]
fn photon_noise_and_ambient_light_make_few_masks_wrong() {
    let (scene, rendered) = room(PlatoObject::Chair, 8, 64);
    let truth = measured(&scene, &rendered);
    let sensor = |dark_per_bin| Sensor {
        pulse: Pulse::None {},
        jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
        scale: Scale::Peak { photons: 200.0 },
        dark_per_bin,
        ..Sensor::default()
    };
    let all = capture(&scene, [None, Some(sensor(0.0)), Some(sensor(10.0))]);
    let [ideal, dark, bright] = all.map(Captures::finish);
    let share = |m: &Measured| (wrong(&truth, m, 0) + wrong(&truth, m, 1)) as f64 / used(m) as f64;
    let shares = [&ideal, &dark, &bright].map(share);
    let used = [&ideal, &dark, &bright].map(used);
    let lit = [&ideal, &dark, &bright].map(|m| wrong(&truth, m, 1));
    println!(
        "wrong {shares:?}, falsely lit {lit:?}, used {used:?} of {}",
        truth.lit.len()
    );
    assert!(
        shares[1] < shares[0] + 0.01 && shares[2] < shares[0] + 0.02,
        "{shares:?}"
    );
    assert!(
        used[1] * 10 > used[0] * 9 && used[2] * 10 > used[0] * 8,
        "{used:?}"
    );
    bright.check().unwrap();
}

#[test]
fn a_detector_that_sums_bins_or_cannot_be_is_refused_by_field() {
    let (scene, _) = room(PlatoObject::Empty, 2, 8);
    let gate = Gate {
        start_m: 0.0,
        bin_width_m: 0.0384,
        bins: 391,
    };
    let refused = |sensor: Sensor| {
        let captures = Captures::new(scene.camera, scene.laser.clone(), gate, LIT_THRESHOLD);
        captures.behind(&sensor, 0).unwrap_err().to_string()
    };
    let sums = Sensor {
        rebin: 4,
        ..Sensor::default()
    };
    assert!(refused(sums).contains("sensor.rebin"));
    let negative = Sensor {
        dark_per_bin: -1.0,
        ..Sensor::default()
    };
    assert!(refused(negative).contains("sensor.dark_per_bin"));
}

#[test]
fn bins_much_narrower_than_the_pulse_show_the_same_pixels_lit() {
    let (scene, rendered) = room(PlatoObject::Chair, 4, 24);
    let spots: Vec<_> = (rendered.spots.iter())
        .map(|s| s.as_ref().map(|s| (s.point, s.path_m)))
        .collect();
    let truth = given(&Given {
        camera: scene.camera,
        laser: scene.laser.origin,
        spots: &spots,
        beams: &[0, 1, 2, 3],
        times: Times::Range(&rendered.truth.range),
        lit: &rendered.truth.visibility,
        mirror: &[0; 24 * 24],
    })
    .unwrap();
    let [coarse, fine] = [(0.0384, 391), (0.0048, 3128)].map(|(bin_width_m, bins)| {
        let gate = Gate {
            start_m: 0.0,
            bin_width_m,
            bins,
        };
        let settings = CaptureSettings {
            gate,
            samples: 16,
            seed: 3,
            sensor: None,
        };
        // 128 ps are 3.84 cm of path: one wide bin, eight narrow ones.
        let sensor = Sensor {
            pulse: Pulse::Analytic { fwhm_ps: 128.0 },
            jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
            scale: Scale::Peak { photons: 400.0 },
            poisson: false,
            ..Sensor::default()
        };
        let captures = Captures::new(scene.camera, scene.laser.clone(), gate, LIT_THRESHOLD);
        let mut captures = captures.behind(&sensor, 7).unwrap();
        let mut alone = scene.clone();
        for (beam, only) in scene.laser.beams.iter().enumerate() {
            alone.laser.beams = vec![*only];
            let capture = render(&alone, &settings.render_settings(), &Unstopped).unwrap();
            captures.add(beam, &capture.transient).unwrap();
        }
        captures.finish()
    });
    fine.check().unwrap();
    let lit = |m: &Measured| {
        (0..m.lit.len())
            .filter(|q| m.lit[*q] * m.used[*q] != 0)
            .count()
    };
    let [few, many] = [lit(&coarse), lit(&fine)];
    assert!(
        many * 10 > few * 8,
        "{many} pairs are lit in narrow bins, {few} in wide ones"
    );
    let off = |m: &Measured| {
        let both = |q: &usize| m.lit[*q] * m.used[*q] * truth.lit[*q] * truth.used[*q] != 0;
        let mut all: Vec<f32> = (0..m.lit.len())
            .filter(both)
            .map(|q| (m.tau[q] - truth.tau[q]).abs())
            .collect();
        all.sort_by(f32::total_cmp);
        all[all.len() / 2]
    };
    let [wide, narrow] = [off(&coarse), off(&fine)];
    assert!(
        narrow < wide,
        "times are off by {narrow} m in narrow bins, {wide} m in wide ones"
    );
}
