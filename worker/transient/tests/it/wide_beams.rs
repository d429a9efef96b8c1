//! Beams with a width: the width of their spots, their light at edges, via mirrors and through
//! glass, and the light scattered from the spots, compared with beams without a width drawn at
//! random from the same Gaussian.

use crate::common;

use common::{beam_to, energy, grey, ok, quad, room, scene, settings, two_only, v};
use picofarm_scene::{Bsdf, Material, Scene, Vec3};
use picofarm_transient::{BeamWidth, Budget, Optics, Rendered, Settings, render};

fn width(diameter_mm: f64, divergence_mrad: f64, points: u32) -> BeamWidth {
    BeamWidth {
        diameter_mm,
        divergence_mrad,
        points,
    }
}

fn optics(beam: Option<BeamWidth>) -> Optics {
    Optics {
        beam,
        ..Optics::default()
    }
}

/// One bounce alone.
fn one(beam: Option<BeamWidth>) -> Settings {
    Settings {
        max_bounces: Some(1),
        one_bounce: true,
        split: false,
        optics: optics(beam),
        ..settings(Budget::Samples(2))
    }
}

fn wall(z: f32) -> picofarm_scene::Object {
    quad(
        v(-9.0, -9.0, z),
        v(18.0, 0.0, 0.0),
        v(0.0, 18.0, 0.0),
        grey(0.5),
    )
}

/// Returns the energy of each pixel.
fn pixels(r: &Rendered) -> Vec<f64> {
    let bins = r.gate.bins as usize;
    r.transient.chunks(bins).map(energy).collect()
}

/// Returns the mean and the mean square deviation of the light's position, in pixels, by column and
/// row.
fn spread(r: &Rendered) -> ([f64; 2], [f64; 2]) {
    let all = pixels(r);
    let sum: f64 = all.iter().sum();
    let at = |k: usize| {
        let (row, col) = (k / r.width as usize, k % r.width as usize);
        [col as f64 + 0.5, row as f64 + 0.5]
    };
    let mut mean = [0.0; 2];
    let mut square = [0.0; 2];
    for (k, e) in all.iter().enumerate() {
        for (a, m) in mean.iter_mut().enumerate() {
            *m += e / sum * at(k)[a];
        }
    }
    for (k, e) in all.iter().enumerate() {
        for (a, s) in square.iter_mut().enumerate() {
            *s += e / sum * (at(k)[a] - mean[a]).powi(2);
        }
    }
    (mean, square)
}

/// Returns a scene seen with a field of view of `degrees`.
fn narrow(mut s: Scene, degrees: f32) -> Scene {
    let i = &mut s.camera.intrinsics;
    *i = picofarm_scene::Intrinsics::from_fov(degrees, i.width, i.height);
    s
}

#[test]
fn a_spot_is_as_wide_as_its_beam_at_every_distance() {
    for (z, beam) in [
        (2.0, width(40.0, 0.0, 64)),
        (2.0, width(0.0, 30.0, 64)),
        (4.0, width(40.0, 30.0, 64)),
    ] {
        let s = narrow(scene(vec![wall(-z)], 512, &[v(0.0, 0.0, -1.0)]), 10.0);
        let r = ok(&s, &one(Some(beam)));
        let point = ok(&s, &one(None));
        let share = energy(&r.transient) / energy(&point.transient);
        assert!((share - 1.0).abs() < 2e-3, "{share}");
        let (_, square) = spread(&r);
        let pixel = f64::from(z / s.camera.intrinsics.fx);
        // Two coordinates, each with a quarter of the diameter, and blurred by a pixel's own width.
        let sigma = ((square[0] + square[1]) / 2.0 - 1.0 / 12.0).sqrt() * pixel;
        let expected = 0.25e-3 * libm::hypot(beam.diameter_mm, beam.divergence_mrad * f64::from(z));
        assert!(
            (sigma / expected - 1.0).abs() < 0.01,
            "{z}: {sigma} {expected}"
        );
        // Spots and truth are those of the beam's middle.
        assert_eq!(r.spots, point.spots);
        assert_eq!(r.truth.visibility, point.truth.visibility);
    }
}

