//! Several wavelengths in one pass: each of them equals the render of a scene with the reflectances
//! of that wavelength.

mod common;
#[path = "../benches/stop/scenes.rs"]
#[allow(dead_code, reason = "a bench uses the others")]
mod scenes;

use std::sync::Arc;

use common::{Quiet, energy, grey, near, ok, quad, room, scene, settings, two_only, v};
use picofarm_scene::{Bsdf, Material, Object, Scene, SpectrumPoint, Texture, Vec3, Wrap};
use picofarm_transient::{
    BeamWidth, Budget, Gate, Part, PartOf, Rendered, Settings, Wavelengths, join_parts, render,
    render_part,
};

const NM: [f64; 3] = [905.0, 532.0, 450.0];

fn row(nm: f64, reflectance: f32, specular: Option<f32>) -> SpectrumPoint {
    SpectrumPoint {
        nm: nm as f32,
        reflectance,
        specular_reflectance: specular,
    }
}

/// Changes every material of a scene. `number` counts the materials.
fn each_material(scene: &mut Scene, mut change: impl FnMut(usize, &mut Material)) {
    let mut number = 0;
    for object in &mut scene.objects {
        for m in &mut Arc::make_mut(&mut object.mesh).materials {
            change(number, m);
            number += 1;
        }
    }
}

/// Returns reflectances that differ from material to material and from wavelength to wavelength.
fn spectrum(number: usize, m: &Material) -> Vec<SpectrumPoint> {
    let mixed = matches!(m.bsdf, Bsdf::Mixed { .. });
    let share = |k: usize| 0.15 + 0.8 * ((number * 7 + k * 5) % 11) as f32 / 10.0;
    let at = |k: usize| row(NM[k], share(k), mixed.then(|| share(k + 3)));
    vec![at(2), at(1), at(0)]
}

/// Returns a scene by its name in the benches, with a spectrum for every material.
fn coloured(name: &str, pixels: u32) -> Scene {
    let (_, mut scene) = scenes::all(pixels)
        .into_iter()
        .find(|(n, _)| n == name)
        .expect("there is such a scene");
    each_material(&mut scene, |number, m| m.spectrum = spectrum(number, m));
    scene
}

/// Returns the scene at one wavelength, without spectra.
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
            Bsdf::Several { .. } | Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => {}
        }
        m.spectrum = vec![];
    });
    scene
}

fn at(nm: &[f64], set: Settings) -> Settings {
    Settings {
        wavelengths_nm: Wavelengths::of(nm).unwrap(),
        ..set
    }
}

fn bits(h: &[f32]) -> Vec<u32> {
    h.iter().map(|x| x.to_bits()).collect()
}

/// Returns all values of the main wavelength.
fn main_bits(r: &Rendered) -> Vec<Vec<u32>> {
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
fn in_a_room_of_one_reflectance_the_kth_bounce_goes_with_its_kth_power() {
    let mut wall = grey(0.8);
    wall.spectrum = vec![row(532.0, 0.2, None), row(905.0, 0.8, None)];
    let room = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &wall);
    let s = scene(room, 12, &[v(0.3, 0.2, -1.0), v(-0.5, 0.1, -1.0)]);
    let of = |max_bounces, one_bounce| {
        let set = Settings {
            max_bounces: Some(max_bounces),
            one_bounce,
            ..settings(Budget::Samples(16))
        };
        ok(&s, &at(&[905.0, 532.0], set))
    };
    let exactly = |found: &[f32], expected: &dyn Fn(usize) -> f64| {
        for (k, &x) in found.iter().enumerate() {
            let e = expected(k);
            assert!((f64::from(x) - e).abs() <= 1e-5 * e + 1e-12, "{k}: {x} {e}");
        }
    };
    let one = of(1, true);
    exactly(&one.others[0].transient, &|k| {
        0.25 * f64::from(one.transient[k])
    });
    let two = of(2, false);
    exactly(&two.others[0].transient, &|k| {
        f64::from(two.transient[k]) / 16.0
    });
    let three = of(3, false);
    let parts = three.split.as_ref().unwrap();
    exactly(&three.others[0].transient, &|k| {
        f64::from(parts.two[k]) / 16.0 + f64::from(parts.multi[k]) / 64.0
    });
    assert!(energy(&three.others[0].transient) > 0.0);
}

