//! Caustics: light paths give what chance alone gives, at far less noise, and change nothing elsewhere.

mod common;

use common::{Quiet, energy, grey, quad, room, scene, settings, sphere, v};
use picofarm_scene::{Beam, Bsdf, Distribution, Material, Object, Scene, Spot, Vec3};
use picofarm_transient::{Budget, Rendered, Settings, Strategy, render};

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

/// A beam whose spot is where it is said to be, on the given object.
fn beam(point: Vec3, normal: Vec3, object: u32) -> Beam {
    Beam {
        direction: point.normalized(),
        spot: Some(Spot {
            point,
            normal,
            arriving: point.normalized(),
            path_m: point.length(),
            object,
            material: 0,
        }),
    }
}

/// A grey room of 3 × 2 × 3 m, spots on its left wall and its floor, and things in it.
fn furnished(things: Vec<Object>, size: u32) -> Scene {
    let mut objects = room(v(-1.5, -1.0, -2.5), v(1.5, 1.0, 0.5), &grey(0.6));
    objects.extend(things);
    let mut s = scene(objects, size, &[]);
    s.laser.beams = vec![
        beam(v(-1.5, 0.3, -1.2), v(1.0, 0.0, 0.0), 0),
        beam(v(0.6, -1.0, -1.6), v(0.0, 1.0, 0.0), 0),
    ];
    let walls = picofarm_transient::trace_spots(&{
        let mut s = s.clone();
        s.laser.beams.iter_mut().for_each(|b| b.spot = None);
        s
    });
    for (beam, found) in s.laser.beams.iter_mut().zip(walls.unwrap()) {
        beam.spot = found;
    }
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

/// Energies of the 3+ part by pixel.
fn pixels(r: &Rendered) -> Vec<f64> {
    let multi = &r.split.as_ref().unwrap().multi;
    multi.chunks(BINS).map(energy).collect()
}

/// Means and variances over seeds of each entry that `read` gives.
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

/// Total, the four quarters of the image, and the first quarter of its histograms.
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

/// With and without light paths: the same within `limit` errors of the means, which are small.
fn same(name: &str, s: &Scene, (off, on): (u32, u32), max_bounces: Option<u32>, small: f64) {
    let seeds = 8;
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
        assert!(
            error < 2.0 * small * a.0,
            "{name} part {k} is too noisy to tell"
        );
    }
    assert!(a[0].1.sqrt() / (seeds as f64).sqrt() < small * a[0].0);
}

#[test]
fn light_paths_and_chance_find_the_same_light() {
    let s = furnished(vec![ball(Material::mirror("ball", 0.08))], 8);
    same("all bounces", &s, (256, 64), None, 0.02);
    same("three bounces", &s, (256, 64), Some(3), 0.04);
    same("four bounces", &s, (256, 64), Some(4), 0.03);
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
        (256, 64),
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
        (256, 64),
        None,
        0.02,
    );
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
    // The second spot moves onto the near-mirror, where the beam meets it.
    let towards = v(0.02, -0.3, -1.4).normalized();
    let centre = v(0.1, -0.4, -1.7);
    let b = towards.dot(centre);
    let reach = b - (b * b - centre.dot(centre) + 0.35f32.powi(2)).sqrt();
    let point = towards * reach;
    let found = {
        let mut probe = s.clone();
        probe.objects[6].mesh = std::sync::Arc::new(picofarm_scene::Mesh {
            materials: vec![grey(0.5)],
            ..(*probe.objects[6].mesh).clone()
        });
        probe.laser.beams = vec![Beam {
            direction: point.normalized(),
            spot: None,
        }];
        picofarm_transient::trace_spots(&probe).unwrap()[0].unwrap()
    };
    assert_eq!(found.object, 6);
    s.laser.beams[1] = Beam {
        direction: point.normalized(),
        spot: Some(found),
    };
    same("glossy floor", &s, (256, 64), None, 0.03);
}

