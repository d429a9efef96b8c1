//! Hard geometry: grazing light and views, tight corners, shared edges, unusual triangles, scales
//! and positions.

use crate::common;

use std::f64::consts::PI;

use common::{
    beam_to, black,
    brute::{Brute, Noise, two_by_quadrature},
    energy, framed, grey, multi_energy, near, object, ok, quad, room, scene, settings, two_only, v,
};
use picofarm_scene::{Intrinsics, Object, Scene, Vec3};
use picofarm_transient::{Budget, Gate, Settings, trace_spots};

/// Checks pixel sums within `each`, the image's sum within `whole`, and bins by relative rms within
/// `rms`.
#[track_caller]
fn agrees(got: &[f32], expected: &[f64], bins: usize, (each, whole, rms): (f64, f64, f64)) {
    let (mut error, mut norm) = (0.0, 0.0);
    for (k, (g, e)) in got.chunks(bins).zip(expected.chunks(bins)).enumerate() {
        let (a, b) = (energy(g), e.iter().sum::<f64>());
        assert!((a - b).abs() <= each * b, "pixel {k}: {a} instead of {b}");
        for (x, y) in g.iter().zip(e) {
            error += (f64::from(*x) - y).powi(2);
            norm += y * y;
        }
    }
    near("image", energy(got), expected.iter().sum(), whole, 0.0);
    let found = (error / norm).sqrt();
    println!("rms over bins {found:.4}");
    assert!(found < rms, "rms over bins {found}");
}

#[test]
fn light_that_leaves_a_spot_at_grazing_angles_matches_the_integral() {
    // The screen is a strip of 10 cm next to the spot's wall, so cosines at the spot are below
    // 0.07.
    let wall = quad(
        v(-1.5, -1.0, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -3.0),
        black(),
    );
    let strip = quad(
        v(-1.5, -0.5, -2.0),
        v(0.1, 0.0, 0.0),
        v(0.0, 1.0, 0.0),
        grey(0.8),
    );
    let spot = quad(
        v(-1.5, 0.1, -0.6),
        v(0.0, 0.2, 0.0),
        v(0.0, 0.0, 0.2),
        grey(0.8),
    );
    let mut s = scene(vec![wall, strip, spot], 8, &[]);
    s.laser
        .beams
        .push(beam_to(v(-1.5, 0.2, -0.5), v(1.0, 0.0, 0.0), 2));
    let (right, down) = (v(0.1, 0.0, 0.0), v(0.0, -1.0, 0.0));
    s.camera = framed(Vec3::ZERO, v(-1.5, 0.5, -2.0), right, down, (8, 8));
    let r = ok(&s, &two_only());
    let expected = two_by_quadrature(&s, &common::gate(), 24);
    agrees(&r.split.unwrap().two, &expected, 637, (0.01, 1e-3, 0.05));
}

#[test]
fn a_beam_that_grazes_a_wall_makes_its_spot_where_geometry_says() {
    // The beam approaches the wall by 5 mm in 20 m.
    let wall = quad(
        v(-0.005, -1.0, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -40.0),
        grey(0.8),
    );
    let screen = quad(
        v(1.0, -1.0, -18.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -4.0),
        grey(0.8),
    );
    let mut s = scene(vec![wall, screen], 8, &[v(-0.005, 0.0, -20.0)]);
    let spot = trace_spots(&s).unwrap()[0].expect("the wall");
    let off = spot.point - v(-0.005, 0.0, -20.0);
    assert!(
        off.x.abs() < 1e-6 && off.y.abs() < 1e-6 && off.z.abs() < 2e-2,
        "{off:?}"
    );
    assert_eq!(<[f32; 3]>::from(spot.normal), [1.0, 0.0, 0.0]);
    assert!((spot.path_m - 20.0).abs() < 2e-2);
    s.laser.beams[0].spot = Some(spot);
    let (right, down) = (v(0.0, 0.0, 4.0), v(0.0, -2.0, 0.0));
    s.camera = framed(v(0.3, 0.0, -19.5), v(1.0, 1.0, -22.0), right, down, (8, 8));
    let g = Gate {
        start_m: 20.0,
        ..common::gate()
    };
    let r = ok(
        &s,
        &Settings {
            gate: g,
            ..two_only()
        },
    );
    agrees(
        &r.split.unwrap().two,
        &two_by_quadrature(&s, &g, 24),
        637,
        (0.01, 1e-3, 0.08),
    );
}

#[test]
fn a_floor_seen_at_grazing_angles_matches_the_integral() {
    // The camera is 5 mm above the floor: a pixel spans up to a metre of it.
    let floor = quad(
        v(-2.0, -0.005, 1.0),
        v(4.0, 0.0, 0.0),
        v(0.0, 0.0, -5.0),
        grey(0.8),
    );
    let wall = quad(
        v(-1.0, -0.2, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -5.0),
        grey(0.8),
    );
    let mut s = scene(vec![floor, wall], 8, &[]);
    s.laser
        .beams
        .push(beam_to(v(-1.0, 0.4, -1.5), v(1.0, 0.0, 0.0), 1));
    s.camera.intrinsics = Intrinsics {
        fx: 100.0,
        fy: 2000.0,
        cx: 4.0,
        cy: -3.0,
        width: 8,
        height: 8,
    };
    let r = ok(&s, &two_only());
    agrees(
        &r.split.unwrap().two,
        &two_by_quadrature(&s, &common::gate(), 96),
        637,
        (0.02, 1e-3, 0.15),
    );
}

