//! Caustics: light paths give the same result as chance alone, with far less noise, and change
//! nothing elsewhere.

use crate::common;

use std::sync::Arc;

use common::{Quiet, beam_to, energy, grey, quad, room, scene, settings, sphere, v};
use picofarm_scene::{Beam, Bsdf, Distribution, Intrinsics, Material, Mesh, Object, Scene};
use picofarm_transient::{Budget, Rendered, Settings, Strategy, render, trace_spots};

const BINS: usize = 637;

fn with(caustics: Option<bool>, passes: u32, seed: u64) -> Settings {
    Settings {
        seed,
        strategy: Strategy {
            caustics,
            ..Strategy::default()
        },
        ..settings(Budget::Samples(passes))
    }
}

/// Returns a grey room of 3 × 2 × 3 m with spots on its left wall and its floor, and the given
/// objects.
fn furnished(things: Vec<Object>, size: u32) -> Scene {
    let mut objects = room(v(-1.5, -1.0, -2.5), v(1.5, 1.0, 0.5), &grey(0.6));
    objects.extend(things);
    let mut s = scene(objects, size, &[]);
    let towards = [v(-1.5, 0.3, -1.2), v(0.9, -1.0, -1.0)];
    s.laser.beams = towards
        .iter()
        .map(|p| Beam {
            direction: p.normalized(),
            spot: None,
        })
        .collect();
    s
}

fn ball(material: Material) -> Object {
    sphere(v(0.1, -0.4, -1.7), 0.35, 3, material)
}

fn mixed(alpha: f32, weight: f32) -> Material {
    Material {
        bsdf: Bsdf::Mixed {
            reflectance: 0.5,
            alpha,
            distribution: Distribution::Ggx,
            specular_reflectance: 0.9,
            weight,
        },
        ..grey(0.5)
    }
}

/// Returns energies of the 3+ part by pixel.
fn pixels(r: &Rendered) -> Vec<f64> {
    let multi = &r.split.as_ref().unwrap().multi;
    multi.chunks(BINS).map(energy).collect()
}

/// Returns the means and variances over seeds of each entry that `read` returns.
fn over_seeds(
    s: &Scene,
    seeds: u64,
    make: impl Fn(u64) -> Settings,
    read: impl Fn(&Rendered) -> Vec<f64>,
) -> Vec<(f64, f64)> {
    let all: Vec<Vec<f64>> = (1..=seeds)
        .map(|seed| read(&render(s, &make(seed), &Quiet).unwrap()))
        .collect();
    let n = seeds as f64;
    (0..all[0].len())
        .map(|k| {
            let mean = all.iter().map(|x| x[k]).sum::<f64>() / n;
            let square = all.iter().map(|x| (x[k] - mean).powi(2)).sum::<f64>();
            (mean, square / (n - 1.0))
        })
        .collect()
}

/// Returns the total, the four quarters of the image, and the first quarter of its histograms.
fn parts(r: &Rendered) -> Vec<f64> {
    let all = pixels(r);
    let (w, h) = (r.width as usize, r.height as usize);
    let quarter = |down: usize, right: usize| {
        let inside =
            |k: &usize| (k / w >= h / 2) as usize == down && (k % w >= w / 2) as usize == right;
        (0..w * h).filter(inside).map(|k| all[k]).sum::<f64>()
    };
    let early = r.split.as_ref().unwrap().multi.chunks(BINS);
    vec![
        all.iter().sum(),
        quarter(0, 0),
        quarter(0, 1),
        quarter(1, 0),
        quarter(1, 1),
        early.map(|h| energy(&h[..150])).sum(),
    ]
}

