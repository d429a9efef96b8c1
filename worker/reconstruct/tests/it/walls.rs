//! Walls of rooms that are not convex, wrong depths behind walls, and surfaces that no spot lights.

use crate::common;

use common::{Unstopped, room, small};
use picofarm_reconstruct::{
    Measured, Reconstructed, Settings, Shadows, Unwatched, World, reconstruct,
    render::Renderer,
    score::{around, score_views},
    source::{CaptureSettings, Captures, Given, LIT_THRESHOLD, Times, given},
};
use picofarm_scene::{Camera, Intrinsics, Vec3, plato::PlatoObject};
use picofarm_settings::{Jitter, Pulse, Scale, Sensor};
use picofarm_transient::{Gate, render};

/// The side of the image, pixels.
const SIDE: u32 = 96;
/// The place of the wall at which the arm of the room begins, and that of the arm's end, metres.
const WALL_Z: f32 = -3.0;
const ARM_Z: f32 = -4.5;

fn camera() -> Camera {
    let intrinsics = Intrinsics::from_fov(90.0, SIDE, SIDE);
    Camera::look_at(Vec3::ZERO, Vec3::new(0.0, 0.0, -1.0), intrinsics)
}

/// Returns the distance along a ray from the origin to a room of 4 × 2.6 m that is L-shaped: right
/// of x = 0.4 m it is deeper.
fn l_room(ray: Vec3) -> f32 {
    let to = |far: f32, slope: f32| {
        if slope > 0.0 {
            far / slope
        } else {
            f32::INFINITY
        }
    };
    let sides = to(2.0, ray.x.abs()).min(to(1.3, ray.y.abs()));
    let wall = to(-WALL_Z, -ray.z);
    let x = ray.x * wall;
    let back = match x < 0.4 {
        true => wall,
        // In the arm, a ray may still meet the arm's left side.
        false => to(-ARM_Z, -ray.z),
    };
    sides.min(back)
}

/// Returns measurements with all pixels lit by four spots on the visible surfaces.
fn measured(range: &[f32]) -> Measured {
    let camera = camera();
    let spots: Vec<_> = [(-0.5, 0.2), (0.5, -0.3), (-0.2, -0.6), (0.3, 0.6)]
        .into_iter()
        .map(|(x, y)| {
            let ray = Vec3::new(x, y, -1.0).normalized();
            let path = l_room(ray);
            Some((ray * path, path))
        })
        .collect();
    let pixels = range.len();
    given(&Given {
        camera,
        laser: Vec3::ZERO,
        spots: &spots,
        beams: &[0, 1, 2, 3],
        times: Times::Range(range),
        lit: &vec![1; 4 * pixels],
        mirror: &vec![0; pixels],
    })
    .unwrap()
}

fn ranges() -> Vec<f32> {
    let camera = camera();
    (0..SIDE * SIDE)
        .map(|p| {
            let (x, y) = ((p % SIDE) as f32 + 0.5, (p / SIDE) as f32 + 0.5);
            l_room(camera.ray(x, y).normalized())
        })
        .collect()
}

fn made(range: &[f32]) -> Reconstructed {
    let settings = Settings {
        shadows: Shadows::Ignore,
        ..small()
    };
    reconstruct(measured(range), settings, &Unwatched).unwrap()
}

/// Returns the optical depth of a node near a position.
fn logit(made: &Reconstructed, x: Vec3) -> f32 {
    let field = &made.field;
    let at = |k: usize| ((x[k] - field.origin[k]) / field.spacing).round() as usize;
    let [_, y, z] = field.strides();
    field.logit[at(0) + at(1) * y + at(2) * z]
}

