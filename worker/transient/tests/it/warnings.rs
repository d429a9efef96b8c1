//! The warnings of renders without light, or with less than a user may expect.

use crate::common;

use common::{beam_to, grey, ok, quad, room, scene, sphere, two_only, v};
use picofarm_scene::{Beam, Scene, Vec3};
use picofarm_transient::Gate;

/// Returns a wall in front of the camera.
fn wall(directions: &[Vec3]) -> Scene {
    let corner = v(-2.0, -2.0, -2.0);
    let wall = quad(corner, v(4.0, 0.0, 0.0), v(0.0, 4.0, 0.0), grey(0.7));
    scene(vec![wall], 8, directions)
}

#[track_caller]
fn says(scene: &Scene, expected: &[&str]) {
    assert_eq!(ok(scene, &two_only()).warnings, expected);
}

#[test]
fn spots_that_hit_nothing_are_named() {
    let (at, past) = (v(0.0, 0.0, -1.0), v(0.0, 0.0, 1.0));
    // A plane wall has no light of two bounces, so there is a second one next to it.
    let both = |directions: &[Vec3]| {
        let mut scene = wall(directions);
        let (up, away) = (v(0.0, 4.0, 0.0), v(0.0, 0.0, 4.0));
        let side = quad(v(-1.0, -2.0, -2.0), up, away, grey(0.7));
        scene.objects.push(side);
        scene
    };
    says(&both(&[at]), &[]);
    says(&both(&[at, past, at]), &["spot 1 hits nothing"]);
    says(
        &both(&[past, at, past]),
        &["2 of 3 spots hit nothing: 0, 2"],
    );
    let many: Vec<Vec3> = (0..12).map(|i| if i == 0 { at } else { past }).collect();
    says(
        &both(&many),
        &["11 of 12 spots hit nothing: 1, 2, 3, 4, 5, 6, 7, 8, …"],
    );
}

#[test]
fn an_image_without_light_says_why() {
    let (at, past) = (v(0.0, 0.0, -1.0), v(0.0, 0.0, 1.0));
    says(
        &wall(&[past]),
        &[
            "no beam of the laser meets a surface: there is no light",
            "the histogram is empty: no beam of the laser meets a surface",
        ],
    );
    let mut away = wall(&[at]);
    away.objects[0] = quad(
        v(-2.0, -2.0, 2.0),
        v(0.0, 4.0, 0.0),
        v(4.0, 0.0, 0.0),
        grey(0.7),
    );
    away.laser.beams = vec![beam_to(v(0.0, 0.0, 2.0), v(0.0, 0.0, -1.0), 0)];
    says(
        &away,
        &["the histogram is empty: the camera sees no surface"],
    );
}

#[test]
fn an_enclosed_camera_is_asked_about() {
    let mut inside = room(v(-3.0, -3.0, -3.0), v(3.0, 3.0, 3.0), &grey(0.7));
    inside.push(sphere(Vec3::ZERO, 0.5, 3, grey(0.7)));
    let mut enclosed = scene(inside, 8, &[]);
    let spot = beam_to(v(0.0, 0.0, -3.0), v(0.0, 0.0, 1.0), 1);
    enclosed.laser.beams = vec![Beam { ..spot }];
    says(
        &enclosed,
        &[
            "the histogram is empty: no light finds a way from the spots to the camera; is the camera enclosed?",
        ],
    );
}

#[test]
fn a_gate_before_and_one_after_the_light_say_where_the_light_is() {
    let mut objects = room(v(-3.0, -3.0, -3.0), v(3.0, 3.0, 3.0), &grey(0.7));
    objects.truncate(6);
    let scene = scene(objects, 8, &[v(0.0, 0.0, -1.0)]);
    for (gate, expected) in [
        (
            Gate {
                start_m: 0.0,
                bin_width_m: 0.01,
                bins: 10,
            },
            "no light arrives within the gate: first light at",
        ),
        (
            Gate {
                start_m: 1e6,
                bin_width_m: 0.01,
                bins: 10,
            },
            "gate starts at 1000000.00 m",
        ),
    ] {
        let mut settings = two_only();
        settings.gate = gate;
        let said = ok(&scene, &settings).warnings;
        let [said] = &said[..] else {
            panic!("one warning: {said:?}");
        };
        assert!(said.contains(expected), "{said}");
    }
}