/// Checks that renders with and without light paths agree within a few errors of the means over
/// seeds, and that these errors are below `small`.
fn same(name: &str, s: &Scene, (off, on): (u32, u32), max_bounces: Option<u32>, small: f64) {
    let seeds = 12;
    let make = |caustics, passes| {
        move |seed| Settings {
            max_bounces,
            ..with(Some(caustics), passes, seed)
        }
    };
    let a = over_seeds(s, seeds, make(false, off), parts);
    let b = over_seeds(s, seeds, make(true, on), parts);
    for (k, (a, b)) in a.iter().zip(&b).enumerate() {
        let error = ((a.1 + b.1) / seeds as f64).sqrt();
        let z = (b.0 - a.0) / error;
        println!(
            "{name} {k}: off {:.5} on {:.5} ratio {:.4} error {:.4} z {z:.2} variance {:.1}",
            a.0,
            b.0,
            b.0 / a.0,
            error / a.0,
            a.1 * f64::from(off) / (b.1 * f64::from(on))
        );
        assert!(z.abs() < 4.5, "{name} part {k}: {a:?} {b:?}");
        let limit = if k == 0 { small } else { 5.0 * small };
        assert!(error < limit * a.0, "{name} part {k} is too noisy to tell");
    }
}

#[test]
fn light_paths_and_chance_find_the_same_light() {
    let s = furnished(vec![ball(Material::mirror("ball", 0.1))], 8);
    same("all bounces", &s, (192, 32), None, 0.02);
    same("three bounces", &s, (192, 32), Some(3), 0.04);
    same("four bounces", &s, (192, 32), Some(4), 0.03);
}

#[test]
fn mixes_and_rows_of_mirrors_are_parted_without_a_rest() {
    let plane = quad(
        v(1.49, -0.9, -2.2),
        v(0.0, 0.0, 1.8),
        v(0.0, 1.6, 0.0),
        Material::mirror("plane", 0.08),
    );
    let things = vec![ball(mixed(0.08, 0.4)), plane];
    same(
        "mix and plane",
        &furnished(things, 8),
        (192, 32),
        None,
        0.02,
    );
    let far = quad(
        v(-1.2, -0.9, -2.49),
        v(1.0, 0.0, 0.0),
        v(0.0, 1.6, 0.0),
        mixed(0.08, 0.7),
    );
    let plane = quad(
        v(1.49, -0.9, -2.2),
        v(0.0, 0.0, 1.8),
        v(0.0, 1.6, 0.0),
        Material::mirror("plane", 0.08),
    );
    same(
        "two planes",
        &furnished(vec![far, plane], 8),
        (192, 32),
        None,
        0.02,
    );
}

/// Returns a room with caustics behind the camera, and a mirror in which the camera sees them,
/// which hides most of the rest.
fn looking_back(mirror: Object, ball: f32) -> Scene {
    let thrower = sphere(v(0.7, -0.5, -0.3), 0.3, 3, Material::mirror("ball", ball));
    furnished(vec![mirror, thrower], 8)
}

fn pane(material: Material) -> Object {
    quad(
        v(-0.6, -0.4, -1.1),
        v(1.2, 0.0, 0.1),
        v(0.0, 0.8, 0.0),
        material,
    )
}

#[test]
fn caustics_that_the_camera_sees_in_near_mirrors_are_found_in_one_way() {
    let plane = pane(Material::mirror("plane", 0.08));
    same("plane", &looking_back(plane, 0.08), (192, 32), None, 0.03);
    let plane = pane(mixed(0.1, 0.7));
    same("mix", &looking_back(plane, 0.1), (192, 32), None, 0.03);
    let globe = |alpha| sphere(v(0.0, 0.0, -2.1), 1.0, 3, Material::mirror("globe", alpha));
    let s = looking_back(globe(0.08), 0.05);
    same("globe", &s, (384, 32), Some(4), 0.03);
    // The plane is so much smoother that chance finds its caustics.
    let plane = pane(Material::mirror("plane", 0.005));
    same("smoother", &looking_back(plane, 0.1), (192, 64), None, 0.03);
    // Two mirrors in a row.
    let mut s = looking_back(pane(Material::mirror("plane", 0.08)), 0.08);
    s.objects.push(quad(
        v(-1.2, -0.9, 0.49),
        v(0.0, 1.7, 0.0),
        v(2.4, 0.0, 0.0),
        mixed(0.08, 0.6),
    ));
    same("two", &s, (384, 32), None, 0.03);
}

