//! Materials of several parts: they equal the sum of their parts, whatever technique finds the
//! light.

mod common;
#[path = "../benches/stop/scenes.rs"]
#[allow(dead_code, reason = "a bench uses the others")]
mod scenes;

use std::{slice::from_ref, sync::Arc};

use common::{energy, grey, near, ok, quad, room, scene, settings, two_only, v};
use picofarm_scene::{Bsdf, Distribution, Lobe, Material, Part, Parts, Scene, SpectrumPoint};
use picofarm_transient::{Budget, Gate, Rendered, Settings, Strategy, Wavelengths};

fn several(parts: &[(f32, Lobe)]) -> Bsdf {
    let parts: Vec<Part> = parts
        .iter()
        .map(|&(weight, lobe)| Part { weight, lobe })
        .collect();
    Bsdf::Several {
        parts: Parts::of(&parts).unwrap(),
    }
}

fn metal(alpha: f32, reflectance: f32) -> Lobe {
    Lobe::RoughConductor {
        alpha,
        distribution: Distribution::Ggx,
        reflectance,
    }
}

/// Returns the same surface, stated as one of several parts: each part in two halves.
fn said_otherwise(bsdf: Bsdf) -> Bsdf {
    let halves = |share: f32, lobe| [(0.5 * share, lobe), (0.5 * share, lobe)];
    match bsdf {
        Bsdf::Diffuse { reflectance } => several(&halves(1.0, Lobe::Diffuse { reflectance })),
        Bsdf::RoughConductor {
            alpha,
            distribution,
            reflectance,
        } => several(&halves(
            1.0,
            Lobe::RoughConductor {
                alpha,
                distribution,
                reflectance,
            },
        )),
        Bsdf::Mixed {
            reflectance,
            alpha,
            distribution,
            specular_reflectance,
            weight,
        } => {
            let conductor = Lobe::RoughConductor {
                alpha,
                distribution,
                reflectance: specular_reflectance,
            };
            let base = halves(1.0 - weight, Lobe::Diffuse { reflectance });
            several(&[base, halves(weight, conductor)].concat())
        }
        other => other,
    }
}

fn each_material(scene: &mut Scene, mut change: impl FnMut(&mut Material)) {
    for object in &mut scene.objects {
        let mesh = Arc::make_mut(&mut object.mesh);
        mesh.materials.iter_mut().for_each(&mut change);
    }
}

/// Returns the mean energy of renders that must agree, and its standard error: the stated one, or
/// that of their spread if it is larger. Highlights in narrow lobes are rare and bright, so one
/// render occasionally states too small an error.
fn mean(all: &[Rendered], of: impl Fn(&[f32]) -> f64) -> (f64, f64) {
    let n = all.len() as f64;
    let each: Vec<f64> = all.iter().map(|r| of(&r.transient)).collect();
    let mean = each.iter().sum::<f64>() / n;
    let stated = |r: &Rendered| (f64::from(r.error.total_relative) * mean).powi(2);
    let stated = all.iter().map(stated).sum::<f64>() / (n * n);
    let scatter = each.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / (n * (n - 1.0).max(1.0));
    (mean, stated.max(scatter).sqrt())
}

/// Checks that the energies of renders agree, of the whole image and of its thirds.
fn same(what: &str, (a, b): (&[Rendered], &[Rendered])) {
    let ((_, of_a), (e, of_b)) = (mean(a, energy), mean(b, energy));
    let se = of_a.hypot(of_b) / e;
    near(what, mean(a, energy).0, e, 0.0, se * e);
    let (width, bins) = (a[0].width as usize, a[0].gate.bins as usize);
    for third in 0..3 {
        let of = |h: &[f32]| -> f64 {
            let pixels = h.chunks(bins).enumerate();
            let own = pixels.filter(|(p, _)| p % width * 3 / width == third);
            own.map(|(_, h)| energy(h)).sum()
        };
        let e = mean(b, of).0;
        let what = format!("{what}, third {third}");
        near(&what, mean(a, of).0, e, 0.0, 2.5 * se * e);
    }
}

fn scene_of(name: &str) -> Scene {
    let all = scenes::all(18);
    all.into_iter().find(|(n, _)| n == name).unwrap().1
}

