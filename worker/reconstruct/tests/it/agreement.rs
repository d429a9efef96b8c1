//! Measurements that agree are accepted, and those that cannot be right are refused with the
//! reason: in bins, with noise, and in rooms for which the thresholds were not chosen.

use crate::common;

use common::{Unstopped, room, small};
use picofarm_reconstruct::{
    Agreement, Measured, ReconstructError, Reconstruction, Settings, Unwatched, Verdict,
    source::{CaptureSettings, Disturbed, captures_of, from_truth, truth_of},
};
use picofarm_scene::{
    AssetLibrary, Scene, Vec3,
    furnished::{self, FurnishedSettings},
    plato::PlatoObject,
    primitive::{PrimitiveSettings, generate},
};
use picofarm_settings::{FloorPlan, Spots};
use picofarm_transient::{Gate, Rendered};

const BINS: Disturbed = Disturbed {
    bin_width_m: 0.0384,
    noise_m: 0.0,
    smooth_m: 0.0,
    flipped: 0.0,
    seed: 0,
};
const NOISY: Disturbed = Disturbed {
    noise_m: 0.02,
    flipped: 0.02,
    seed: 1,
    ..BINS
};

fn rooms() -> Vec<(Scene, Rendered)> {
    let settings = PrimitiveSettings {
        width: 48,
        height: 48,
        ..PrimitiveSettings::default()
    };
    let unseen = generate(41, &settings).unwrap();
    let rendered = truth_of(&unseen, &Unstopped).unwrap();
    vec![room(PlatoObject::Chair, 16, 48), (unseen, rendered)]
}

fn settings(accept_inconsistent: bool) -> Settings {
    Settings {
        nodes: 32,
        accept_inconsistent,
        ..small()
    }
}

fn begun(measured: Measured) -> Result<Agreement, String> {
    match Reconstruction::begin(measured, settings(false), &Unwatched) {
        Ok(begun) => Ok(begun.agreement().clone()),
        Err(e @ ReconstructError::Inconsistent { .. }) => Err(e.to_string()),
        Err(e) => panic!("{e}"),
    }
}

/// Excludes impossible measurements, as sources do.
fn clean(measured: &mut Measured) {
    let (pixels, eye) = (measured.pixels(), measured.camera.origin);
    for q in 0..measured.lit.len() {
        let spot = &measured.spots[q / pixels];
        let least = spot.path_m + (spot.point - eye).length();
        if measured.lit[q] != 0 && measured.tau[q] <= least {
            measured.used[q] = 0;
        }
    }
}

fn spots(measured: &mut Measured, to: impl Fn(Vec3) -> Vec3) {
    let camera = measured.camera;
    for spot in &mut measured.spots {
        let q = to(camera.to_camera(spot.point));
        spot.point = camera.origin + camera.right * q.x + camera.down * q.y + camera.forward * q.z;
        spot.direction = (spot.point - measured.laser).normalized();
    }
    clean(measured);
}

fn late(measured: &mut Measured, by: f32) {
    let lit = measured.lit.iter();
    for (tau, _) in measured
        .tau
        .iter_mut()
        .zip(lit)
        .filter(|(_, lit)| **lit != 0)
    {
        *tau += by;
    }
    clean(measured);
}

#[test]
fn consistent_measurements_agree() {
    for (scene, rendered) in rooms() {
        for how in [Disturbed::default(), BINS, NOISY] {
            let measured = from_truth(&scene, &rendered, &how).unwrap();
            let found = begun(measured).unwrap();
            assert_eq!(found.verdict, Verdict::Agrees, "{}: {found:?}", scene.name);
            assert!(found.reasons.is_empty() && found.times > 1000, "{found:?}");
        }
    }
}

