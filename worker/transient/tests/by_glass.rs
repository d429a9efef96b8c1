//! Light that glass reflects and refracts, by closed forms and by what must not change; against an independent tracer in
//! `independent_glass.rs`.

mod common;

use common::{energy, gate, grey, ok, quad, room, scene, settings, sphere, v};
use picofarm_scene::{Bsdf, Material, Object, Scene, Vec3};
use picofarm_transient::{Budget, Rendered, Settings, trace_spots};

fn solid(ior: f32, transmittance: f32) -> Material {
    Material {
        bsdf: Bsdf::Dielectric { ior, transmittance },
        ..Material::solid_glass("solid glass")
    }
}

fn parts(r: &Rendered) -> [f64; 2] {
    let split = r.split.as_ref().expect("a split was asked for");
    [energy(&split.two), energy(&split.multi)]
}

/// Means and standard errors of both parts over seeds.
fn over_seeds(scene: &Scene, seeds: u64, samples: u32) -> [(f64, f64); 2] {
    let all: Vec<[f64; 2]> = (0..seeds)
        .map(|seed| {
            let set = Settings {
                seed,
                ..settings(Budget::Samples(samples))
            };
            parts(&ok(scene, &set))
        })
        .collect();
    [0, 1].map(|k| {
        let n = seeds as f64;
        let mean = all.iter().map(|p| p[k]).sum::<f64>() / n;
        let square = all.iter().map(|p| (p[k] - mean).powi(2)).sum::<f64>();
        (mean, (square / (n * (n - 1.0))).sqrt())
    })
}

#[test]
fn bodies_without_a_step_of_the_index_change_no_energy() {
    let objects = |more: Vec<Object>| {
        let mut all = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6));
        all.extend(more);
        all
    };
    let beams = [v(-2.0, 0.4, -2.5), v(0.3, 1.5, -1.5)];
    let ball = sphere(v(0.8, -0.5, -2.4), 0.6, 3, solid(1.0, 1.0));
    let without = over_seeds(&scene(objects(vec![]), 16, &beams), 16, 16);
    let with = over_seeds(&scene(objects(vec![ball]), 16, &beams), 16, 16);
    for (part, (a, b)) in ["two", "more"].into_iter().zip(without.into_iter().zip(with)) {
        let (off, se) = (b.0 / a.0 - 1.0, a.1.hypot(b.1) / a.0);
        println!("{part}: {:+.3} % ± {:.3} %", 100.0 * off, 100.0 * se);
        assert!(off.abs() < 1e-3 + 4.0 * se, "{part}: {off} ± {se}");
    }
}