#[test]
fn a_beam_at_an_edge_lights_both_sides_by_the_share_of_it_that_meets_each() {
    let beam = width(40.0, 0.0, 64);
    let sigma = 0.01f32;
    // Returns the energy on a plate that ends `off` standard deviations to the right of the beam's
    // middle, and on the wall behind.
    let lit = |off: f32| {
        let plate = quad(
            v(-1.0 + off * sigma, -1.0, -2.0),
            v(1.0, 0.0, 0.0),
            v(0.0, 2.0, 0.0),
            grey(0.5),
        );
        let mut s = scene(vec![wall(-3.0), plate], 64, &[v(0.0, 0.0, -1.0)]);
        // The camera is next to the laser, so that the plate does not hide the lit part of the
        // wall.
        s.camera.origin = v(0.5, 0.0, 0.0);
        let r = ok(&s, &one(Some(beam)));
        let between = r.gate.bin(5.0).expect("within the gate") as usize;
        let (mut on, mut behind) = (0.0, 0.0);
        for h in r.transient.chunks(r.gate.bins as usize) {
            on += energy(&h[..between]);
            behind += energy(&h[between..]);
        }
        (on, behind)
    };
    let ((whole_on, none), (nothing, whole_behind)) = (lit(9.0), lit(-9.0));
    assert!(none == 0.0 && nothing == 0.0, "{none} {nothing}");
    for (off, expected) in [(0.0, 0.5), (1.0, 0.841_345), (-0.5, 0.308_538)] {
        let (on, behind) = lit(off);
        let (on, behind) = (on / whole_on, behind / whole_behind);
        assert!((on - expected).abs() < 0.02, "{off}: {on} {expected}");
        assert!((on + behind - 1.0).abs() < 0.01, "{off}: {on} {behind}");
    }
}

