//! Unusable input is refused by name; input with little information gives a defined result; there
//! is never NaN.

use crate::common;

use common::{measured, room, small};
use picofarm_reconstruct::{
    Measured, ReconstructError, Reconstructed, Settings, Unwatched, reconstruct,
    source::{Captures, LIT_THRESHOLD},
};
use picofarm_scene::{Material, plato::PlatoObject};
use picofarm_transient::Gate;

fn input() -> Measured {
    let (scene, rendered) = room(PlatoObject::Chair, 2, 48);
    measured(&scene, &rendered)
}

fn refused(measured: Measured, settings: Settings) -> String {
    match reconstruct(measured, settings, &Unwatched) {
        Err(e @ ReconstructError::Invalid { .. }) => e.to_string(),
        Err(e) => panic!("{e}"),
        Ok(_) => panic!("it was taken"),
    }
}

fn finite(made: &Reconstructed) {
    assert!(made.field.logit.iter().all(|u| u.is_finite()));
}

#[test]
fn settings_out_of_range_are_named() {
    for (settings, name) in [
        (
            Settings {
                nodes: 3,
                ..small()
            },
            "nodes: is 3",
        ),
        (
            Settings {
                iterations: 0,
                ..small()
            },
            "iterations: is 0",
        ),
        (
            Settings {
                batch: 0,
                ..small()
            },
            "batch: is 0",
        ),
    ] {
        assert!(refused(input(), settings).contains(name));
    }
}

#[test]
fn no_lit_pixel_and_no_spot_are_refused() {
    let mut dark = input();
    dark.lit.fill(0);
    assert!(refused(dark, small()).contains("no pixel is lit"));
    let mut none = input();
    none.spots.clear();
    assert!(refused(none, small()).contains("no usable spot"));
}

#[test]
fn arrays_of_another_size_and_impossible_times_are_refused() {
    let mut short = input();
    short.tau.pop();
    assert!(refused(short, small()).starts_with("tau: has "));
    for time in [f32::NAN, f32::INFINITY, -1.0, 0.1] {
        let mut wrong = input();
        let at = (0..wrong.lit.len())
            .find(|&q| wrong.lit[q] != 0 && wrong.used[q] != 0)
            .unwrap();
        wrong.tau[at] = time;
        let said = refused(wrong, small());
        assert!(
            said.starts_with("tau[0][") && said.contains("mark the pixel as unused"),
            "{said}"
        );
    }
}

#[test]
fn one_spot_and_masks_all_ones_give_a_stated_result() {
    let (scene, rendered) = room(PlatoObject::Chair, 1, 48);
    let made = reconstruct(measured(&scene, &rendered), small(), &Unwatched).unwrap();
    assert!(
        made.notes.iter().any(|n| n.starts_with("one spot")),
        "{:?}",
        made.notes
    );
    finite(&made);
    let mut bright = input();
    for q in 0..bright.lit.len() {
        if bright.lit[q] == 0 {
            bright.used[q] = 0;
        }
    }
    let made = reconstruct(bright, small(), &Unwatched).unwrap();
    assert!(
        made.notes
            .iter()
            .any(|n| n.starts_with("no pixel is in shadow")),
        "{:?}",
        made.notes
    );
    finite(&made);
}

#[test]
fn a_single_pixel_is_no_reason_to_break() {
    let (scene, rendered) = room(PlatoObject::Empty, 2, 1);
    let made = reconstruct(measured(&scene, &rendered), small(), &Unwatched);
    match made {
        Ok(made) => finite(&made),
        Err(e) => assert!(matches!(e, ReconstructError::Invalid { .. }), "{e}"),
    }
}

#[test]
fn a_spot_on_a_mirror_is_left_out_and_named() {
    let (mut scene, _) = room(PlatoObject::Empty, 3, 48);
    // The wall that beam 1 hits becomes a mirror, which folds the beam away.
    let wall = &mut scene.objects[3];
    let mut mesh = (*wall.mesh).clone();
    mesh.materials[0] = Material::mirror("mirror", 0.01);
    wall.mesh = mesh.into();
    let wall = &mut scene.objects[4];
    let mut mesh = (*wall.mesh).clone();
    mesh.materials[0] = Material::mirror("mirror", 0.01);
    wall.mesh = mesh.into();
    let gate = Gate {
        start_m: 0.0,
        bin_width_m: 0.0384,
        bins: 512,
    };
    let settings = picofarm_reconstruct::source::CaptureSettings {
        gate,
        samples: 1,
        seed: 0,
        sensor: None,
    };
    let found = picofarm_reconstruct::source::captures_of(&scene, &settings, &|_, _| true).unwrap();
    let said = found.check();
    assert!(!found.left_out.is_empty(), "{said:?}");
    assert!(
        found.left_out.iter().all(|l| l.why.contains("mirror")),
        "{:?}",
        found.left_out
    );
}

#[test]
fn captures_of_another_size_or_without_light_are_refused_or_named() {
    let (scene, _) = room(PlatoObject::Empty, 2, 8);
    let gate = Gate {
        start_m: 1.0,
        bin_width_m: 0.1,
        bins: 100,
    };
    let mut captures = Captures::new(scene.camera, scene.laser.clone(), gate, LIT_THRESHOLD);
    let said = |e: ReconstructError| e.to_string();
    assert!(
        said(captures.add(0, &[0.0; 7]).unwrap_err()).contains("expected 64 pixels x 100 bins")
    );
    assert!(said(captures.add(5, &[0.0; 6400]).unwrap_err()).contains("no such beam"));
    let mut broken = [0.0; 6400];
    broken[123] = f32::NAN;
    assert!(said(captures.add(0, &broken).unwrap_err()).contains("pixel 1 bin 23 is not finite"));
    captures.add(0, &[0.0; 6400]).unwrap();
    let measured = captures.finish();
    assert!(
        measured.left_out[0].why.contains("widen the gate"),
        "{:?}",
        measured.left_out
    );
    assert!(refused(measured, small()).contains("widen the gate"));
}