#[test]
fn a_material_said_in_more_parts_is_the_same_material() {
    for (name, passes) in [
        ("everything", 128),
        ("coated", 96),
        ("angled", 96),
        ("far-03", 96),
    ] {
        let plain = scene_of(name);
        let mut parted = plain.clone();
        each_material(&mut parted, |m| m.bsdf = said_otherwise(m.bsdf));
        for max_bounces in [None, Some(2)] {
            let set = Settings {
                max_bounces,
                ..settings(Budget::Samples(passes))
            };
            // Two bounces alone take little time, and several renders give a reliable error.
            let renders = if max_bounces.is_some() { 4 } else { 1 };
            let of = |scene: &Scene, first: u64| -> Vec<Rendered> {
                let seeds = first..first + renders;
                let at = |seed| Settings {
                    seed,
                    ..set.clone()
                };
                seeds.map(|seed| ok(scene, &at(seed))).collect()
            };
            let what = match max_bounces {
                None => name.to_owned(),
                Some(_) => format!("{name}, two bounces"),
            };
            same(&what, (&of(&parted, 0), &of(&plain, 77)));
        }
    }
}

#[test]
fn spots_on_several_parts_are_seen_with_the_light_of_them_all() {
    let parts = [
        (0.3, Lobe::Diffuse { reflectance: 0.8 }),
        (0.3, metal(0.3, 0.9)),
        (0.2, metal(0.12, 0.5)),
    ];
    let directions = [v(0.1, 0.05, -1.0), v(-0.4, 0.2, -1.0)];
    let of = |bsdf: Bsdf| {
        let wall = Material { bsdf, ..grey(0.5) };
        let s = scene(
            room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &wall),
            16,
            &directions,
        );
        let set = Settings {
            max_bounces: Some(1),
            one_bounce: true,
            groups: vec![vec![1]],
            ..settings(Budget::Samples(1))
        };
        ok(&s, &set)
    };
    let all = of(several(&parts));
    assert!(energy(&all.groups[0]) > 0.0 && energy(&all.groups[0]) < energy(&all.transient));
    let mut sum = vec![0.0f64; all.transient.len()];
    for (weight, lobe) in parts {
        let one = of(lobe.bsdf());
        for (sum, x) in sum.iter_mut().zip(&one.transient) {
            *sum += f64::from(weight) * f64::from(*x);
        }
    }
    for (x, sum) in all.transient.iter().zip(sum) {
        assert!((f64::from(*x) - sum).abs() <= 1e-5 * sum, "{x} {sum}");
    }
}

#[test]
fn two_near_mirrors_in_one_surface_reflect_as_each_does_by_its_share() {
    let pane = |bsdf| {
        let mut all = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
        let m = Material { bsdf, ..grey(0.6) };
        all.push(quad(
            v(-1.98, -1.0, -3.4),
            v(0.0, 1.8, 0.0),
            v(0.0, 0.0, 1.8),
            m,
        ));
        scene(all, 18, &[v(0.4, 0.2, -1.0), v(0.6, -0.3, -1.0)])
    };
    let base = (0.4, Lobe::Diffuse { reflectance: 0.5 });
    let [both, smooth, rough] = [
        several(&[base, (0.2, metal(0.004, 0.9)), (0.4, metal(0.08, 0.9))]),
        several(&[base, (0.6, metal(0.004, 0.9))]),
        several(&[base, (0.6, metal(0.08, 0.9))]),
    ];
    let set = settings(Budget::Samples(256));
    let of = |bsdf, seed| {
        let set = Settings {
            seed,
            ..set.clone()
        };
        let r = ok(&pane(bsdf), &set);
        assert!(
            r.plan
                .strategies
                .iter()
                .any(|l| l.contains("mirror images")),
            "{:?}",
            r.plan
        );
        (energy(&r.transient), f64::from(r.error.total_relative))
    };
    let (all, a, b) = (of(both, 1), of(smooth, 2), of(rough, 3));
    // Light that hits the pane twice is not linear in it, but there is little of it.
    let expected = (a.0 + 2.0 * b.0) / 3.0;
    let se = (all.1.powi(2) + (0.34 * a.1).powi(2) + (0.67 * b.1).powi(2)).sqrt();
    near("both", all.0, expected, 0.002, se * expected);
    // The result is the same with and without aiming.
    let unaimed = Settings {
        strategy: Strategy {
            mirror_images: Some(false),
            caustics: Some(true),
            ..Strategy::default()
        },
        ..settings(Budget::Samples(256))
    };
    let plain = ok(&pane(both), &unaimed);
    let e = energy(&plain.transient);
    let se = all.1.hypot(f64::from(plain.error.total_relative));
    near("by images and by light paths", all.0, e, 0.0, se * e);
}