#[test]
fn one_wavelength_is_a_scene_of_its_reflectances_to_the_bit() {
    for name in ["everything", "coated", "angled"] {
        let s = coloured(name, 16);
        for nm in NM {
            let set = settings(Budget::Samples(6));
            let found = ok(&s, &at(&[nm], set.clone()));
            let expected = ok(&alone(&s, nm), &set);
            assert!(main_bits(&found) == main_bits(&expected), "{name} {nm}");
            assert!(found.others.is_empty());
        }
    }
}

/// Gives every material its existing reflectance at the first wavelength, and `share(number,
/// wavelength)` of it at the others.
fn darken(scene: &mut Scene, share: impl Fn(usize, usize) -> f32) {
    each_material(scene, |number, m| {
        let (lambertian, conductor) = match m.bsdf {
            Bsdf::Diffuse { reflectance } | Bsdf::RoughConductor { reflectance, .. } => {
                (reflectance, None)
            }
            Bsdf::Mixed {
                reflectance,
                specular_reflectance,
                ..
            } => (reflectance, Some(specular_reflectance)),
            Bsdf::Several { .. } | Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => return,
        };
        let at = |k: usize, x: f32| row(NM[k], lambertian * x, conductor.map(|c| c * x));
        m.spectrum = vec![at(2, share(number, 2)), at(1, share(number, 1)), at(0, 1.0)];
    });
}

#[test]
fn where_all_reflects_half_as_much_three_bounces_bring_an_eighth_however_they_are_found() {
    let beside = |s: &mut Scene| s.laser.beams[0].direction = v(1.999, 1.2, -3.995).normalized();
    let wide = BeamWidth {
        diameter_mm: 8.0,
        divergence_mrad: 4.0,
        points: 4,
    };
    for (name, near_wall, beam) in [
        ("everything", false, None),
        ("everything", true, None),
        ("everything", false, Some(wide)),
        ("coated", false, None),
        ("angled", false, None),
        ("primitive", false, None),
        ("far-03", false, None),
    ] {
        let (_, mut s) = scenes::all(20)
            .into_iter()
            .find(|(n, _)| n == name)
            .unwrap();
        darken(&mut s, |_, _| 0.5);
        if near_wall {
            beside(&mut s);
        }
        for caustics in [Some(true), Some(false)] {
            let mut set = Settings {
                max_bounces: Some(3),
                beam,
                ..settings(Budget::Samples(8))
            };
            set.strategy.caustics = caustics;
            let r = ok(&s, &at(&NM[..2], set));
            let zones = r.plan.strategies.iter().any(|l| l.contains("close beside"));
            assert!(zones || !near_wall, "{name}: {:?}", r.plan.strategies);
            let parts = r.split.as_ref().unwrap();
            let mut light = 0;
            for (k, &x) in r.others[0].transient.iter().enumerate() {
                let expected = 0.25 * f64::from(parts.two[k]) + 0.125 * f64::from(parts.multi[k]);
                let apart = (f64::from(x) - expected).abs();
                assert!(apart <= 2e-5 * expected, "{name}: {k}: {x} {expected}");
                light += usize::from(x > 0.0);
            }
            assert!(light > 1000, "{name}: {light}");
        }
    }
}

#[test]
fn darker_wavelengths_change_no_bit_of_the_main_one() {
    for name in ["everything", "coated", "angled"] {
        let (_, mut s) = scenes::all(16)
            .into_iter()
            .find(|(n, _)| n == name)
            .unwrap();
        darken(&mut s, |number, k| ((number * 3 + 3 * k) % 5) as f32 / 5.0);
        let set = Settings {
            groups: vec![vec![0, 2], vec![1]],
            one_bounce: true,
            ..settings(Budget::Samples(6))
        };
        let alone = ok(&s, &set);
        let found = ok(&s, &at(&NM, set));
        assert!(main_bits(&found) == main_bits(&alone), "{name}");
        assert_eq!(found.error, alone.error);
        assert_eq!(found.rays, alone.rays);
    }
}

/// Returns `PICOFARM_EFFORT`, the factor by which passes are multiplied.
fn effort() -> u32 {
    std::env::var("PICOFARM_EFFORT").map_or(1, |n| n.parse().expect("PICOFARM_EFFORT is a number"))
}