#[test]
fn three_bounces_from_a_spot_1_cm_from_a_corner_match_the_integral_over_the_other_wall() {
    let rho = 0.8;
    let front = quad(
        v(-2.0, -1.5, -2.0),
        v(3.0, 0.0, 0.0),
        v(0.0, 3.0, 0.0),
        grey(rho),
    );
    let side = quad(
        v(1.0, -1.5, -2.0),
        v(0.0, 3.0, 0.0),
        v(0.0, 0.0, 3.0),
        grey(rho),
    );
    let mut s = scene(vec![front, side], 8, &[]);
    s.laser
        .beams
        .push(beam_to(v(0.99, 0.1, -2.0), v(0.0, 0.0, 1.0), 0));
    // From 5 cm to 80 cm from the corner.
    let (corner, right, down) = (v(0.2, 0.5, -2.0), v(0.75, 0.0, 0.0), v(0.0, -0.8, 0.0));
    s.camera = framed(Vec3::ZERO, corner, right, down, (8, 8));
    let set = Settings {
        max_bounces: Some(3),
        ..settings(Budget::Samples(1536))
    };
    let r = ok(&s, &set);
    let (_, _, to_spot) = Brute::new(&s).spot(0);
    let f = f64::from(rho) / PI;
    let mut expected = vec![0.0f64; 637];
    let (n, mut rng) = (160, Noise(1));
    for k in 0..n * n {
        let x = 0.2 + 0.75 * ((k % n) as f64 + rng.next()) / n as f64;
        let y = 0.5 - 0.8 * ((k / n) as f64 + rng.next()) / n as f64;
        let back = (x * x + y * y + 4.0f64).sqrt();
        let (e, l) = (1.0 - x, 1.0 - f64::from(0.99f32));
        // Points (1, b, c − 2) of the wall, with steps that grow with the distance from the spot.
        let (step, start) = (0.1f64, (rng.next(), rng.next()));
        for i in 0..64 {
            let t = (f64::from(i) + start.0) * step;
            let (c, dc) = (0.01 * t.sinh(), 0.01 * t.cosh() * step);
            for j in -58..58 {
                let t = (f64::from(j) + start.1) * step;
                let (b, db) = (0.1 + 0.01 * t.sinh(), 0.01 * t.cosh() * step);
                if !(c < 3.0 && b.abs() < 1.5) {
                    continue;
                }
                let d1 = (l * l + (b - 0.1) * (b - 0.1) + c * c).sqrt();
                let d2 = (e * e + (b - y) * (b - y) + c * c).sqrt();
                let first = f * (c / d1) * (l / d1) / (d1 * d1);
                let value = f * first * (e / d2) * (c / d2) / (d2 * d2) * f;
                let bin = (to_spot + d1 + d2 + back - 1.0) / 0.0384;
                expected[bin as usize] += value * dc * db * 64.0 / (n * n) as f64;
            }
        }
    }
    let (got, se) = multi_energy(&r);
    near("corner", got, expected.iter().sum(), 0.005, se);
    // Compared in time: the bins' sums over the image.
    let multi = &r.split.as_ref().unwrap().multi;
    let found = |b: usize| multi.chunks(637).map(|p| f64::from(p[b])).sum::<f64>();
    let most = expected.iter().fold(0.0f64, |a, &b| a.max(b));
    for (b, e) in expected.iter().enumerate() {
        let miss = (found(b) - e).abs();
        assert!(miss < 0.04 * most, "bin {b}: {} instead of {e}", found(b));
    }
}

/// Returns a room with a box in it, with its camera and beams.
fn furnished() -> Scene {
    let mut objects = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    objects.extend(room(v(0.6, -1.0, -2.6), v(-0.3, -1.5, -1.9), &grey(0.4)));
    scene(objects, 12, &[v(0.3, 0.2, -1.0), v(-0.4, -0.1, -1.0)])
}

fn change(s: &Scene, f: impl Fn(&mut picofarm_scene::Mesh)) -> Scene {
    let mut s = s.clone();
    for o in &mut s.objects {
        let mut mesh = (*o.mesh).clone();
        f(&mut mesh);
        o.mesh = mesh.into();
    }
    s
}

#[test]
fn degenerate_and_duplicate_triangles_change_no_bit_of_a_render() {
    let (s, set) = (furnished(), settings(Budget::Samples(16)));
    let plain = ok(&s, &set);
    let odd = change(&s, |m| {
        let count = m.positions.len() as u32;
        m.positions.push(m.positions[0]);
        m.positions.push((m.positions[0] + m.positions[1]) * 0.5);
        // A point, a line, a line through a third vertex, and every triangle twice.
        let twice = m.triangles.clone();
        m.triangles
            .extend([[0, 0, 0], [0, 1, 1], [0, count, 1], [0, 1, count + 1]]);
        m.triangles.extend(twice);
        m.triangle_material.resize(m.triangles.len(), 0);
    });
    let r = ok(&odd, &set);
    assert_eq!(plain.transient, r.transient);
    assert_eq!(plain.truth.depth, r.truth.depth);
    assert_eq!(plain.truth.visibility, r.truth.visibility);
}