#[test]
fn each_part_has_its_reflectance_at_each_wavelength() {
    let nm = [905.0, 532.0];
    let mut s = scene_of("everything");
    each_material(&mut s, |m| {
        let row = |nm: f64, reflectance, specular| SpectrumPoint {
            nm: nm as f32,
            reflectance,
            specular_reflectance: Some(specular),
        };
        m.bsdf = said_otherwise(m.bsdf);
        m.spectrum = vec![row(nm[1], 0.3, 0.9), row(nm[0], 0.7, 0.4)];
    });
    let at = |nm: &[f64], seed| {
        let set = Settings {
            seed,
            wavelengths_nm: Wavelengths::of(nm).unwrap(),
            ..settings(Budget::Samples(256))
        };
        ok(&s, &set)
    };
    let both = at(&nm, 1);
    same("905 nm", (from_ref(&both), &[at(&nm[..1], 5)]));
    let other = Rendered {
        transient: both.others[0].transient.clone(),
        ..both
    };
    same("532 nm", (from_ref(&other), &[at(&nm[1..], 6)]));
}

#[test]
fn what_is_black_of_several_parts_brings_nothing_and_harms_nothing() {
    let black = several(&[
        (0.5, Lobe::Diffuse { reflectance: 0.0 }),
        (0.5, metal(0.01, 0.0)),
    ]);
    let half = several(&[
        (0.6, Lobe::Diffuse { reflectance: 0.8 }),
        (0.4, metal(0.01, 0.0)),
        (0.0, metal(0.3, 0.9)),
    ]);
    let of = |bsdf, two_sided, set: &Settings| {
        let m = Material {
            bsdf,
            two_sided,
            ..grey(0.5)
        };
        let walls = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &m);
        ok(&scene(walls, 12, &[v(0.3, 0.1, -1.0)]), set)
    };
    let set = settings(Budget::Samples(32));
    assert_eq!(energy(&of(black, true, &set).transient), 0.0);
    let grey = Bsdf::Diffuse { reflectance: 0.48 };
    same(
        "half black",
        (&[of(half, true, &set)], &[of(grey, true, &set)]),
    );
    // A one-sided surface reflects nothing from behind.
    let mut behind = scene(
        vec![quad(
            v(-2.0, -1.5, -3.0),
            v(0.0, 3.0, 0.0),
            v(4.0, 0.0, 0.0),
            Material {
                bsdf: half,
                two_sided: false,
                ..common::grey(0.5)
            },
        )],
        8,
        &[v(0.1, 0.1, -1.0)],
    );
    behind.camera.origin = v(0.0, 0.0, 0.0);
    let front = Settings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 1.0,
            bins: 20,
        },
        one_bounce: true,
        ..two_only()
    };
    assert_eq!(energy(&ok(&behind, &front).transient), 0.0);
}

#[test]
fn spots_on_walls_of_several_parts_count_once() {
    let beside = |name: &str| {
        let all = scenes::all(8);
        let (_, s) = all.iter().find(|(of, _)| of == name).unwrap();
        let strategies = ok(s, &settings(Budget::Samples(1))).plan.strategies;
        let mut beside = strategies
            .into_iter()
            .filter(|s| s.contains("beside other"));
        beside.next().unwrap()
    };
    let expected = "light paths: 5 spots close beside other surfaces";
    assert_eq!(beside("parts-lambertian"), expected);
    // Each of the same spots is two sources there. If these were counted separately, the zones
    // would reach half as far, and three spots have one.
    assert_eq!(beside("parts"), expected);
}