#[test]
fn a_wall_beside_the_arm_of_an_l_shaped_room_stays_and_is_open_to_the_arm() {
    let made = made(&ranges());
    let wall = made
        .planes
        .iter()
        .find(|p| p.normal.z < -0.99 && (p.offset + WALL_Z).abs() < 0.05);
    assert!(wall.is_some(), "{:?}", made.planes);
    // Behind the wall it is solid, also outside the view; in the arm it is empty.
    let (behind, beyond, arm) = (
        logit(&made, Vec3::new(-1.0, 0.0, WALL_Z - 0.2)),
        logit(&made, Vec3::new(-2.05, 0.0, -0.5)),
        logit(&made, Vec3::new(0.9, 0.0, WALL_Z - 0.5)),
    );
    assert!(behind > 0.0 && beyond > 0.0, "{behind} {beyond}");
    assert!(arm < 0.0, "{arm}");
    assert!(
        made.notes.iter().any(|n| n.contains("a wall is open")),
        "{:?}",
        made.notes
    );
}

#[test]
fn wrong_depths_behind_a_wall_neither_grow_the_box_nor_remove_the_wall() {
    let right = made(&ranges());
    let mut range = ranges();
    // One pixel in 29 is 2 m too far, as light of three bounces would place it.
    for r in range.iter_mut().step_by(29) {
        *r += 2.0;
    }
    let wrong = made(&range);
    assert_eq!(wrong.planes.len(), right.planes.len(), "{:?}", wrong.planes);
    let (a, b) = (
        right.field.end() - right.field.origin,
        wrong.field.end() - wrong.field.origin,
    );
    assert!((0..3).all(|k| (a[k] - b[k]).abs() < 0.2), "{a:?} {b:?}");
    assert!(
        wrong.notes.iter().any(|n| n.contains("behind a wall")),
        "{:?}",
        wrong.notes
    );
}

#[test]
fn a_pixel_that_no_spot_lights_has_the_given_distance() {
    let range = ranges();
    let mut measured = measured(&range);
    let (pixel, pixels) = ((SIDE * SIDE / 2 + SIDE / 3) as usize, range.len());
    for spot in 0..4 {
        measured.lit[spot * pixels + pixel] = 0;
        measured.tau[spot * pixels + pixel] = 0.0;
    }
    let depth = |measured: &Measured| {
        let made = reconstruct(measured.clone(), small(), &Unwatched).unwrap();
        made.depth.range[pixel]
    };
    assert!(depth(&measured).is_nan());
    measured.unlit_range_m = range.clone();
    assert!((depth(&measured) - range[pixel]).abs() < 0.05);
    measured.unlit_range_m = vec![1.0; 3];
    let refusal = measured.check().unwrap_err().to_string();
    assert!(refusal.contains("unlit_range_m"), "{refusal}");
}

#[test]
fn captures_without_noise_give_no_worse_room_than_captures_with_noise() {
    let (scene, _) = room(PlatoObject::Chair, 9, 64);
    let settings = CaptureSettings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 0.0384,
            bins: 391,
        },
        samples: 4,
        seed: 3,
        sensor: None,
    };
    let sensor = Sensor {
        pulse: Pulse::None {},
        jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
        scale: Scale::Peak { photons: 100.0 },
        dark_per_bin: 1.0,
        ..Sensor::default()
    };
    let of = || {
        Captures::new(
            scene.camera,
            scene.laser.clone(),
            settings.gate,
            LIT_THRESHOLD,
        )
    };
    let mut all = [of(), of().behind(&sensor, 7).unwrap()];
    let mut alone = scene.clone();
    for (beam, only) in scene.laser.beams.iter().enumerate() {
        alone.laser.beams = vec![*only];
        let capture = render(&alone, &settings.render_settings(), &Unstopped).unwrap();
        for captures in &mut all {
            captures.add(beam, &capture.transient).unwrap();
        }
    }
    let world = World::new(&scene);
    let [free, noisy] = all.map(|captures| {
        let made = reconstruct(captures.finish(), small(), &Unwatched).unwrap();
        let views = around(&made.measured, &made.depth.range, &world, 8, 48);
        let renderer = Renderer::new(&made.field);
        score_views(&renderer, &scene.camera, &world, &views)
            .all
            .l1_m
    });
    assert!(
        free <= 1.1 * noisy,
        "{free} m without noise, {noisy} m with"
    );
}