/// A screen before the camera, a lit plate to its left, and what throws light onto the screen from below.
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
    s.camera.intrinsics = picofarm_scene::Intrinsics::from_fov(40.0, 8, 8);
    s.laser.beams = vec![
        beam(v(-1.5, 0.2, -0.5), v(1.0, 0.0, 0.0), 1),
        beam(v(-1.5, -0.3, -0.9), v(1.0, 0.0, 0.0), 1),
    ];
    s
}

/// Sums of means and of variances.
fn sum(x: &[(f64, f64)]) -> (f64, f64) {
    x.iter().fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1))
}

#[test]
fn caustics_of_a_curved_near_mirror_are_far_less_noisy_than_by_chance() {
    for (alpha, passes) in [(0.03, 1024), (0.01, 1024)] {
        let ball = sphere(v(0.0, -1.6, -1.0), 0.6, 4, Material::mirror("ball", alpha));
        let s = stage(ball);
        let off = over_seeds(&s, 8, |seed| with(Some(false), passes, seed), pixels);
        let on = over_seeds(&s, 8, |seed| with(None, passes / 16, seed), pixels);
        let (off, on) = (sum(&off), sum(&on));
        println!(
            "alpha {alpha} off {off:?} on {on:?} factor {}",
            off.1 / on.1 * 16.0
        );
    }
}

#[test]
fn light_paths_by_way_of_a_planar_mirror_agree_with_its_image_lobes() {
    let floor = quad(
        v(-1.5, -1.2, 1.0),
        v(3.0, 0.0, 0.0),
        v(0.0, 0.0, -3.0),
        Material::mirror("floor", 0.01),
    );
    let s = stage(floor);
    for max_bounces in [Some(3), Some(4), None] {
        let make = |caustics: bool| {
            move |seed| Settings {
                max_bounces,
                strategy: Strategy {
                    caustics: Some(caustics),
                    image_lobes: Some(!caustics),
                    ..Strategy::default()
                },
                ..with(None, 64, seed)
            }
        };
        let lobes = over_seeds(&s, 8, make(false), parts);
        let paths = over_seeds(&s, 8, make(true), parts);
        for (a, b) in lobes.iter().zip(&paths) {
            let error = ((a.1 + b.1) / 8.0).sqrt();
            println!(
                "{max_bounces:?} lobes {:.6} paths {:.6} error {:.4} z {:.2} v {:.2}",
                a.0,
                b.0,
                error / a.0,
                (b.0 - a.0) / error,
                a.1 / b.1
            );
        }
    }
}

#[test]
#[ignore = "experiment"]
fn deep() {
    let get = |k: &str, d: f32| std::env::var(k).map_or(d, |v| v.parse().unwrap());
    let (off, on) = (get("OFF", 256.0) as u32, get("ON", 64.0) as u32);
    let alpha = get("ALPHA", 0.1);
    let max = get("MAX", 0.0) as u32;
    let max = (max > 0).then_some(max);
    let plane = || {
        quad(
            v(1.49, -0.9, -2.2),
            v(0.0, 0.0, 1.8),
            v(0.0, 1.6, 0.0),
            Material::mirror("plane", alpha),
        )
    };
    let coat = || mixed(alpha, get("WEIGHT", 0.4));
    let things = match std::env::var("WHAT").unwrap_or_default().as_str() {
        "mix" => vec![ball(coat())],
        "mixplane" => vec![ball(coat()), plane()],
        "ballplane" => vec![ball(Material::mirror("ball", alpha)), plane()],
        "flatmix" => vec![quad(
            v(1.49, -0.9, -2.2),
            v(0.0, 0.0, 1.8),
            v(0.0, 1.6, 0.0),
            coat(),
        )],
        _ => vec![ball(Material::mirror("ball", alpha))],
    };
    same("deep", &furnished(things, 8), (off, on), max, 1.0);
}
