//! Light through thin glass, tested against invariants and closed forms; `independent.rs` tests it
//! against an independent tracer. `by_glass.rs` tests the reflected light.

use crate::common;

use common::{energy, grey, ok, quad, room, scene, settings, sphere, v};
use picofarm_scene::{Bsdf, Material, Object, Scene, Vec3};
use picofarm_transient::{Budget, Gate, Settings, trace_spots};

fn glass(ior: f32, transmittance: f32) -> Material {
    Material {
        bsdf: Bsdf::ThinDielectric {
            ior,
            transmittance,
            face: false,
        },
        rgb: [transmittance; 3],
        ..Material::glass("glass")
    }
}

/// Returns a room with a mirror, a ball, a box with a spot next to its corner, and the given
/// objects.
fn furnished(more: Vec<Object>) -> Scene {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    objects.push(quad(
        v(-0.6, -0.8, -3.98),
        v(1.2, 0.0, 0.0),
        v(0.0, 1.6, 0.0),
        Material::mirror("mirror", 0.01),
    ));
    objects.push(sphere(
        v(1.0, -1.0, -2.8),
        0.5,
        2,
        Material::mirror("ball", 0.02),
    ));
    objects.push(quad(
        v(-1.5, -1.5, -3.0),
        v(0.0, 1.0, 0.0),
        v(0.0, 0.0, 1.0),
        grey(0.4),
    ));
    objects.extend(more);
    let beams = [v(-1.49, -1.5, -2.5), v(0.3, 0.3, -3.98), v(-2.0, 0.4, -2.5)];
    scene(objects, 16, &beams)
}

/// Returns a closed box of panes.
fn case(low: Vec3, high: Vec3, m: &Material) -> Vec<Object> {
    room(low, high, m)
}

fn narrow() -> Gate {
    Gate {
        start_m: 6.0,
        bin_width_m: 0.5,
        bins: 2,
    }
}

#[test]
fn glass_that_takes_nothing_changes_no_bit() {
    let clear = glass(1.0, 1.0);
    let mut panes = case(v(-0.3, -0.3, -0.3), v(0.3, 0.3, 0.3), &clear);
    panes.push(quad(
        v(-1.9, -1.4, -2.0),
        v(3.8, 0.0, 0.3),
        v(0.0, 2.8, 0.1),
        clear.clone(),
    ));
    let (without, with) = (furnished(vec![]), furnished(panes));
    for gate in [common::gate(), narrow()] {
        let set = Settings {
            gate,
            one_bounce: true,
            ..settings(Budget::Samples(4))
        };
        let (a, b) = (ok(&without, &set), ok(&with, &set));
        assert!(a.transient == b.transient, "the histogram");
        assert!(a.truth == b.truth, "the truth");
        assert!(b.rays > a.rays, "panes were asked");
    }
}

#[test]
fn glass_around_the_laser_takes_the_same_of_all_light() {
    // The laser is not at the camera here: a closed glass box surrounds the laser, and the camera
    // is outside it.
    let half = glass(1.0, 0.5);
    let mut clear = furnished(vec![]);
    clear.laser.origin = v(0.5, 0.2, 0.1);
    for beam in &mut clear.laser.beams {
        beam.direction = (beam.direction * 3.0 - clear.laser.origin).normalized();
    }
    let mut dim = clear.clone();
    dim.objects
        .extend(case(v(0.3, 0.0, -0.1), v(0.7, 0.4, 0.3), &half));
    let set = Settings {
        one_bounce: true,
        ..settings(Budget::Samples(4))
    };
    let (a, b) = (ok(&clear, &set), ok(&dim, &set));
    // The box also dims light between other parts of the room, but most light of one and two
    // bounces passes by it.
    let two = |r: &picofarm_transient::Rendered| r.split.as_ref().unwrap().two.clone();
    let (a2, b2) = (two(&a), two(&b));
    let mut halves = 0;
    for (a, b) in a2.iter().zip(&b2).filter(|(a, _)| **a > 0.0) {
        assert!(*b <= 0.5 * a, "{a} {b}");
        halves += usize::from(*b == 0.5 * a);
    }
    let all = a2.iter().filter(|a| **a > 0.0).count();
    assert!(halves * 10 > all * 8, "{halves} of {all}");
    // A spot behind glass does not move.
    assert_eq!(trace_spots(&clear).unwrap(), trace_spots(&dim).unwrap());
}

#[test]
fn a_spot_behind_a_window_loses_what_fresnel_says_twice() {
    // One bounce: through the pane to the spot and back, at the angle of the line of sight.
    let direction = v(0.5, 0.1, -1.0).normalized();
    let wall = || {
        quad(
            v(-4.0, -4.0, -3.0),
            v(8.0, 0.0, 0.0),
            v(0.0, 8.0, 0.0),
            grey(0.5),
        )
    };
    let pane = quad(
        v(-3.0, -3.0, -2.0),
        v(6.0, 0.0, 0.0),
        v(0.0, 6.0, 0.0),
        glass(1.5, 0.9),
    );
    let at = direction * (3.0 / -direction.z);
    let set = Settings {
        one_bounce: true,
        max_bounces: Some(1),
        ..settings(Budget::Samples(1))
    };
    let light = |objects| energy(&ok(&scene(objects, 8, &[at]), &set).transient);
    let share = light(vec![wall(), pane]) / light(vec![wall()]);
    let cos = -f64::from(direction.z);
    let inside = (1.0 - (1.0 - cos * cos) / 2.25).sqrt();
    let s = ((cos - 1.5 * inside) / (cos + 1.5 * inside)).powi(2);
    let p = ((1.5 * cos - inside) / (1.5 * cos + inside)).powi(2);
    let pane = 0.9 * 0.5 * ((1.0 - s) / (1.0 + s) + (1.0 - p) / (1.0 + p));
    assert!((share / (pane * pane) - 1.0).abs() < 1e-5, "{share} {pane}");
}

#[test]
fn black_glass_hides_light_and_no_surface() {
    let black = quad(
        v(-2.0, -1.5, -3.0),
        v(4.0, 0.0, 0.0),
        v(0.0, 3.0, 0.0),
        glass(1.0, 0.0),
    );
    let (clear, dark) = (furnished(vec![]), furnished(vec![black]));
    let set = settings(Budget::Samples(2));
    let (a, b) = (ok(&clear, &set), ok(&dark, &set));
    assert!(a.truth.depth == b.truth.depth);
    assert!(energy(&b.transient) < energy(&a.transient));
    // Pixels that see only the far wall, like their neighbours. Others see the edge of the ball,
    // which is partly in front.
    let far = |row: usize, col: usize| {
        let around = |k: usize| k.saturating_sub(1)..=(k + 1).min(15);
        around(row).all(|r| around(col).all(|c| b.truth.depth[16 * r + c] > 3.6))
    };
    let behind = (0..256).filter(|k| far(k / 16, k % 16));
    let behind: Vec<f64> = behind
        .map(|k| energy(&b.transient[637 * k..][..637]))
        .collect();
    assert!(behind.len() > 12, "{}", behind.len());
    assert_eq!(behind.iter().sum::<f64>(), 0.0);
}
