//! Scenes that are hard to sample: near-mirrors, glossy and mixed surfaces, spots in far corners.

use picofarm_scene::{Bsdf, Distribution, Material, Object, Scene, Vec3, primitive};

use crate::common::{grey, quad, room, scene, sphere, v};

fn mixed(alpha: f32, weight: f32) -> Material {
    Material {
        bsdf: Bsdf::Mixed {
            reflectance: 0.5,
            alpha,
            distribution: Distribution::Ggx,
            specular_reflectance: 0.8,
            weight,
        },
        ..grey(0.5)
    }
}

fn rough(alpha: f32) -> Material {
    Material {
        bsdf: Bsdf::RoughConductor {
            alpha,
            distribution: Distribution::Ggx,
            reflectance: 0.8,
        },
        ..grey(0.8)
    }
}

/// A box's six sides, seen from outside.
fn block(low: Vec3, high: Vec3, m: &Material) -> Vec<Object> {
    room(low, high, m)
}

fn walls() -> Vec<Object> {
    room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6))
}

const BEAMS: [Vec3; 5] = [
    Vec3::new(0.75, 0.55, -1.0),
    Vec3::new(-0.8, -0.5, -1.0),
    Vec3::new(-0.3, 0.35, -1.0),
    Vec3::new(0.05, -0.35, -1.0),
    Vec3::new(0.45, -0.1, -1.0),
];

/// Every class of scene by name.
pub fn all(pixels: u32) -> Vec<(&'static str, Scene)> {
    let mut everything = walls();
    everything.push(sphere(
        v(0.7, -0.9, -2.6),
        0.5,
        4,
        Material::mirror("ball", 0.01),
    ));
    everything.push(sphere(v(-0.9, -1.0, -2.9), 0.4, 4, rough(0.2)));
    everything.extend(block(
        v(-0.2, -1.5, -3.4),
        v(0.4, -0.6, -2.8),
        &mixed(0.05, 0.5),
    ));
    everything.push(quad(
        v(-1.99, -0.8, -3.5),
        v(0.0, 1.2, 0.0),
        v(0.0, 0.0, 1.4),
        Material::mirror("pane", 0.01),
    ));
    everything.push(quad(
        v(1.99, -0.6, -3.0),
        v(0.0, 0.0, 1.2),
        v(0.0, 1.0, 0.0),
        rough(0.05),
    ));

    let mut coated = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &mixed(0.2, 0.4));
    coated.extend(block(
        v(-0.9, -1.5, -3.2),
        v(-0.2, -0.5, -2.5),
        &mixed(0.05, 0.5),
    ));
    coated.push(sphere(v(0.7, -0.9, -2.6), 0.5, 3, rough(0.05)));
    coated.push(sphere(v(0.2, 0.5, -3.0), 0.35, 3, rough(0.2)));

    let mut angled = walls();
    angled.push(quad(
        v(-1.8, -1.2, -3.6),
        v(1.1, 0.0, -0.2),
        v(0.0, 2.0, 0.0),
        Material::mirror("left", 0.01),
    ));
    angled.push(quad(
        v(1.4, -1.2, -3.6),
        v(0.4, 0.0, 1.2),
        v(0.0, 2.0, 0.0),
        Material::mirror("right", 0.01),
    ));
    angled.push(sphere(
        v(0.3, -0.9, -2.4),
        0.4,
        4,
        Material::mirror("ball", 0.01),
    ));

    let glossy = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &rough(0.3));

    let plain = primitive::PrimitiveSettings {
        spots: 4,
        width: pixels,
        height: pixels,
        mirror: true,
        ..primitive::PrimitiveSettings::default()
    };
    let plain = primitive::generate(3, &plain).expect("the settings are sound");
    vec![
        ("everything", scene(everything, pixels, &BEAMS)),
        ("coated", scene(coated, pixels, &BEAMS)),
        ("angled", scene(angled, pixels, &BEAMS)),
        ("glossy", scene(glossy, pixels, &BEAMS[..2])),
        ("primitive", plain),
    ]
}