#[test]
fn caustics_that_the_camera_sees_in_a_near_mirror_are_far_less_noisy_than_by_chance() {
    let s = looking_back(pane(Material::mirror("plane", 0.02)), 0.03);
    let off = over_seeds(&s, 12, |seed| with(Some(false), 256, seed), pixels);
    let on = over_seeds(&s, 12, |seed| with(None, 32, seed), pixels);
    let (off, on) = (sum(&off), sum(&on));
    let factor = off.1 / on.1 * 256.0 / 32.0;
    println!("off {off:?} on {on:?} factor {factor:.0}");
    assert!(factor > 20.0);
    let error = ((off.1 + on.1) / 12.0).sqrt();
    assert!((off.0 - on.0).abs() < 5.0 * error, "{off:?} {on:?}");
}

#[test]
fn a_glossy_receiver_and_a_spot_on_a_mirror_are_covered() {
    let glossy = Material {
        bsdf: Bsdf::RoughConductor {
            alpha: 0.3,
            distribution: Distribution::Beckmann,
            reflectance: 0.8,
        },
        ..grey(0.8)
    };
    let board = quad(
        v(-1.4, -0.99, -2.4),
        v(0.0, 0.0, 2.6),
        v(2.8, 0.0, 0.0),
        glossy,
    );
    let mut s = furnished(vec![ball(Material::mirror("ball", 0.08)), board], 8);
    // The second spot moves onto the near-mirror, to the beam's intersection with it.
    let towards = v(0.02, -0.3, -1.4).normalized();
    let centre = v(0.1, -0.4, -1.7);
    let b = towards.dot(centre);
    let reach = b - (b * b - centre.dot(centre) + 0.35f32.powi(2)).sqrt();
    let point = towards * reach;
    let found = {
        let mut probe = s.clone();
        probe.objects[6].mesh = Arc::new(Mesh {
            materials: vec![grey(0.5)],
            ..(*probe.objects[6].mesh).clone()
        });
        probe.laser.beams = vec![Beam {
            direction: point.normalized(),
            spot: None,
        }];
        trace_spots(&probe).unwrap()[0].unwrap()
    };
    assert_eq!(found.object, 6);
    s.laser.beams[1] = Beam {
        direction: point.normalized(),
        spot: Some(found),
    };
    same("glossy floor", &s, (192, 32), None, 0.03);
}

/// Returns a screen in front of the camera, a lit plate to its left, and an object that reflects
/// light onto the screen from below.
fn stage(extra: Object) -> Scene {
    let screen = quad(
        v(-1.0, -1.0, -2.0),
        v(2.0, 0.0, 0.0),
        v(0.0, 2.0, 0.0),
        grey(0.7),
    );
    let plate = quad(
        v(-1.5, -1.0, 1.0),
        v(0.0, 2.0, 0.0),
        v(0.0, 0.0, -2.9),
        grey(0.7),
    );
    let mut s = scene(vec![screen, plate, extra], 8, &[]);
    s.camera.intrinsics = Intrinsics::from_fov(40.0, 8, 8);
    s.laser.beams = vec![
        beam_to(v(-1.5, 0.2, -0.5), v(1.0, 0.0, 0.0), 1),
        beam_to(v(-1.5, -0.3, -0.9), v(1.0, 0.0, 0.0), 1),
    ];
    s
}

/// Returns the sums of means and of variances.
fn sum(x: &[(f64, f64)]) -> (f64, f64) {
    x.iter().fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1))
}

