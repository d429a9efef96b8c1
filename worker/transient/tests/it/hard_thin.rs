//! Thin, sealed and enclosed objects: no light leaks around, through or out of them.

use crate::common;

use common::{
    beam_to, black, brute::two_by_quadrature, energy, framed, grey, near, object, ok, quad, room,
    scene, settings, sphere, two_only, v,
};
use picofarm_scene::{Affine, Material, Object, Scene, Vec3};
use picofarm_transient::{Budget, Gate, Settings, trace_spots};

/// Returns a prism of `sides` sides around a segment, without caps.
fn rod(a: Vec3, b: Vec3, radius: f32, sides: u32, m: Material) -> Object {
    let axis = (b - a).normalized();
    let u = axis.cross(v(0.3, 0.9, 0.1)).normalized();
    let w = axis.cross(u);
    let mut positions = vec![];
    for k in 0..sides {
        let angle = std::f32::consts::TAU * k as f32 / sides as f32;
        let out = (u * angle.cos() + w * angle.sin()) * radius;
        positions.extend([a + out, b + out]);
    }
    let triangles = (0..sides)
        .flat_map(|k| {
            let (i, j) = (2 * k, 2 * ((k + 1) % sides));
            [[i, j, j + 1], [i, j + 1, i + 1]]
        })
        .collect();
    object("rod", positions, triangles, m)
}

/// Computes the energy that thin objects block from a lit screen, versus exact visibility. Returns
/// found and expected.
fn shadow(thing: Object) -> (f64, f64) {
    let screen = quad(
        v(-1.0, -1.0, -2.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        grey(0.7),
    );
    let side = quad(
        v(-1.5, -1.0, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -2.9),
        grey(0.7),
    );
    let mut plain = scene(vec![screen, side], 32, &[]);
    plain
        .laser
        .beams
        .push(beam_to(v(-1.5, 0.2, -0.5), v(1.0, 0.0, 0.0), 1));
    let (corner, right, down) = (v(-0.2, 0.2, -2.0), v(0.4, 0.0, 0.0), v(0.0, -0.4, 0.0));
    plain.camera = framed(Vec3::ZERO, corner, right, down, (32, 32));
    let mut with = plain.clone();
    with.objects.push(thing);
    let (mut found, seeds) = (0.0, 4);
    for seed in 0..seeds {
        let set = Settings { seed, ..two_only() };
        found += energy(&ok(&plain, &set).transient) - energy(&ok(&with, &set).transient);
    }
    let g = Gate {
        start_m: 0.0,
        bin_width_m: 100.0,
        bins: 1,
    };
    let all = |s: &Scene| two_by_quadrature(s, &g, 16).iter().sum::<f64>();
    (found / f64::from(seeds as u32), all(&plain) - all(&with))
}

#[test]
fn a_6_mm_rod_takes_as_much_light_as_its_outline_and_shadow() {
    let (a, b) = (v(-0.6, -1.0, -1.55), v(-0.1, 1.0, -1.7));
    let (found, expected) = shadow(rod(a, b, 0.003, 8, black()));
    near("rod", found, expected, 0.015, 0.0);
}

#[test]
fn a_rod_that_nearly_touches_the_screen_leaks_no_light() {
    // 1 mm of air in between, which offsets that are too large would skip.
    let (a, b) = (v(-0.3, -1.0, -1.996), v(0.1, 1.0, -1.996));
    let (found, expected) = shadow(rod(a, b, 0.003, 8, black()));
    near("near rod", found, expected, 0.015, 0.0);
}

#[test]
fn a_sheet_seen_edge_on_takes_as_much_light_as_its_shadow() {
    let sheet = quad(
        v(-0.05, -0.3, -1.99),
        v(0.0, 0.6, 0.1),
        v(0.0, 0.0, 0.05),
        black(),
    );
    let (found, expected) = shadow(sheet);
    near("sheet", found, expected, 0.015, 0.0);
}

#[test]
fn what_is_sealed_by_a_sheet_or_a_mesh_stays_dark() {
    let walls = || room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.9));
    let few = settings(Budget::Samples(16));
    let mut sealed: Vec<(&str, Scene)> = vec![];
    let mut divided = walls();
    divided.push(quad(
        v(-2.0, -1.5, -2.0),
        v(4.0, 0.0, 0.0),
        v(0.0, 3.0, 0.0),
        grey(0.9),
    ));
    sealed.push(("sheet", scene(divided, 16, &[])));
    // The same sheet at an angle and through the walls.
    let mut tilted = walls();
    tilted.push(quad(
        v(-2.1, -1.6, -2.3),
        v(4.2, 0.0, 0.7),
        v(0.0, 3.2, 0.3),
        grey(0.9),
    ));
    sealed.push(("tilted sheet", scene(tilted, 16, &[])));
    let mut shell = walls();
    shell.push(sphere(v(0.03, -0.02, 0.01), 0.4, 3, grey(0.9)));
    sealed.push(("shell", scene(shell, 16, &[])));
    for yaw in [0.0, 0.3, 1.234] {
        for (name, s) in &sealed {
            let mut s = s.clone();
            let turn = Affine::yaw_then_move(yaw, v(0.1, 0.2, -0.1));
            for o in &mut s.objects {
                o.to_world = turn;
            }
            let point = turn.point(v(0.3, 0.4, -4.0));
            s.laser
                .beams
                .push(beam_to(point, turn.direction(v(0.0, 0.0, 1.0)), 0));
            let r = ok(&s, &few);
            // Points on a wall are lifted off it by about 10⁻⁵ of their coordinates. If another
            // surface cuts the wall at an angle, light reaches the other side by as much.
            let share = energy(&r.transient) / 16.0;
            println!("{name} at {yaw}: {share:e}");
            let most = if *name == "tilted sheet" { 1e-5 } else { 0.0 };
            assert!(
                share <= most && r.overflow.energy <= most,
                "{name} at {yaw}: {share:e}"
            );
        }
    }
}

#[test]
fn a_laser_inside_an_object_lights_the_inside_alone() {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.8));
    let (low, high) = (v(0.5, -0.5, -2.5), v(1.0, 0.0, -2.0));
    objects.extend(room(low, high, &grey(0.8)));
    let mut s = scene(objects, 8, &[v(0.2, 0.1, -1.0), v(0.0, 1.0, 0.1)]);
    s.laser.origin = v(0.7, -0.2, -2.2);
    let inside = trace_spots(&s).unwrap();
    for spot in &inside {
        let p = spot.expect("the box is closed").point;
        for k in 0..3 {
            assert!((low[k] - 1e-5..=high[k] + 1e-5).contains(&p[k]), "{p:?}");
        }
    }
    let r = ok(&s, &settings(Budget::Samples(8)));
    assert_eq!(energy(&r.transient), 0.0);
    // A camera inside with the laser sees light.
    s.camera.origin = s.laser.origin;
    assert!(energy(&ok(&s, &settings(Budget::Samples(8))).transient) > 0.0);
}
