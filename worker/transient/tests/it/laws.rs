//! Closed forms and physical laws.

use crate::common;

use std::f64::consts::PI;

use common::{Quiet, energy, grey, quad, room, scene, settings, sphere, v};
use picofarm_scene::{Affine, Beam, Scene, Spot, Vec3};
use picofarm_transient::{Budget, Gate, Rendered, Settings, Split, render};

fn ok(scene: &Scene, settings: &Settings) -> Rendered {
    render(scene, settings, &Quiet).unwrap()
}

fn split(scene: &Scene, settings: &Settings) -> Split {
    ok(scene, settings).split.unwrap()
}

/// Returns a scene with a spot on a plate to the left that lights a plate in front, which the
/// camera sees.
fn corner(rho: f32) -> Scene {
    let front = quad(
        v(-1.0, -1.0, -2.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        grey(rho),
    );
    let side = quad(
        v(-1.5, -1.0, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -2.9),
        grey(rho),
    );
    let mut s = scene(vec![front, side], 8, &[]);
    let point = v(-1.5, 0.2, -0.5);
    s.laser.beams.push(Beam {
        direction: point.normalized(),
        spot: Some(Spot {
            point,
            normal: v(1.0, 0.0, 0.0),
            arriving: point.normalized(),
            path_m: point.length(),
            object: 1,
            material: 0,
        }),
    });
    s.camera.intrinsics = picofarm_scene::Intrinsics::from_fov(40.0, 8, 8);
    s
}

#[test]
fn two_bounces_on_a_lambertian_plane_match_the_integral() {
    let rho = 0.7;
    let s = corner(rho);
    let got = split(&s, &settings(Budget::Samples(1024)));
    let (g, n) = (common::gate(), 64);
    let (mut error, mut norm) = (0.0f64, 0.0f64);
    let l = s.laser.beams[0].spot.unwrap();
    for k in 0..64 {
        let mut expected = vec![0.0f64; g.bins as usize];
        for i in 0..n * n {
            let at = |x: usize| (x as f32 + 0.5) / n as f32;
            let d = s
                .camera
                .ray((k % 8) as f32 + at(i % n), (k / 8) as f32 + at(i / n));
            let x = d * 2.0;
            let to = x - l.point;
            let r = f64::from(to.length());
            let cos_l = f64::from(l.normal.dot(to)) / r;
            let cos_x = f64::from(-to.z) / r;
            let f = f64::from(rho) / PI;
            let path = f64::from(l.path_m) + r + f64::from(x.length());
            let bin = ((path - g.start_m) / g.bin_width_m) as usize;
            expected[bin] += f * f * cos_l * cos_x / (r * r) / (n * n) as f64;
        }
        for (b, e) in expected.iter().enumerate() {
            error += (f64::from(got.two[k * 637 + b]) - e).powi(2);
            norm += e * e;
        }
        let (a, b) = (
            energy(&got.two[k * 637..(k + 1) * 637]),
            expected.iter().sum::<f64>(),
        );
        assert!((a / b - 1.0).abs() < 2e-3, "pixel {k}: {a} {b}");
    }
    assert!((error / norm).sqrt() < 0.05, "{}", (error / norm).sqrt());
    assert!(energy(&got.multi) > 0.0);
}

/// In a sphere of radius R and albedo ρ, the light of one point spreads evenly at once (cos cos /
/// d² is the constant 1/4R²): each bounce adds the radiance ρ^k / (4π² R²) in every pixel.
#[test]
fn a_white_sphere_gives_every_bounce_its_share_of_the_energy() {
    let radius = 2.0;
    for rho in [1.0f32, 0.5] {
        let s = scene(
            vec![sphere(Vec3::ZERO, radius, 5, grey(rho))],
            4,
            &[v(0.1, 0.2, -1.0)],
        );
        let long = Gate {
            start_m: 0.0,
            bin_width_m: 1.0,
            bins: 400,
        };
        // A bounce is a difference of two renders. For 1/31 of their light, the error of one seed
        // is 2 %.
        const SEEDS: u64 = 4;
        let mut before = 0.0;
        for bounces in 2..=6 {
            let of_seed = |seed| {
                let set = Settings {
                    seed,
                    gate: long,
                    max_bounces: Some(bounces),
                    ..settings(Budget::Samples(2048))
                };
                energy(&ok(&s, &set).transient) / 16.0
            };
            let mean = (0..SEEDS).map(of_seed).sum::<f64>() / SEEDS as f64;
            let one = f64::from(rho).powi(bounces as i32) / (4.0 * PI * PI * 4.0);
            let got = mean - before;
            // The faceted sphere is a little smaller than the round one.
            assert!(
                (got / one - 1.0).abs() < 0.03,
                "ρ {rho} k {bounces}: {}",
                got / one
            );
            before = mean;
        }
    }
}

#[test]
fn a_longer_way_to_the_spot_only_shifts_the_histogram() {
    let s = corner(0.7);
    let mut late = s.clone();
    if let Some(spot) = &mut late.laser.beams[0].spot {
        spot.path_m += 10.0 * 0.0384;
    }
    let set = settings(Budget::Samples(16));
    let (a, b) = (split(&s, &set).two, split(&late, &set).two);
    let (mut same, mut all) = (0.0, 0.0);
    for k in 0..64 {
        for bin in 0..627 {
            let (x, y) = (a[k * 637 + bin], b[k * 637 + bin + 10]);
            same += f64::from((x - y).abs());
            all += f64::from(x);
        }
    }
    // path_m is f32, so a few samples change their bin by rounding.
    assert!(same < 1e-3 * all, "{same} {all}");
}

#[test]
fn the_histogram_of_many_spots_is_the_sum_of_their_own() {
    let walls = || room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let camera = scene(vec![], 6, &[]).camera;
    for spots in [1, 4, 25] {
        let mut all = scene(walls(), 6, &[]);
        all.laser = picofarm_scene::Aim::grid(spots).unwrap().laser(&camera);
        let set = Settings {
            one_bounce: true,
            ..settings(Budget::Samples(256))
        };
        let together = ok(&all, &set);
        let (mut two, mut multi, mut variance, mut peaks) = (0.0, 0.0, 0.0, 0.0);
        let whole = together.split.as_ref().unwrap();
        for k in 0..spots as usize {
            let mut one = all.clone();
            one.laser.beams = vec![all.laser.beams[k]];
            let r = ok(
                &one,
                &Settings {
                    budget: Budget::Samples(64),
                    ..set.clone()
                },
            );
            let s = r.split.unwrap();
            two += energy(&s.two);
            multi += energy(&s.multi);
            variance +=
                (f64::from(r.error.total_relative) * (energy(&s.two) + energy(&s.multi))).powi(2);
            peaks += energy(&r.transient) - energy(&s.two) - energy(&s.multi);
        }
        let all = energy(&whole.two) + energy(&whole.multi);
        variance += (f64::from(together.error.total_relative) * all).powi(2);
        let one = energy(&together.transient) - energy(&whole.two) - energy(&whole.multi);
        assert!((one / peaks - 1.0).abs() < 1e-4, "{one} {peaks}");
        assert!((energy(&whole.two) / two - 1.0).abs() < 0.01);
        let z = (energy(&whole.multi) - multi) / variance.sqrt();
        assert!(z.abs() < 6.0, "{spots} spots: z {z}");
    }
}

#[test]
fn scenes_scaled_and_moved_obey_the_physical_law() {
    let base = corner(0.7);
    let set = settings(Budget::Samples(64));
    let reference = ok(&base, &set);
    for scale in [1e-3f32, 1e3] {
        let mut s = base.clone();
        for o in &mut s.objects {
            let mut mesh = (*o.mesh).clone();
            for p in &mut mesh.positions {
                *p = *p * scale;
            }
            o.mesh = mesh.into();
        }
        if let Some(spot) = &mut s.laser.beams[0].spot {
            spot.point = spot.point * scale;
            spot.path_m *= scale;
        }
        let mut scaled = set.clone();
        scaled.gate.start_m *= f64::from(scale);
        scaled.gate.bin_width_m *= f64::from(scale);
        let r = ok(&s, &scaled);
        let law = f64::from(scale) * f64::from(scale);
        let ratio = energy(&r.transient) * law / energy(&reference.transient);
        assert!((ratio - 1.0).abs() < 0.02, "{scale}: {ratio}");
    }
    // Far from the origin: the mesh stays small, and the offset is in the transform.
    let mut far = base.clone();
    let shift = v(1000.0, -500.0, 2000.0);
    for o in &mut far.objects {
        o.to_world = Affine {
            translation: shift,
            ..Affine::IDENTITY
        };
    }
    far.camera.origin = shift;
    far.laser.origin = shift;
    if let Some(spot) = &mut far.laser.beams[0].spot {
        spot.point += shift;
    }
    let ratio = energy(&ok(&far, &set).transient) / energy(&reference.transient);
    assert!((ratio - 1.0).abs() < 0.02, "{ratio}");
}

#[test]
fn beams_fold_through_mirrors_to_the_first_diffuse_surface() {
    // A mirror at 45° in front of the camera sends the beam to a wall on the right.
    let mirror = quad(
        v(-0.5, -0.5, -1.5),
        v(1.0, 0.0, -1.0),
        v(0.0, 1.0, 0.0),
        picofarm_scene::Material::mirror("mirror", 0.01),
    );
    let wall = quad(
        v(3.0, -2.0, -4.0),
        v(0.0, 4.0, 0.0),
        v(0.0, 0.0, 5.0),
        grey(0.5),
    );
    let s = scene(vec![mirror, wall], 4, &[v(0.0, 0.0, -1.0)]);
    let spot = picofarm_transient::trace_spots(&s).unwrap()[0];
    let Some(spot) = spot else {
        // With the other tilt, the beam goes left and hits nothing.
        panic!("the beam must reach the wall");
    };
    assert_eq!(spot.object, 1);
    assert!((spot.point - v(3.0, 0.0, -2.0)).length() < 1e-5, "{spot:?}");
    assert!((spot.path_m - 5.0).abs() < 1e-5);
    assert!((spot.normal - v(-1.0, 0.0, 0.0)).length() < 1e-6);
    assert!((spot.arriving - v(1.0, 0.0, 0.0)).length() < 1e-5);
}

#[test]
fn error_bars_are_roughly_right() {
    let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
    let s = scene(walls, 4, &[v(0.3, 0.2, -1.0), v(-0.5, -0.1, -1.0)]);
    let runs: Vec<Rendered> = (0..24)
        .map(|seed| {
            ok(
                &s,
                &Settings {
                    seed,
                    ..settings(Budget::Samples(128))
                },
            )
        })
        .collect();
    let count = runs.len() as f64;
    let bins = runs[0].transient.len();
    let (mut spread, mut claimed) = (0.0, 0.0);
    for i in 0..bins {
        let values = runs
            .iter()
            .map(|r| f64::from(r.split.as_ref().unwrap().multi[i]));
        let (a, b) = values.fold((0.0, 0.0), |(a, b), x| (a + x, b + x * x));
        spread += (b - a * a / count) / (count - 1.0);
        let se = |r: &Rendered| f64::from(r.split.as_ref().unwrap().multi_se[i]).powi(2);
        claimed += runs.iter().map(se).sum::<f64>() / count;
    }
    let ratio = (spread / claimed).sqrt();
    assert!((0.85..1.15).contains(&ratio), "spread / claimed {ratio}");
    let totals: Vec<f64> = runs.iter().map(|r| energy(&r.transient)).collect();
    let mean = totals.iter().sum::<f64>() / count;
    let spread = totals.iter().map(|t| (t - mean).powi(2)).sum::<f64>() / (count - 1.0);
    let claimed = f64::from(runs[0].error.total_relative) * mean;
    let ratio = spread.sqrt() / claimed;
    assert!(
        (0.6..1.5).contains(&ratio),
        "totals: spread / claimed {ratio}"
    );
}