#[test]
fn caustics_of_a_curved_near_mirror_are_far_less_noisy_than_by_chance() {
    let s = stage(sphere(
        v(0.0, -1.6, -1.0),
        0.6,
        4,
        Material::mirror("ball", 0.03),
    ));
    let off = over_seeds(&s, 8, |seed| with(Some(false), 512, seed), pixels);
    let on = over_seeds(&s, 8, |seed| with(None, 32, seed), pixels);
    let (off, on) = (sum(&off), sum(&on));
    let factor = off.1 / on.1 * 512.0 / 32.0;
    println!("off {off:?} on {on:?} factor {factor:.0}");
    assert!(factor > 100.0);
    // 64 pixels, which are nearly independent if only chance finds the light.
    let error = ((off.1 + on.1) / 8.0).sqrt();
    assert!((off.0 - on.0).abs() < 5.0 * error, "{off:?} {on:?}");
}

#[test]
fn groups_share_the_light_out_and_threads_change_nothing() {
    let mut s = furnished(vec![ball(Material::mirror("ball", 0.01))], 12);
    let wanted = Settings {
        groups: vec![vec![0], vec![1], vec![0, 1]],
        max_bounces: Some(5),
        ..with(None, 4, 7)
    };
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap()
            .install(|| render(&s, &wanted, &Quiet).unwrap())
    };
    let (one, two) = (on(1), on(2));
    assert_eq!(one.transient, two.transient);
    assert_eq!(one.groups, two.groups);
    let (a, b) = (one.split.unwrap(), two.split.unwrap());
    assert_eq!(a.multi_se, b.multi_se);
    assert_eq!(a.multi_noise, b.multi_noise);
    assert!(
        one.plan
            .strategies
            .iter()
            .any(|s| s.contains("light paths"))
    );
    for (k, &h) in one.transient.iter().enumerate() {
        let apart = one.groups[0][k] + one.groups[1][k];
        let near = |x: f32| (x - h).abs() <= 1e-4 * h.abs() + 1e-9;
        assert!(near(apart) && near(one.groups[2][k]), "{k}: {h} {apart}");
    }
    // A spot alone has the light of its group.
    let mine: Vec<f64> = one.groups.iter().map(|g| energy(g)).collect();
    for spot in 0..2 {
        let all = s.laser.beams.clone();
        s.laser.beams = vec![all[spot]];
        let alone = Settings {
            groups: vec![],
            ..wanted.clone()
        };
        let alone = energy(&render(&s, &alone, &Quiet).unwrap().transient);
        assert!((alone / mine[spot] - 1.0).abs() < 0.1, "{alone} {mine:?}");
        s.laser.beams = all;
    }
}

#[test]
fn light_paths_are_left_out_where_nothing_calls_for_them() {
    let bits = |s: &Scene, caustics, max_bounces| {
        let settings = Settings {
            max_bounces,
            ..with(caustics, 2, 3)
        };
        let r = render(s, &settings, &Quiet).unwrap();
        let paths = r.plan.strategies.iter().any(|s| s.contains("light paths"));
        (r.transient, paths)
    };
    let floor = quad(
        v(-1.4, -0.99, -2.4),
        v(0.0, 0.0, 2.6),
        v(2.8, 0.0, 0.0),
        Material::mirror("floor", 0.01),
    );
    let ball = ball(Material::mirror("ball", 0.01));
    for (things, max_bounces) in [(vec![], None), (vec![floor], None), (vec![ball], Some(2))] {
        let s = furnished(things, 8);
        let (auto, off) = (
            bits(&s, None, max_bounces),
            bits(&s, Some(false), max_bounces),
        );
        assert!(!auto.1);
        assert_eq!(auto, off);
    }
}

