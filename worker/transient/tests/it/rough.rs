//! Rough conductors and mixes, which have vertices that pixels share, and near-mirrors in between:
//! energies against an independent tracer of light paths in f64.

use crate::common;

use common::{
    beam_to,
    brute::P,
    energy, grey,
    light::{Start, Tracer},
    near, ok, quad, room, scene, settings, sphere, v,
};
use picofarm_scene::{Bsdf, Distribution, Material, Object, Scene};
use picofarm_transient::{Budget, Gate, Settings};

fn conductor(alpha: f32) -> Material {
    Material {
        bsdf: Bsdf::RoughConductor {
            alpha,
            distribution: Distribution::Beckmann,
            reflectance: 0.7,
        },
        ..grey(0.7)
    }
}

fn mixed(alpha: f32) -> Material {
    Material {
        bsdf: Bsdf::Mixed {
            reflectance: 0.5,
            alpha,
            distribution: Distribution::Ggx,
            specular_reflectance: 0.8,
            weight: 0.4,
        },
        ..grey(0.5)
    }
}

/// A room with two beams' spots far from its edges.
fn with_spot(objects: Vec<Object>) -> (Scene, Start) {
    let mut s = scene(objects, 24, &[]);
    let p = v(0.5, 0.3, -4.0);
    s.laser.beams.push(beam_to(p, v(0.0, 0.0, 1.0), 1));
    let start = Start {
        p: P(0.5, f64::from(0.3f32), -4.0),
        n: P(0.0, 0.0, 1.0),
        object: 1,
    };
    (s, start)
}

fn walls(m: &Material) -> Vec<Object> {
    room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), m)
}

/// Compares the energy of three bounces and more with the tracer's, within 0.3 % and four standard
/// errors of both, and likewise that of exactly two bounces.
#[track_caller]
fn agrees(what: &str, objects: Vec<Object>, (passes, paths): (u32, usize)) {
    let (s, start) = with_spot(objects);
    let reference = Tracer::new(&s).energies(0, start, paths, 11);
    let gate = Gate {
        start_m: 0.0,
        bin_width_m: 4.0,
        bins: 100,
    };
    let r = ok(
        &s,
        &Settings {
            gate,
            ..settings(Budget::Samples(passes))
        },
    );
    let split = r.split.as_ref().unwrap();
    let stated = f64::from(r.error.total_relative) * energy(&r.transient);
    for (part, h, expected) in [
        ("two", &split.two, reference[0]),
        ("multi", &split.multi, reference[1]),
    ] {
        let se = stated.hypot(expected.se);
        near(
            &format!("{what}, {part}"),
            energy(h),
            expected.mean,
            0.003,
            se,
        );
        assert!(
            part == "two" || se < 0.014 * expected.mean,
            "{what}, {part}: {se}"
        );
    }
}

#[test]
fn rough_walls_have_the_energy_of_an_independent_tracer() {
    agrees("walls of α 0.3", walls(&conductor(0.3)), (384, 150_000));
}

#[test]
fn smoother_walls_have_the_energy_of_an_independent_tracer() {
    agrees("walls of α 0.2", walls(&conductor(0.2)), (384, 200_000));
}

#[test]
fn mixed_walls_have_the_energy_of_an_independent_tracer() {
    agrees("mixed walls", walls(&mixed(0.2)), (384, 150_000));
}

#[test]
fn rough_things_and_near_mirrors_in_a_grey_room_agree_with_an_independent_tracer() {
    let mut things = walls(&grey(0.6));
    things.push(sphere(v(-0.8, -0.7, -2.6), 0.5, 1, conductor(0.2)));
    things.push(quad(
        v(0.4, -1.2, -3.2),
        v(1.0, 0.0, 0.4),
        v(0.0, 1.4, 0.0),
        conductor(0.12),
    ));
    things.push(quad(
        v(1.98, -1.0, -3.0),
        v(0.0, 0.0, 1.6),
        v(0.0, 1.8, 0.0),
        conductor(0.1),
    ));
    agrees("rough things", things, (384, 200_000));
}
