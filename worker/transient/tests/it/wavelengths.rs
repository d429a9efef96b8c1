//! A render at a wavelength is the render of a scene that reflects as it does there.

use crate::common;
use crate::hard_scenes as scenes;

use std::sync::Arc;

use common::{energy, grey, near, ok, quad, room, scene, settings, two_only, v};
use picofarm_scene::{Bsdf, Material, Object, Scene, SpectrumPoint, Texture, Vec3, Wrap};
use picofarm_transient::{Budget, Optics, Rendered, Settings, Wavelength};

const NM: [f64; 3] = [905.0, 532.0, 450.0];

fn row(nm: f64, reflectance: f32, specular: Option<f32>) -> SpectrumPoint {
    SpectrumPoint {
        nm: nm as f32,
        reflectance,
        specular_reflectance: specular,
    }
}

/// Changes every material of a scene; `number` counts them.
fn each_material(scene: &mut Scene, mut change: impl FnMut(usize, &mut Material)) {
    let mut number = 0;
    for object in &mut scene.objects {
        for m in &mut Arc::make_mut(&mut object.mesh).materials {
            change(number, m);
            number += 1;
        }
    }
}

/// Reflectances that differ from material to material and from wavelength to wavelength.
fn spectrum(number: usize, m: &Material) -> Vec<SpectrumPoint> {
    let mixed = matches!(m.bsdf, Bsdf::Mixed { .. });
    let share = |k: usize| 0.15 + 0.8 * ((number * 7 + k * 5) % 11) as f32 / 10.0;
    let at = |k: usize| row(NM[k], share(k), mixed.then(|| share(k + 3)));
    vec![at(2), at(1), at(0)]
}

/// A scene by its name in the benches, with a spectrum for every material.
fn coloured(name: &str, pixels: u32) -> Scene {
    let (_, mut scene) = scenes::all(pixels)
        .into_iter()
        .find(|(n, _)| n == name)
        .expect("there is such a scene");
    each_material(&mut scene, |number, m| m.spectrum = spectrum(number, m));
    scene
}

/// The scene as it is at one wavelength, without spectra.
fn alone(scene: &Scene, nm: f64) -> Scene {
    let mut scene = scene.clone();
    each_material(&mut scene, |_, m| {
        let at = m.at(nm as f32);
        match &mut m.bsdf {
            Bsdf::Diffuse { reflectance } => *reflectance = at.lambertian,
            Bsdf::RoughConductor { reflectance, .. } => *reflectance = at.conductor,
            Bsdf::Mixed {
                reflectance,
                specular_reflectance,
                ..
            } => (*reflectance, *specular_reflectance) = (at.lambertian, at.conductor),
            Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => {}
        }
        m.spectrum = vec![];
    });
    scene
}

fn at(nm: f64, set: Settings) -> Settings {
    Settings {
        optics: Optics {
            wavelengths_nm: Wavelength::of(&[nm]).unwrap(),
            ..set.optics
        },
        ..set
    }
}

fn bits(h: &[f32]) -> Vec<u32> {
    h.iter().map(|x| x.to_bits()).collect()
}

/// All histograms.
fn all_bits(r: &Rendered) -> Vec<Vec<u32>> {
    let s = r.split.as_ref().unwrap();
    let all = [
        &r.transient,
        &s.two,
        &s.two_se,
        &s.two_noise,
        &s.multi,
        &s.multi_se,
        &s.multi_noise,
    ];
    all.into_iter().chain(&r.groups).map(|h| bits(h)).collect()
}

#[test]
fn a_wavelength_is_a_scene_of_its_reflectances_to_the_bit() {
    for name in ["everything", "coated", "angled"] {
        let s = coloured(name, 16);
        for nm in NM {
            let set = settings(Budget::Samples(6));
            let found = ok(&s, &at(nm, set.clone()));
            let expected = ok(&alone(&s, nm), &set);
            assert!(all_bits(&found) == all_bits(&expected), "{name} {nm}");
        }
    }
}

/// A grey room, with a wall of one or several materials.
fn with_wall(wall: Vec<Object>) -> Scene {
    let mut all = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.5));
    all.extend(wall);
    scene(all, 18, &[v(0.4, 0.2, -1.0), v(-0.5, 0.3, -1.0)])
}

/// An upright strip of the wall between two shares of its width.
fn strip((from, to): (f32, f32), m: Material) -> Object {
    let (left, right) = (4.0 * from - 2.0, 4.0 * (to - from));
    quad(v(left, -1.5, -3.0), v(right, 0.0, 0.0), v(0.0, 3.0, 0.0), m)
}

#[test]
fn a_texture_colours_a_wavelength_by_its_own_channels() {
    let texels = vec![[250u8, 60, 20], [30, 80, 240]];
    let texture = Arc::new(Texture::new("paper", 2, 1, texels, Wrap::Clamp).unwrap());
    let rgb = [0.9, 0.7, 0.5];
    let mut paper = Material::diffuse("paper", rgb);
    paper.texture = Some(texture.clone());
    let mut wall = strip((0.0, 1.0), paper);
    Arc::make_mut(&mut wall.mesh).uv = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    let nm = [611.4, 464.3, 905.0];
    let set = settings(Budget::Samples(128));
    for (k, nm) in nm.into_iter().enumerate() {
        // Red, blue, and the mean of the three channels, laid out in strips that each are of one
        // reflectance.
        let reflectance = |u: f32| {
            let texel = texture.at([u, 0.5]);
            let mean = |c: [f32; 3]| (c[0] + c[1] + c[2]) / 3.0;
            match k {
                0 => rgb[0] * texel[0],
                1 => rgb[2] * texel[2],
                _ => mean(rgb) * mean(texel),
            }
        };
        let strips = (0..64u8).map(|k| {
            let at = |k: f32| k / 64.0;
            let middle = reflectance(at(f32::from(k) + 0.5));
            strip((at(f32::from(k)), at(f32::from(k) + 1.0)), grey(middle))
        });
        let other = Settings {
            seed: 5,
            ..set.clone()
        };
        let expected = ok(&with_wall(strips.collect()), &other);
        let found = ok(&with_wall(vec![wall.clone()]), &at(nm, set.clone()));
        let e = energy(&expected.transient);
        let se = found
            .error
            .total_relative
            .hypot(expected.error.total_relative);
        near(
            &format!("{nm} nm"),
            energy(&found.transient),
            e,
            0.002,
            1.5 * f64::from(se) * e,
        );
    }
}

#[test]
fn the_plan_says_whose_colour_stands_for_a_spectrum() {
    let mut wall = grey(0.5);
    wall.name = "measured".into();
    wall.spectrum = vec![row(905.0, 0.5, None)];
    let mut all = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &wall);
    let screen = quad(
        v(-1.0, -1.0, -3.0),
        v(1.0, 0.0, 0.0),
        v(0.0, 1.0, 0.0),
        grey(0.4),
    );
    all.push(screen);
    let s = scene(all, 6, &[Vec3::new(0.1, 0.1, -1.0)]);
    let plan = ok(&s, &at(905.0, two_only())).plan;
    let has = |lines: &[String], part: &str| lines.iter().any(|l| l.contains(part));
    assert!(has(&plan.strategies, "wavelengths: 905 nm"), "{plan:?}");
    assert!(
        has(&plan.approximations, "1 of 2 materials state no spectrum"),
        "{plan:?}"
    );
}
