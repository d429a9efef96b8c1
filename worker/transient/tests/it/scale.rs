//! Geometry far beyond the reach of camera and light changes nothing, and walls far larger than the
//! room behave like walls.

use crate::common;

use common::*;
use picofarm_scene::{Material, Object, Scene, Vec3};
use picofarm_transient::{Budget, Gate, Rendered, Settings};

/// Returns a closed grey room with a box in it and two spots.
fn closed() -> Scene {
    let mut objects = room(v(-2.0, -1.5, -3.5), v(2.5, 1.5, 1.0), &grey(0.6));
    objects.extend(room(v(0.4, -1.5, -2.6), v(1.2, -0.4, -1.8), &grey(0.4)));
    scene(objects, 16, &[v(-0.4, 0.2, -1.0), v(0.3, -0.1, -1.0)])
}

/// Returns a square with half side `half`, perpendicular to −z at distance `z`.
fn plane(z: f32, half: f32) -> Object {
    let corner = v(-half, -half, -z);
    quad(
        corner,
        v(2.0 * half, 0.0, 0.0),
        v(0.0, 2.0 * half, 0.0),
        grey(0.5),
    )
}

fn set() -> Settings {
    settings(Budget::Samples(8))
}

#[track_caller]
fn same(what: &str, got: &Rendered, expected: &Rendered) {
    assert_eq!(got.plan, expected.plan, "{what}");
    let (got_h, expected_h) = (energy(&got.transient), energy(&expected.transient));
    println!("{what}: {:+.4} %", 100.0 * (got_h / expected_h - 1.0));
    assert!(
        got.transient == expected.transient,
        "{what}: the bits differ"
    );
    assert_eq!(got.overflow, expected.overflow, "{what}");
    assert_eq!(got.truth.depth, expected.truth.depth, "{what}");
    assert_eq!(got.truth.visibility, expected.truth.visibility, "{what}");
}

#[test]
fn a_plane_far_outside_of_a_closed_room_changes_no_bit() {
    let plain = ok(&closed(), &set());
    for (z, half) in [
        (1e3f32, 1e3f32),
        (1e5, 1e5),
        (1e6, 1e6),
        (1e6, 10.0),
        (5e8, 5e8),
    ] {
        for first in [false, true] {
            let mut s = closed();
            s.objects.push(plane(z, half));
            s.labels.push("far".into());
            let what = format!("a plane of {half} m at {z} m, first {first}");
            if first {
                // The triangles of the new object come before all others.
                s.objects.rotate_right(1);
            }
            same(&what, &ok(&s, &set()), &plain);
        }
    }
}

#[test]
fn a_plane_far_outside_changes_no_bit_of_a_narrow_gate() {
    let mut set = set();
    set.gate = Gate {
        start_m: 7.5,
        bin_width_m: 0.01,
        bins: 10,
    };
    let plain = ok(&closed(), &set);
    assert!(
        plain
            .plan
            .strategies
            .iter()
            .any(|s| s.contains("ellipsoidal"))
    );
    let mut s = closed();
    s.objects.push(plane(1e5, 1e5));
    same("narrow", &ok(&s, &set), &plain);
}

/// Returns the room with a back wall, a floor and a side wall of half side `half`.
fn wide(half: f32) -> Scene {
    let mut s = closed();
    let (x, y, z) = (v(half, 0.0, 0.0), v(0.0, half, 0.0), v(0.0, 0.0, half));
    let across = |at: Vec3, a: Vec3, b: Vec3| quad(at - a - b, a * 2.0, b * 2.0, grey(0.6));
    s.objects[0] = across(v(0.0, -1.5, 0.0), z, x);
    s.objects[1] = across(v(0.0, 0.0, -3.5), x, y);
    s.objects[2] = across(v(-2.0, 0.0, 0.0), y, z);
    s
}

#[test]
fn walls_of_any_size_close_a_room_alike() {
    // A last bit of a wall's distance turns a draw here and there: 0.012 % after 8 paths, 0.003 %
    // after 32 and 0.0006 % after 128.
    let set = || settings(Budget::Samples(32));
    let plain = ok(&closed(), &set());
    let whole = energy(&plain.transient);
    for half in [1e2f32, 1e4, 1e7, 5e8] {
        let r = ok(&wide(half), &set());
        let got = energy(&r.transient);
        println!("walls of {half:e} m: {:+.5} %", 100.0 * (got / whole - 1.0));
        assert!((got / whole - 1.0).abs() < 1e-4, "{half}: {got} {whole}");
        let depth = r.truth.depth.iter().zip(&plain.truth.depth);
        let worst = depth.fold(0.0f32, |a, (x, y)| a.max((x - y).abs()));
        assert!(worst < 1e-5, "{half}: depth differs by {worst} m");
        assert_eq!(r.truth.visibility, plain.truth.visibility, "{half}");
    }
}

#[test]
fn a_large_mirror_far_outside_takes_no_strategy_from_a_mirror_in_the_room() {
    let mirror = |corner, a, b| quad(corner, a, b, Material::mirror("mirror", 0.01));
    let mut near = closed();
    near.objects.push(mirror(
        v(-1.9, -0.5, -2.5),
        v(0.0, 1.0, 0.0),
        v(0.0, 0.0, 1.0),
    ));
    let plain = ok(&near, &set());
    assert!(plain.plan.strategies.iter().any(|s| s.contains("1 planar")));
    let mut far = near.clone();
    far.objects.push(mirror(
        v(-1e4, -1e4, -3e3),
        v(2e4, 0.0, 0.0),
        v(0.0, 2e4, 0.0),
    ));
    same("a mirror", &ok(&far, &set()), &plain);
}

#[test]
fn a_room_kilometres_from_the_origin_keeps_its_light() {
    let s = closed();
    // Eight kilometres away f32 rounds vertices to half a millimetre, so the room itself differs:
    // by -0.031 % after 256 paths and by -0.029 % after 1024.
    let set = settings(Budget::Samples(256));
    let plain = ok(&s, &set);
    for shift in [v(256.0, -512.0, 128.0), v(4096.0, -8192.0, 2048.0)] {
        let mut far = s.clone();
        for o in &mut far.objects {
            o.to_world.translation = shift;
        }
        far.camera.origin = shift;
        far.laser.origin = shift;
        let (got, whole) = (energy(&ok(&far, &set).transient), energy(&plain.transient));
        println!("moved by {shift:?}: {:+.4} %", 100.0 * (got / whole - 1.0));
        assert!((got / whole - 1.0).abs() < 4e-4, "{shift:?}");
    }
}
