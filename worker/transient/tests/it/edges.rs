//! Unusual scenes and settings give clear results or clear errors.

use crate::common;

use common::{Quiet, energy, grey, quad, room, scene, settings, v};
use picofarm_scene::{Scene, Vec3};
use picofarm_transient::{Budget, Gate, Progress, RenderError, Rendered, Settings, render};

fn few() -> Settings {
    settings(Budget::Samples(4))
}

fn grey_room(size: u32) -> Scene {
    let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    scene(walls, size, &[v(0.3, 0.2, -1.0), v(-0.5, -0.1, -1.0)])
}

fn ok(scene: &Scene, settings: &Settings) -> Rendered {
    render(scene, settings, &Quiet).unwrap()
}

#[test]
fn an_empty_scene_renders_to_nothing() {
    let r = ok(&scene(vec![], 4, &[v(0.0, 0.0, -1.0)]), &few());
    assert_eq!(energy(&r.transient), 0.0);
    assert_eq!(r.spots, vec![None]);
    assert!(r.truth.depth.iter().all(|&d| d == 0.0));
    assert!(r.truth.instance.iter().all(|&i| i == 0));
    assert_eq!(r.truth.visibility.len(), 16);
    assert_eq!(r.overflow.energy, 0.0);
    assert_eq!(r.error.median_relative, 0.0);
}

#[test]
fn a_scene_without_beams_renders_to_nothing() {
    let mut s = grey_room(4);
    s.laser.beams.clear();
    let r = ok(&s, &few());
    assert_eq!(energy(&r.transient), 0.0);
    assert!(r.truth.depth.iter().all(|&d| d > 0.0));
}

#[test]
fn a_camera_inside_a_solid_wall_sees_only_black_from_behind() {
    let mut wall = grey(0.5);
    wall.two_sided = false;
    // A box around the camera with front faces that face outwards.
    let inside_out = room(v(0.1, 0.1, 0.1), v(-0.1, -0.1, -0.1), &wall);
    let r = ok(&scene(inside_out, 4, &[v(0.0, 0.0, -1.0)]), &few());
    assert_eq!(energy(&r.transient), 0.0);
    assert!(r.truth.depth.iter().all(|&d| d > 0.0 && d < 0.3));
}

#[test]
fn beams_that_miss_have_no_spot_and_add_nothing() {
    let plate = || {
        vec![quad(
            v(-1.0, -1.0, -2.0),
            v(2.0, 0.0, 0.0),
            v(0.0, 2.0, 0.0),
            grey(0.5),
        )]
    };
    let hit = v(0.1, 0.0, -1.0);
    let one = ok(&scene(plate(), 4, &[hit]), &few());
    let with_miss = ok(&scene(plate(), 4, &[hit, v(0.0, 0.0, 1.0)]), &few());
    assert!(with_miss.spots[0].is_some() && with_miss.spots[1].is_none());
    assert_eq!(one.split.unwrap().two, with_miss.split.unwrap().two);
    assert!(with_miss.truth.visibility[16..].iter().all(|&lit| lit == 0));
}

#[test]
fn a_vertex_that_is_not_finite_is_named() {
    let mut s = grey_room(4);
    let mut mesh = (*s.objects[2].mesh).clone();
    mesh.positions[1].y = f32::NAN;
    s.objects[2].mesh = mesh.into();
    let error = render(&s, &few(), &Quiet).unwrap_err().to_string();
    assert!(
        error.contains("objects[2]") && error.contains("positions[1]"),
        "{error}"
    );
}

#[test]
fn settings_out_of_range_are_named() {
    let s = grey_room(2);
    let gate = |start_m, bin_width_m, bins| Gate {
        start_m,
        bin_width_m,
        bins,
    };
    let with_gate = |gate| Settings { gate, ..few() };
    let cases = [
        (with_gate(gate(-1.0, 0.1, 10)), "gate.start_m"),
        (with_gate(gate(1.0, -0.1, 10)), "gate.bin_width_m"),
        (with_gate(gate(1.0, f64::NAN, 10)), "gate.bin_width_m"),
        (with_gate(gate(1.0, 0.1, 0)), "gate.bins"),
        (settings(Budget::Error(0.0)), "budget.error"),
        (
            Settings {
                max_bounces: Some(0),
                ..few()
            },
            "max_bounces",
        ),
    ];
    for (settings, field) in cases {
        match render(&s, &settings, &Quiet) {
            Err(RenderError::Invalid { field: f, .. }) => assert_eq!(f, field),
            other => panic!("{field}: {:?}", other.map(|r| r.plan)),
        }
    }
}

#[test]
fn a_spot_that_names_a_missing_object_is_an_error() {
    let mut s = grey_room(2);
    let mut spot = picofarm_transient::trace_spots(&s).unwrap()[0].unwrap();
    spot.object = 99;
    s.laser.beams[0].spot = Some(spot);
    let error = render(&s, &few(), &Quiet).unwrap_err().to_string();
    assert!(error.contains("laser.beams[0].spot"), "{error}");
}