/// Compares the light of each wavelength with a render of the scene that has those reflectances and
/// another seed.
fn compare(what: &str, s: &Scene, passes: u32, set: &Settings) {
    let set = Settings {
        budget: Budget::Samples(passes * effort()),
        ..set.clone()
    };
    let all = ok(s, &at(&NM, set.clone()));
    for (k, nm) in NM.into_iter().enumerate() {
        let apart = Settings {
            seed: 77,
            ..at(&[nm], set.clone())
        };
        let alone = ok(s, &apart);
        let (h, e) = match k {
            0 => (&all.transient, &alone.transient),
            _ => (&all.others[k - 1].transient, &alone.transient),
        };
        // Paths are drawn by the brightest reflectances: no wavelength has rarer ones, but their
        // weights vary more.
        let se = f64::from(all.error.total_relative).hypot(f64::from(alone.error.total_relative));
        near(
            &format!("{what}, {nm} nm"),
            energy(h),
            energy(e),
            0.0,
            1.5 * se * energy(e),
        );
        for (column, group) in ["left", "middle", "right"].into_iter().enumerate() {
            let third = |h: &[f32]| -> f64 {
                let pixels = h.chunks(set.gate.bins as usize).enumerate();
                let width = s.camera.intrinsics.width as usize;
                let own = pixels.filter(|(p, _)| p % width * 3 / width == column);
                own.map(|(_, h)| energy(h)).sum()
            };
            let slack = 3.0 * se * third(e);
            near(
                &format!("{what}, {nm} nm, {group}"),
                third(h),
                third(e),
                0.0,
                slack,
            );
        }
    }
}

#[test]
fn each_wavelength_is_the_render_of_a_scene_that_reflects_so() {
    for (name, passes) in [
        ("everything", 128),
        ("coated", 96),
        ("angled", 96),
        ("primitive", 32),
    ] {
        let s = coloured(name, 18);
        compare(name, &s, passes, &settings(Budget::Samples(1)));
        let two = Settings {
            max_bounces: Some(2),
            ..settings(Budget::Samples(1))
        };
        compare(&format!("{name}, two bounces"), &s, passes, &two);
    }
}

#[test]
fn wide_beams_and_spots_beside_walls_have_their_wavelengths() {
    let s = {
        let mut s = coloured("everything", 18);
        // A spot that almost touches the corner of the room.
        s.laser.beams[0].direction = v(1.999, 1.2, -3.995).normalized();
        s
    };
    let wide = Settings {
        beam: Some(BeamWidth {
            diameter_mm: 8.0,
            divergence_mrad: 4.0,
            points: 5,
        }),
        one_bounce: true,
        ..settings(Budget::Samples(1))
    };
    compare("wide beams", &s, 192, &wide);
    compare("beside a wall", &s, 192, &settings(Budget::Samples(1)));
}

/// Returns a grey room with a wall of one or several materials.
fn with_wall(wall: Vec<Object>) -> Scene {
    let mut all = room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.5));
    all.extend(wall);
    scene(all, 18, &[v(0.4, 0.2, -1.0), v(-0.5, 0.3, -1.0)])
}

/// Returns an upright strip of the wall between two fractions of its width.
fn strip((from, to): (f32, f32), m: Material) -> Object {
    let (left, right) = (4.0 * from - 2.0, 4.0 * (to - from));
    quad(v(left, -1.5, -3.0), v(right, 0.0, 0.0), v(0.0, 3.0, 0.0), m)
}

#[test]
fn a_texture_colours_each_wavelength_by_its_own_channels() {
    let texels = vec![[250u8, 60, 20], [30, 80, 240]];
    let texture = Arc::new(Texture::new("paper", 2, 1, texels, Wrap::Clamp).unwrap());
    let rgb = [0.9, 0.7, 0.5];
    let mut paper = Material::diffuse("paper", rgb);
    paper.texture = Some(texture.clone());
    let mut wall = strip((0.0, 1.0), paper);
    Arc::make_mut(&mut wall.mesh).uv = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    let nm = [611.4, 464.3, 905.0];
    let set = settings(Budget::Samples(128));
    let all = ok(&with_wall(vec![wall]), &at(&nm, set.clone()));
    for (k, nm) in nm.into_iter().enumerate() {
        // Red, blue, and the mean of the three channels, as strips of one reflectance each.
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
        let found = match k {
            0 => &all.transient,
            _ => &all.others[k - 1].transient,
        };
        let e = energy(&expected.transient);
        let se = all
            .error
            .total_relative
            .hypot(expected.error.total_relative);
        near(
            &format!("{nm} nm"),
            energy(found),
            e,
            0.002,
            1.5 * f64::from(se) * e,
        );
    }
}