#[test]
fn mirrors_fold_each_ray_and_glass_takes_from_each() {
    // A mirror at 45 degrees reflects the beam, after 2 m, to a wall 3 m to the right.
    let mirror = Material {
        bsdf: Bsdf::RoughConductor {
            reflectance: 1.0,
            alpha: 0.001,
            distribution: picofarm_scene::Distribution::Ggx,
        },
        ..grey(1.0)
    };
    let tilted = quad(
        v(-0.5, -1.0, -1.5),
        v(1.0, 0.0, -1.0),
        v(0.0, 2.0, 0.0),
        mirror,
    );
    let right = quad(
        v(3.0, -9.0, -9.0),
        v(0.0, 0.0, 18.0),
        v(0.0, 18.0, 0.0),
        grey(0.5),
    );
    let mut s = scene(vec![tilted, right], 512, &[v(0.0, 0.0, -1.0)]);
    // The camera looks at the wall.
    s.camera = picofarm_scene::Camera::look_at(
        v(0.0, 0.0, -2.0),
        v(3.0, 0.0, -2.0),
        picofarm_scene::Intrinsics::from_fov(8.0, 512, 512),
    );
    s.camera.origin = v(0.6, 0.0, -2.0);
    let beam = width(0.0, 12.0, 64);
    let r = ok(&s, &one(Some(beam)));
    let point = ok(&s, &one(None));
    let path = f64::from(point.spots[0].expect("a spot").path_m);
    assert!((path - 5.0).abs() < 1e-4, "{path}");
    let share = energy(&r.transient) / energy(&point.transient);
    assert!((share - 1.0).abs() < 2e-3, "{share}");
    let (_, square) = spread(&r);
    let pixel = f64::from(2.4 / s.camera.intrinsics.fx);
    let sigma = ((square[0] + square[1]) / 2.0 - 1.0 / 12.0).sqrt() * pixel;
    let expected = 0.25e-3 * 12.0 * 5.0;
    assert!((sigma / expected - 1.0).abs() < 0.01, "{sigma} {expected}");
    // A pane in the left half of a beam absorbs its share of that half.
    let glass = Material {
        bsdf: Bsdf::ThinDielectric {
            ior: 1.0,
            transmittance: 0.25,
            face: false,
        },
        ..grey(0.0)
    };
    let pane = quad(
        v(-1.0, -1.0, -1.0),
        v(1.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        glass,
    );
    // Light returns past the pane, because the camera is to the right.
    let mut s = scene(vec![wall(-2.0), pane], 256, &[v(0.0, 0.0, -1.0)]);
    s.camera.origin = v(0.8, 0.0, 0.0);
    let lit = |beam| energy(&ok(&s, &one(Some(beam))).transient);
    let bare = {
        let mut bare = s.clone();
        bare.objects.pop();
        energy(&ok(&bare, &one(Some(width(100.0, 0.0, 64)))).transient)
    };
    let share = lit(width(100.0, 0.0, 64)) / bare;
    assert!((share - 0.625).abs() < 0.03, "{share}");
}

/// Returns two normal numbers (Box and Muller) from a local generator.
fn normal(state: &mut u64) -> [f64; 2] {
    let mut uniform = || {
        *state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        ((*state >> 11) as f64 + 0.5) / 9_007_199_254_740_992.0
    };
    let (r, angle) = (
        (-2.0 * uniform().ln()).sqrt(),
        std::f64::consts::TAU * uniform(),
    );
    [r * angle.cos(), r * angle.sin()]
}

#[test]
fn light_from_a_wide_spot_is_that_of_point_spots_drawn_from_the_same_beam() {
    // A spot 2 cm wide (1/e²) with its middle 5 mm from a step of the wall: a third of it falls
    // onto the step.
    let beam = width(12.0, 8.0, 64);
    let step = quad(
        v(0.005, -3.0, -2.0),
        v(0.0, 0.0, -0.4),
        v(0.0, 6.0, 0.0),
        grey(0.7),
    );
    let front = quad(
        v(-3.0, -3.0, -2.0),
        v(3.005, 0.0, 0.0),
        v(0.0, 6.0, 0.0),
        grey(0.7),
    );
    let back = quad(
        v(0.005, -3.0, -2.4),
        v(3.0, 0.0, 0.0),
        v(0.0, 6.0, 0.0),
        grey(0.7),
    );
    let mut objects = room(v(-1.5, -1.5, -3.0), v(1.5, 1.5, 2.0), &grey(0.5));
    objects.extend([step, front, back]);
    let s = scene(objects, 8, &[v(0.0, 0.0, -1.0)]);
    let of = |s: &Scene, beam, seed| {
        let set = Settings {
            optics: optics(beam),
            seed,
            max_bounces: Some(3),
            ..settings(Budget::Samples(64))
        };
        let r = ok(s, &set);
        let split = r.split.expect("parts");
        let parts = |h: &[f32]| -> [f64; 2] {
            // The left half of the image and the right one.
            let mut sum = [0.0; 2];
            for (k, h) in h.chunks(r.gate.bins as usize).enumerate() {
                sum[usize::from(k % 8 >= 4)] += energy(h);
            }
            sum
        };
        let ([a, b], [c, d]) = (parts(&split.two), parts(&split.multi));
        [a, b, c, d]
    };
    const DRAWS: usize = 200;
    let mut state = 7;
    let mut all = vec![];
    for seed in 0..DRAWS {
        let mut one = s.clone();
        // Position and angle are independent of each other in a Gaussian beam.
        let ([x, y], [a, b]) = (normal(&mut state), normal(&mut state));
        one.laser.origin = v(0.003 * x as f32, 0.003 * y as f32, 0.0);
        one.laser.beams[0].direction = v(0.002 * a as f32, 0.002 * b as f32, -1.0).normalized();
        all.push(of(&one, None, seed as u64));
    }
    let wide: Vec<[f64; 4]> = (0..8).map(|seed| of(&s, Some(beam), 1000 + seed)).collect();
    let point = of(&s, None, 3);
    for part in 0..4 {
        let moments = |all: &[[f64; 4]]| {
            let n = all.len() as f64;
            let mean = all.iter().map(|a| a[part]).sum::<f64>() / n;
            let square = all.iter().map(|a| (a[part] - mean).powi(2)).sum::<f64>();
            (mean, square / (n - 1.0) / n)
        };
        let ((drawn, v), (wide, w)) = (moments(&all), moments(&wide));
        let error = (v + w).sqrt();
        eprintln!(
            "part {part}: wide {wide:.5}, drawn {drawn:.5} ± {error:.5}, a point {:.5}",
            point[part]
        );
        // With 64 rays, fractions are precise to about a hundredth.
        assert!(
            (wide - drawn).abs() < 3.5 * error + 0.01 * drawn,
            "part {part}: wide {wide}, drawn {drawn} ± {error}"
        );
    }
    // Without a width, the light in the left half of the image is very different, so the test can
    // detect a difference.
    let drawn = all.iter().map(|a| a[1]).sum::<f64>() / DRAWS as f64;
    assert!((point[1] / drawn - 1.0).abs() > 0.1, "{} {drawn}", point[1]);
}

#[test]
fn subsets_of_wide_beams_add_up_to_all_of_them() {
    let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let s = scene(walls, 16, &[v(0.3, 0.2, -1.0), v(-0.5, -0.1, -1.0)]);
    let set = Settings {
        optics: optics(Some(width(10.0, 2.0, 7))),
        groups: vec![vec![0], vec![1]],
        ..settings(Budget::Samples(4))
    };
    let r = ok(&s, &set);
    for (k, &whole) in r.transient.iter().enumerate() {
        let sum = r.groups[0][k] + r.groups[1][k];
        assert!((whole - sum).abs() <= 1e-5 * whole, "{k}: {whole} {sum}");
    }
    let plan = r.plan.strategies.join("\n");
    assert!(plan.contains("7 rays for each"), "{plan}");
}

#[test]
fn a_beam_of_almost_no_width_is_a_beam_without_one() {
    let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let s = scene(walls, 16, &[v(0.3, 0.2, -1.0)]);
    let of = |beam| {
        pixels(&ok(
            &s,
            &Settings {
                optics: optics(beam),
                ..two_only()
            },
        ))
    };
    let (thin, none) = (of(Some(width(1e-3, 0.0, 16))), of(None));
    for (a, b) in thin.iter().zip(&none) {
        // The positions within the pixels differ.
        assert!((a - b).abs() <= 0.01 * b, "{a} {b}");
    }
    let (thin, whole): (f64, f64) = (thin.iter().sum(), none.iter().sum());
    assert!((thin / whole - 1.0).abs() < 5e-4, "{thin} {whole}");
    assert!(none.iter().filter(|e| **e > 0.0).count() > 100);
}

#[test]
fn widths_that_cannot_be_used_are_refused_by_their_field() {
    let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let mut s = scene(walls, 4, &[v(0.3, 0.2, -1.0)]);
    let refused = |s: &Scene, beam| {
        let set = Settings {
            optics: optics(Some(beam)),
            ..two_only()
        };
        render(s, &set, &common::Quiet).unwrap_err().to_string()
    };
    let error = refused(&s, width(0.0, 0.0, 16));
    assert!(error.contains("beam.diameter_mm"), "{error}");
    let error = refused(&s, width(1.0, 0.0, 65));
    assert!(error.contains("beam.points"), "{error}");
    // A stated spot is used if it is where the beam ends, and not otherwise.
    let end: Vec3 = ok(&s, &two_only()).spots[0].expect("a spot").point;
    s.laser.beams = vec![beam_to(end, v(0.0, 0.0, 1.0), 4)];
    let set = Settings {
        optics: optics(Some(width(5.0, 0.0, 8))),
        ..two_only()
    };
    assert!(energy(&ok(&s, &set).transient) > 0.0);
    let spot = s.laser.beams[0].spot.as_mut().expect("stated");
    spot.point += v(0.5, 0.0, 0.0);
    let error = refused(&s, width(5.0, 0.0, 8));
    assert!(
        error.contains("laser.beams[0].spot") && error.contains("drop the spot"),
        "{error}"
    );
    // More point sources than arrivals can index.
    s.laser.beams = vec![s.laser.beams[0]; 1025];
    s.laser.beams.iter_mut().for_each(|b| b.spot = None);
    let error = refused(&s, width(5.0, 0.0, 64));
    assert!(
        error.contains("65600 point sources") && error.contains("beam.points"),
        "{error}"
    );
}