#[test]
fn what_falls_outside_the_gate_is_counted_and_never_clipped() {
    let s = grey_room(8);
    let whole = Settings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 0.05,
            bins: 1000,
        },
        one_bounce: true,
        ..settings(Budget::Samples(64))
    };
    let narrow = Settings {
        gate: Gate {
            start_m: 6.0,
            bin_width_m: 0.05,
            bins: 80,
        },
        ..whole.clone()
    };
    let (all, some) = (ok(&s, &whole), ok(&s, &narrow));
    assert!(some.overflow.energy > 0.0 && all.overflow.share < 1e-3);
    // Two bounces use the same random numbers in both renders.
    let (a, b) = (all.split.unwrap(), some.split.unwrap());
    for k in 0..64 {
        for bin in 0..80 {
            assert_eq!(a.two[k * 1000 + 120 + bin], b.two[k * 80 + bin]);
        }
    }
    // Paths end with the gate, so only a part of the light beyond it is found.
    let missing = energy(&all.transient) - energy(&some.transient);
    assert!(some.overflow.energy > 0.5 * missing && some.overflow.energy < 1.05 * missing);
    let share = some.overflow.energy / (some.overflow.energy + energy(&some.transient));
    assert!((some.overflow.share - share).abs() < 1e-9);
    // Without a random walk, all light is found.
    let two = |s| Settings {
        max_bounces: Some(2),
        ..s
    };
    let (all, some) = (ok(&s, &two(whole)), ok(&s, &two(narrow)));
    let missing = energy(&all.transient) - energy(&some.transient);
    assert!((some.overflow.energy / missing - 1.0).abs() < 1e-5);
}

#[test]
fn results_are_bit_identical_for_1_2_and_7_threads() {
    let s = grey_room(40);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| ok(&s, &settings(Budget::Error(0.5))))
    };
    let one = run(1);
    for threads in [2, 7] {
        let other = run(threads);
        assert_eq!(one.transient, other.transient);
        assert_eq!(one.truth.rgb, other.truth.rgb);
        assert_eq!(one.truth.visibility, other.truth.visibility);
        assert_eq!(one.error, other.error);
        assert_eq!(one.overflow, other.overflow);
        assert_eq!(one.rays, other.rays);
        assert_eq!(
            one.split.as_ref().unwrap().multi_se,
            other.split.unwrap().multi_se
        );
    }
}

#[test]
fn a_render_stops_when_told() {
    struct Stop;
    impl Progress for Stop {
        fn at(&self, done: f32) -> bool {
            done < 0.2
        }
    }
    let stopped = render(&grey_room(64), &few(), &Stop);
    assert!(matches!(stopped, Err(RenderError::Stopped)));
}

#[test]
fn two_bounces_only_traces_no_random_walk() {
    let r = ok(
        &grey_room(8),
        &Settings {
            max_bounces: Some(2),
            ..few()
        },
    );
    let split = r.split.unwrap();
    assert!(energy(&split.two) > 0.0);
    assert_eq!(energy(&split.multi), 0.0);
    assert_eq!(r.error.samples, 0);
    assert!(!r.plan.strategies.iter().any(|s| s.contains("three")));
}

#[test]
fn ground_truth_follows_the_pixel_centres() {
    let s = grey_room(16);
    let r = ok(&s, &few());
    let origin = Vec3::ZERO;
    for (k, &z) in r.truth.depth.iter().enumerate() {
        let (col, row) = (k % 16, k / 16);
        let d = s.camera.ray(col as f32 + 0.5, row as f32 + 0.5);
        let p = origin + d * z;
        let on_wall = [p.x.abs() - 2.0, p.y.abs() - 1.5, p.z + 4.0];
        assert!(on_wall.iter().any(|x| x.abs() < 1e-5), "{p:?}");
        assert!((r.truth.range[k] - z * d.length()).abs() < 1e-5);
        let n = &r.truth.normal[3 * k..3 * k + 3];
        let n = Vec3::new(n[0], n[1], n[2]);
        let back = s.camera.direction_to_camera(d);
        assert!((n.length() - 1.0).abs() < 1e-6 && n.dot(back) < 0.0);
        assert!(r.truth.instance[k] > 0 && r.truth.label[k] == 1);
        assert!(
            r.truth.visibility[k] == 1,
            "a convex room is lit everywhere"
        );
    }
    assert!(r.truth.rgb.iter().all(|&c| (0.0..=1.0).contains(&c)));
}

#[test]
fn a_scene_too_wide_or_too_small_for_f32_is_named() {
    for scale in [1e12f32, 1e-9] {
        let mut s = grey_room(2);
        for o in &mut s.objects {
            let mut mesh = (*o.mesh).clone();
            mesh.positions.iter_mut().for_each(|p| *p = *p * scale);
            o.mesh = mesh.into();
        }
        let error = render(&s, &few(), &Quiet).unwrap_err().to_string();
        assert!(
            error.contains("objects") && error.contains("unit"),
            "{error}"
        );
    }
    let mut s = grey_room(2);
    let mut spot = picofarm_transient::trace_spots(&s).unwrap()[0].unwrap();
    spot.path_m = f32::NAN;
    s.laser.beams[0].spot = Some(spot);
    let error = render(&s, &few(), &Quiet).unwrap_err().to_string();
    assert!(error.contains("laser.beams[0].spot"), "{error}");
}