#[test]
fn the_order_of_the_other_wavelengths_changes_no_bit() {
    let s = coloured("everything", 16);
    let set = Settings {
        groups: vec![vec![0, 3]],
        ..settings(Budget::Samples(4))
    };
    let a = ok(&s, &at(&[905.0, 532.0, 450.0], set.clone()));
    let b = ok(&s, &at(&[905.0, 450.0, 532.0], set));
    assert!(main_bits(&a) == main_bits(&b));
    for (x, y) in [(0, 1), (1, 0)] {
        assert_eq!(a.others[x].nm, b.others[y].nm);
        assert!(bits(&a.others[x].transient) == bits(&b.others[y].transient));
        assert!(bits(&a.others[x].groups[0]) == bits(&b.others[y].groups[0]));
    }
    assert!(energy(&a.others[0].groups[0]) > 0.0);
}

#[test]
fn groups_of_each_spot_add_up_to_all_spots_at_every_wavelength() {
    let s = coloured("everything", 12);
    let groups: Vec<Vec<u32>> = (0..s.laser.beams.len() as u32).map(|b| vec![b]).collect();
    let set = Settings {
        groups,
        one_bounce: true,
        ..settings(Budget::Samples(8))
    };
    let r = ok(&s, &at(&NM, set));
    let mains = std::iter::once((&r.transient, &r.groups));
    let others = r.others.iter().map(|o| (&o.transient, &o.groups));
    for (all, groups) in mains.chain(others) {
        let sum: f64 = groups.iter().map(|g| energy(g)).sum();
        assert!((sum / energy(all) - 1.0).abs() < 1e-4);
    }
}

#[test]
fn parts_of_a_render_join_to_the_same_bits_at_every_wavelength() {
    let s = coloured("everything", 40);
    let set = at(&NM, settings(Budget::Samples(4)));
    let whole = ok(&s, &set);
    let parts: Vec<Part> = PartOf::all(3)
        .map(|which| render_part(&s, &set, which, &Quiet).unwrap())
        .collect();
    let joined = join_parts(&s, &set, parts, &Quiet).unwrap();
    assert!(main_bits(&whole) == main_bits(&joined));
    for (a, b) in whole.others.iter().zip(&joined.others) {
        assert!(bits(&a.transient) == bits(&b.transient));
    }
}

#[test]
fn a_black_wavelength_is_black_and_harms_no_other() {
    let mut s = coloured("everything", 12);
    each_material(&mut s, |_, m| {
        let specular = matches!(m.bsdf, Bsdf::Mixed { .. }).then_some(0.0);
        m.spectrum.insert(0, row(300.0, 0.0, specular));
    });
    let set = settings(Budget::Samples(8));
    let with = ok(&s, &at(&[905.0, 300.0], set.clone()));
    let without = ok(&s, &at(&[905.0], set.clone()));
    assert_eq!(energy(&with.others[0].transient), 0.0);
    assert!(main_bits(&with) == main_bits(&without));
    // As the main wavelength, it has no light that paths can be drawn by: its paths carry the light
    // of the other wavelength.
    let first = ok(&s, &at(&[300.0, 905.0], set));
    assert_eq!(energy(&first.transient), 0.0);
    let (a, b) = (
        energy(&first.others[0].transient),
        energy(&without.transient),
    );
    assert!((a / b - 1.0).abs() < 1e-5, "{a} {b}");
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
    let plan = ok(&s, &at(&[905.0, 532.0], two_only())).plan;
    let has = |lines: &[String], part: &str| lines.iter().any(|l| l.contains(part));
    assert!(
        has(&plan.strategies, "wavelengths: 905, 532 nm"),
        "{plan:?}"
    );
    assert!(
        has(&plan.approximations, "1 of 2 materials state no spectrum"),
        "{plan:?}"
    );
}

#[test]
fn more_values_a_pixel_than_can_be_counted_are_refused_by_name() {
    let s = coloured("everything", 1);
    let set = Settings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 1e-3,
            bins: 1 << 20,
        },
        groups: vec![vec![0]; 1024],
        ..at(&[905.0, 532.0, 450.0, 633.0], two_only())
    };
    let refused = render(&s, &set, &Quiet).unwrap_err().to_string();
    assert!(
        refused.contains("groups: make 4100 histograms"),
        "{refused}"
    );
}