#[test]
fn the_stated_error_counts_light_paths_in() {
    let s = furnished(vec![ball(Material::mirror("ball", 0.08))], 8);
    let seeds = 12;
    let all: Vec<Rendered> = (0..seeds)
        .map(|seed| render(&s, &with(Some(true), 16, 100 + seed), &Quiet).unwrap())
        .collect();
    let n = seeds as f64;
    let totals: Vec<f64> = all.iter().map(|r| energy(&r.transient)).collect();
    let mean = totals.iter().sum::<f64>() / n;
    let spread = totals.iter().map(|t| (t - mean).powi(2)).sum::<f64>() / (n - 1.0);
    let stated = all
        .iter()
        .map(|r| f64::from(r.error.total_relative).powi(2));
    let stated = stated.sum::<f64>() / n * mean * mean;
    let ratio = (spread / stated).sqrt();
    // Compared bin by bin.
    let multi = |r: &Rendered, k: usize| f64::from(r.split.as_ref().unwrap().multi[k]);
    let (mut found, mut said) = (0.0, 0.0);
    for k in 0..all[0].transient.len() {
        let mean = all.iter().map(|r| multi(r, k)).sum::<f64>() / n;
        found += all
            .iter()
            .map(|r| (multi(r, k) - mean).powi(2))
            .sum::<f64>()
            / (n - 1.0);
        let se = |r: &Rendered| f64::from(r.split.as_ref().unwrap().multi_se[k]).powi(2);
        said += all.iter().map(se).sum::<f64>() / n;
    }
    let bins = (found / said).sqrt();
    println!("total {ratio} bins {bins}");
    assert!((0.5..2.0).contains(&ratio), "{ratio}");
    assert!((0.7..1.4).contains(&bins), "{bins}");
}

#[test]
fn light_vertices_leave_nothing_out_on_glossy_surfaces() {
    let glossy = Material {
        bsdf: Bsdf::RoughConductor {
            alpha: 0.3,
            distribution: Distribution::Beckmann,
            reflectance: 0.8,
        },
        ..grey(0.8)
    };
    let s = furnished(vec![ball(glossy)], 8);
    let make = |lights: bool| {
        move |seed| Settings {
            max_bounces: Some(3),
            strategy: Strategy {
                light_vertices: Some(lights),
                ..Strategy::default()
            },
            ..with(None, 64, seed)
        }
    };
    let a = over_seeds(&s, 8, make(false), parts);
    let b = over_seeds(&s, 8, make(true), parts);
    for (a, b) in a.iter().zip(&b) {
        let error = ((a.1 + b.1) / 8.0).sqrt();
        println!(
            "without {:.6} with {:.6} error {:.5} z {:.2}",
            a.0,
            b.0,
            error / a.0,
            (b.0 - a.0) / error
        );
        assert!((b.0 - a.0).abs() < 4.5 * error);
    }
}

#[test]
fn light_paths_by_way_of_a_planar_mirror_agree_with_its_mirror_images() {
    let floor = quad(
        v(-1.5, -1.2, 1.0),
        v(3.0, 0.0, 0.0),
        v(0.0, 0.0, -3.0),
        Material::mirror("floor", 0.01),
    );
    let s = stage(floor);
    let make = |caustics: bool, passes| {
        let strategy = Strategy {
            caustics: Some(caustics),
            mirror_images: Some(!caustics),
            ..Strategy::default()
        };
        move |seed| Settings {
            max_bounces: Some(4),
            strategy,
            ..with(None, passes, seed)
        }
    };
    let lobes = over_seeds(&s, 8, make(false, 32), parts);
    let paths = over_seeds(&s, 8, make(true, 256), parts);
    for (a, b) in lobes.iter().zip(&paths) {
        let error = ((a.1 + b.1) / 8.0).sqrt();
        let z = (b.0 - a.0) / error;
        println!(
            "lobes {:.6} paths {:.6} error {:.4} z {z:.2}",
            a.0,
            b.0,
            error / a.0
        );
        assert!(z.abs() < 4.5 && error < 0.03 * a.0, "{a:?} {b:?}");
    }
}