#[test]
fn what_cannot_be_right_is_refused_with_the_reason() {
    type Wrong = (&'static str, fn(&mut Measured));
    let wrong: [Wrong; 7] = [
        ("is it exchanged for another", |m| {
            m.spots.swap(2, 11);
            clean(m);
        }),
        ("times of a pixel's spots give different depths", |m| {
            spots(m, |q| Vec3::new(-q.x, q.y, q.z));
        }),
        ("times of a pixel's spots give different depths", |m| {
            spots(m, |q| Vec3::new(q.x, -q.y, q.z));
        }),
        ("m of path too late; check where the gate begins", |m| {
            late(m, 0.1)
        }),
        ("m of path too early; check where the gate begins", |m| {
            late(m, -0.1)
        }),
        ("too early", |m| spots(m, |q| q * 1.1)),
        ("too late", |m| {
            m.tau.iter_mut().for_each(|tau| *tau *= 1.1);
        }),
    ];
    for (scene, rendered) in rooms() {
        for how in [BINS, NOISY] {
            for (reason, spoil) in &wrong {
                let mut measured = from_truth(&scene, &rendered, &how).unwrap();
                spoil(&mut measured);
                let refused = begun(measured).unwrap_err();
                assert!(
                    refused.contains(reason),
                    "{}: {reason}: {refused}",
                    scene.name
                );
            }
        }
    }
}

#[test]
fn a_gate_that_is_off_by_a_bin_is_doubtful_and_stated() {
    let (scene, rendered) = room(PlatoObject::Chair, 16, 48);
    let mut measured = from_truth(&scene, &rendered, &BINS).unwrap();
    late(&mut measured, 0.04);
    let found = begun(measured).unwrap();
    assert_eq!(found.verdict, Verdict::Doubtful, "{found:?}");
    assert!(found.reasons[0].contains("too late"), "{found:?}");
}

#[test]
fn late_times_of_one_part_of_the_image_are_no_shifted_clock() {
    let (scene, rendered) = room(PlatoObject::Chair, 16, 48);
    let mut measured = from_truth(&scene, &rendered, &BINS).unwrap();
    let pixels = measured.pixels();
    // Light of three bounces by way of the wall on the right arrives 15 cm later.
    for q in 0..measured.lit.len() {
        if q % pixels % 48 >= 20 && measured.lit[q] != 0 {
            measured.tau[q] += 0.15 * ((q / pixels) % 2) as f32;
        }
    }
    let said = match begun(measured) {
        Ok(found) => found.reasons.join("; "),
        Err(refused) => refused,
    };
    assert!(!said.contains("where the gate begins"), "{said}");
}

#[test]
fn light_of_three_bounces_in_rooms_of_other_shapes_is_no_shifted_clock() {
    let library = AssetLibrary::parametric();
    let gate = Gate {
        start_m: 1.0,
        bin_width_m: 0.0384,
        bins: 400,
    };
    let settings = CaptureSettings {
        gate,
        samples: 4,
        seed: 1,
        sensor: None,
    };
    for seed in [1, 3, 4] {
        let room = FurnishedSettings {
            spots: Spots::Grid(16),
            width: 48,
            height: 48,
            floor_plan: FloorPlan::Varied,
            ..FurnishedSettings::default()
        };
        let scene = furnished::generate(seed, &room, &library).unwrap();
        let right = captures_of(&scene, &settings, &|_, _| true).unwrap();
        let said = |by: f32| {
            let mut measured = right.clone();
            late(&mut measured, by);
            match begun(measured) {
                Ok(found) => found.reasons.join("; "),
                Err(refused) => refused,
            }
        };
        let clock = "where the gate begins";
        assert!(!said(0.0).contains(clock), "seed {seed}: {}", said(0.0));
        assert!(said(0.15).contains(clock), "seed {seed}: {}", said(0.15));
    }
}

/// In an open room most pixels are lit by every spot, so with inverted masks they are dark. In
/// rooms with many shadows, the error cannot be detected.
#[test]
fn masks_of_the_wrong_polarity_are_doubtful_in_an_open_room_where_times_follow_from_depth() {
    let (scene, rendered) = room(PlatoObject::Chair, 16, 48);
    let mut measured = from_truth(&scene, &rendered, &Disturbed::default()).unwrap();
    let (pixels, eye) = (measured.pixels(), measured.camera.origin);
    for q in 0..measured.lit.len() {
        let (spot, range) = (measured.spots[q / pixels], rendered.truth.range[q % pixels]);
        let x = eye + measured.ray(q % pixels) * range;
        measured.tau[q] = spot.path_m + (x - spot.point).length() + range;
        measured.lit[q] = 1 - measured.lit[q];
    }
    let said = match begun(measured) {
        Ok(found) => found.reasons.join("; "),
        Err(refused) => refused,
    };
    assert!(said.contains("polarity"), "{said:?}");
}

#[test]
fn inconsistent_measurements_can_be_accepted_and_say_so() {
    let (scene, rendered) = room(PlatoObject::Chair, 16, 48);
    let mut measured = from_truth(&scene, &rendered, &BINS).unwrap();
    measured.spots.swap(2, 11);
    clean(&mut measured);
    let begun = Reconstruction::begin(measured, settings(true), &Unwatched).unwrap();
    let found = begun.agreement();
    assert_eq!(found.verdict, Verdict::Contradicts);
    let (spot, off) = found.worst_spot.unwrap();
    assert!([2, 11].contains(&spot) && off > 0.15, "{found:?}");
}