#[test]
fn inverted_two_sided_triangles_change_nothing_but_rounding() {
    let (s, set) = (furnished(), settings(Budget::Samples(64)));
    let plain = ok(&s, &set);
    let r = ok(
        &change(&s, |m| m.triangles.iter_mut().for_each(|t| t.swap(1, 2))),
        &set,
    );
    let (a, b) = (plain.split.as_ref().unwrap(), r.split.as_ref().unwrap());
    near("two", energy(&b.two), energy(&a.two), 1e-5, 0.0);
    let ((x, sx), (y, sy)) = (multi_energy(&plain), multi_energy(&r));
    near("multi", y, x, 0.0, sx.hypot(sy));
}

#[test]
fn a_wall_of_thousands_of_triangles_gives_what_one_triangle_gives() {
    // Shared edges and vertices: a double hit or a gap would be visible at once.
    let side = quad(
        v(-1.5, -1.0, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -2.9),
        grey(0.7),
    );
    let n = 48;
    let (mut positions, mut triangles) = (vec![], vec![]);
    for k in 0..=n * n + 2 * n {
        let at = |i: u32| 8.0 * i as f32 / n as f32;
        positions.push(v(-4.0 + at(k % (n + 1)), -4.0 + at(k / (n + 1)), -2.0));
    }
    for k in 0..n * n {
        let a = k / n * (n + 1) + k % n;
        triangles.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
    }
    let fine = object("fine", positions, triangles, grey(0.7));
    let one = vec![
        v(-20.0, -4.0, -2.0),
        v(20.0, -4.0, -2.0),
        v(0.0, 50.0, -2.0),
    ];
    let one = object("one", one, vec![[0, 1, 2]], grey(0.7));
    let run = |wall: Object| {
        let mut s = scene(vec![wall, side.clone()], 16, &[]);
        s.laser
            .beams
            .push(beam_to(v(-1.5, 0.2, -0.5), v(1.0, 0.0, 0.0), 1));
        s.camera.intrinsics = Intrinsics::from_fov(60.0, 16, 16);
        ok(&s, &two_only()).split.unwrap().two
    };
    let (a, b) = (run(fine), run(one));
    for (k, (x, y)) in a.chunks(637).zip(b.chunks(637)).enumerate() {
        let (x, y) = (energy(x), energy(y));
        assert!((x - y).abs() < 1e-4 * y, "pixel {k}: {x} {y}");
    }
}

#[test]
fn scenes_scaled_by_powers_of_two_give_the_same_bits_scaled() {
    let set = settings(Budget::Samples(8));
    let mut s = furnished();
    s.camera.origin = v(0.25, 0.125, 0.0);
    let plain = ok(&s, &set);
    for scale in [1.0 / 1024.0f32, 1024.0] {
        let mut other = change(&s, |m| m.positions.iter_mut().for_each(|p| *p = *p * scale));
        other.camera.origin = s.camera.origin * scale;
        let mut scaled = set.clone();
        scaled.gate.start_m *= f64::from(scale);
        scaled.gate.bin_width_m *= f64::from(scale);
        let r = ok(&other, &scaled);
        let law: Vec<f32> = r.transient.iter().map(|h| h * scale * scale).collect();
        assert_eq!(plain.transient, law, "{scale}");
    }
}

#[test]
fn scenes_scaled_by_1000_or_far_from_the_origin_keep_two_bounces_within_rounding() {
    let (s, set) = (furnished(), two_only());
    let plain = ok(&s, &set);
    for scale in [1e-3f32, 1e3] {
        let other = change(&s, |m| m.positions.iter_mut().for_each(|p| *p = *p * scale));
        let mut scaled = set.clone();
        scaled.gate.start_m *= f64::from(scale);
        scaled.gate.bin_width_m *= f64::from(scale);
        let r = ok(&other, &scaled);
        let law = f64::from(scale) * f64::from(scale);
        near(
            "scaled",
            energy(&r.transient) * law,
            energy(&plain.transient),
            1e-5,
            0.0,
        );
    }
    let shift = v(4096.0, -8192.0, 2048.0);
    let mut far = s.clone();
    far.objects
        .iter_mut()
        .for_each(|o| o.to_world.translation = shift);
    far.camera.origin = shift;
    far.laser.origin = shift;
    let r = ok(&far, &set);
    near(
        "moved",
        energy(&r.transient),
        energy(&plain.transient),
        2e-3,
        0.0,
    );
    let worst = plain.truth.depth.iter().zip(&r.truth.depth);
    let worst = worst.fold(0.0f32, |a, (x, y)| a.max((x - y).abs()));
    println!("depth differs by {worst:e} m at most");
    assert!(worst < 1e-5);
}
