//! Scenes that are hard to sample: near-mirrors, glossy and mixed surfaces, spots in far corners.

use picofarm_scene::{
    AssetLibrary, Bsdf, Distribution, Material, Object, Scene, Texture, Vec3, Wrap,
    furnished::{self, FurnishedSettings},
    primitive,
};

use picofarm_settings::Spots;

use super::common::{grey, object, quad, room, scene, sphere, v};

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

/// A wall with black and white squares.
fn squared(wall: &Object, size: f32) -> Object {
    let texels = vec![[20; 3], [235; 3], [235; 3], [20; 3]];
    let texture = Texture::new("squares", 2, 2, texels, Wrap::Repeat).expect("four texels");
    let mut mesh = (*wall.mesh).clone();
    let [corner, right, _, up] = [0, 1, 2, 3].map(|k| mesh.positions[k]);
    let times = |side: Vec3| side.length() / (2.0 * size);
    let (x, y) = (times(right - corner), times(up - corner));
    mesh.uv = vec![[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]];
    for m in &mut mesh.materials {
        m.texture = Some(texture.clone().into());
    }
    Object {
        mesh: mesh.into(),
        ..wall.clone()
    }
}

/// Returns the six sides of a box, seen from outside.
fn block(low: Vec3, high: Vec3, m: &Material) -> Vec<Object> {
    room(low, high, m)
}

fn walls() -> Vec<Object> {
    room(v(-2.0, -1.5, -4.0), v(2.0, 1.5, 1.0), &grey(0.6))
}

/// Number of rooms of [`far`].
const FAR: u64 = 16;

const BEAMS: [Vec3; 5] = [
    Vec3::new(0.75, 0.55, -1.0),
    Vec3::new(-0.8, -0.5, -1.0),
    Vec3::new(-0.3, 0.35, -1.0),
    Vec3::new(0.05, -0.35, -1.0),
    Vec3::new(0.45, -0.1, -1.0),
];

/// Returns every class of scene by name.
pub fn all(pixels: u32) -> Vec<(String, Scene)> {
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
        spots: Spots::Grid(4),
        width: pixels,
        height: pixels,
        ..primitive::PrimitiveSettings::default()
    };
    let plain = primitive::generate(3, &plain).expect("the settings are sound");
    let mut pair = walls();
    pair.push(quad(
        v(-1.9, -1.2, -3.7),
        v(1.5, 0.0, -0.2),
        v(0.0, 2.0, 0.0),
        Material::mirror("left", 0.01),
    ));
    pair.push(quad(
        v(1.2, -1.2, -3.9),
        v(0.7, 0.0, 1.4),
        v(0.0, 2.0, 0.0),
        Material::mirror("right", 0.01),
    ));
    pair.push(sphere(
        v(0.6, -0.8, -2.6),
        0.4,
        4,
        Material::mirror("ball", 0.01),
    ));
    pair.push(cylinder(
        v(-0.6, -1.5, -2.8),
        0.3,
        1.6,
        Material::mirror("column", 0.01),
    ));

    let library = AssetLibrary::find("parametric", &[]).expect("it is built in");
    let furniture = FurnishedSettings {
        spots: Spots::Grid(4),
        width: pixels,
        height: pixels,
        specular_at_least: 0,
        ..FurnishedSettings::default()
    };
    // Panes that reflect and bodies that refract, and the same rooms without them.
    let mut clear = walls();
    clear.push(sphere(v(0.9, -1.0, -2.9), 0.4, 3, grey(0.5)));
    let mut windows = clear.clone();
    windows.push(quad(
        v(-1.4, -0.9, -3.9),
        v(2.8, 0.0, 0.0),
        v(0.0, 1.9, 0.0),
        Material::glass("window"),
    ));
    windows.push(quad(
        v(-2.0, -1.5, -2.0),
        v(2.4, 0.0, -0.5),
        v(0.0, 2.2, 0.0),
        Material::glass("partition"),
    ));
    let mut bodies = clear.clone();
    let liquid = Material {
        bsdf: Bsdf::Dielectric {
            ior: 1.33,
            transmittance: 0.8,
        },
        ..Material::solid_glass("liquid")
    };
    let glass = Material::solid_glass("glass");
    bodies.push(sphere(v(-0.7, -0.7, -2.4), 0.5, 3, glass));
    bodies.push(sphere(v(0.5, 0.3, -2.8), 0.35, 3, liquid));
    let furnished = |seed| furnished::generate(seed, &furniture, &library).expect("sound settings");

    // Two rooms with an open door between them, light through slats, and walls of fine squares.
    let partition = |low: f32, high: f32| {
        quad(
            v(low, -1.5, -2.4),
            v(high - low, 0.0, 0.0),
            v(0.0, 3.0, 0.0),
            grey(0.6),
        )
    };
    let mut door = walls();
    door.extend([partition(-2.0, -0.35), partition(0.35, 2.0)]);
    let through = [v(0.2, 0.1, -3.0), v(-0.25, 0.2, -3.9), v(0.1, -0.3, -3.5)];
    let mut blinds = walls();
    blinds.extend((0..40).map(|k| {
        let foot = v(-2.0, -1.5 + 0.075 * k as f32, -2.6);
        quad(foot, v(4.0, 0.0, 0.0), v(0.0, 0.03, 0.05), grey(0.6))
    }));
    // The laser is in the other room.
    let lit_by_door = |width: f32, spots: &[Vec3]| {
        let mut objects = walls();
        objects.extend([partition(-2.0, -width), partition(width, 2.0)]);
        let mut scene = scene(objects, pixels, spots);
        scene.laser.origin = v(1.2, 0.2, -3.2);
        scene
    };
    let aside = [v(0.8, 0.1, -0.3), v(0.5, -0.6, -0.4), v(0.6, 0.7, 0.1)];
    let squares = |side: f32| {
        let all = walls().iter().map(|wall| squared(wall, side)).collect();
        scene(all, pixels, &BEAMS)
    };

    let mut all: Vec<(String, Scene)> = [
        ("door", scene(door, pixels, &through)),
        ("lit-by-door", lit_by_door(0.35, &aside)),
        ("ajar", lit_by_door(0.06, &aside[..1])),
        ("blinds", scene(blinds, pixels, &BEAMS)),
        ("squares", squares(0.02)),
        ("squares-4", squares(0.042)),
        ("squares-7", squares(0.024)),
        ("everything", scene(everything, pixels, &BEAMS)),
        ("coated", scene(coated, pixels, &BEAMS)),
        ("angled", scene(angled, pixels, &BEAMS)),
        ("glossy", scene(glossy, pixels, &BEAMS[..2])),
        ("primitive", plain),
        ("pair", scene(pair, pixels, &BEAMS)),
        ("windows", scene(windows, pixels, &BEAMS)),
        ("bodies", scene(bodies, pixels, &BEAMS)),
        ("no-glass", scene(clear, pixels, &BEAMS)),
        ("furnished-5", furnished(5)),
        ("furnished-8", furnished(8)),
    ]
    .map(|(name, scene)| (name.to_owned(), scene))
    .into();
    all.extend((1..=FAR).map(|seed| (format!("far-{seed:02}"), far(seed, None, pixels))));
    // Rooms of rough and mixed walls with Lambertians of the same albedo in their place: what
    // roughness costs.
    let twins = ["coated", "glossy", "far-03"].map(|name| {
        let (_, rough) = all.iter().find(|(of, _)| of == name).expect("it is one");
        (format!("{name}-lambertian"), lambertian(rough))
    });
    all.extend(twins);
    // Mitsuba's default distribution instead of GGX.
    let sharp = ["coated", "glossy"].map(|name| {
        let (_, ggx) = all.iter().find(|(of, _)| of == name).expect("it is one");
        (format!("beckmann-{name}"), beckmann(ggx))
    });
    all.extend(sharp);
    // The same rooms with walls of other materials.
    let walls = [
        ("walls-mixed-0.01", mixed(0.01, 0.5)),
        ("walls-mixed-0.05", mixed(0.05, 0.6)),
        ("walls-rough-0.12", rough(0.12)),
        ("walls-rough-0.05", rough(0.05)),
    ];
    for (name, walls) in walls {
        let rooms = (1..=3).map(|k| (format!("{name}-{k}"), far(k, Some(&walls), pixels)));
        all.extend(rooms);
    }
    all
}

/// Returns a scene with each rough or mixed material replaced by a Lambertian of the same albedo;
/// near-mirrors stay.
fn lambertian(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    let materials = scene.objects.iter_mut().flat_map(|o| {
        let mesh = std::sync::Arc::make_mut(&mut o.mesh);
        &mut mesh.materials
    });
    for m in materials.filter(|m| !m.is_specular()) {
        *m = grey(albedo(&m.bsdf));
    }
    scene
}

/// Returns a scene with Beckmann's distribution for every conductor and mix.
fn beckmann(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    let materials = scene.objects.iter_mut().flat_map(|o| {
        let mesh = std::sync::Arc::make_mut(&mut o.mesh);
        &mut mesh.materials
    });
    for m in materials {
        match &mut m.bsdf {
            Bsdf::RoughConductor { distribution, .. } | Bsdf::Mixed { distribution, .. } => {
                *distribution = Distribution::Beckmann;
            }
            _ => {}
        }
    }
    scene
}

/// Returns the share of light that a material scatters, without masking.
fn albedo(bsdf: &Bsdf) -> f32 {
    match bsdf {
        Bsdf::Diffuse { reflectance } | Bsdf::RoughConductor { reflectance, .. } => *reflectance,
        Bsdf::Mixed {
            reflectance,
            specular_reflectance,
            weight,
            ..
        } => (1.0 - weight) * reflectance + weight * specular_reflectance,
        Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => 0.0,
    }
}

/// Returns the side of a standing cylinder.
fn cylinder(foot: Vec3, radius: f32, height: f32, m: Material) -> Object {
    let sides = 48;
    let (mut positions, mut triangles) = (vec![], vec![]);
    for k in 0..sides {
        let angle = std::f32::consts::TAU * k as f32 / sides as f32;
        let out = v(radius * angle.cos(), 0.0, radius * angle.sin());
        positions.extend([foot + out, foot + out + v(0.0, height, 0.0)]);
        let (a, b) = (2 * k, 2 * ((k + 1) % sides));
        triangles.extend([[a, a + 1, b], [b, a + 1, b + 1]]);
    }
    object("cylinder", positions, triangles, m)
}

/// Returns a deep room with five spots far from the camera, and with near-mirrors, glossy and mixed
/// objects at random places. The renderer's constants were not tuned on these rooms. `walls`
/// replaces the grey or mixed walls.
fn far(seed: u64, walls: Option<&Material>, pixels: u32) -> Scene {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut uniform = move |low: f32, high: f32| {
        // Xorshift64* (Vigna 2016).
        state ^= state >> 12;
        state ^= state << 25;
        state ^= state >> 27;
        let bits = state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 40;
        low + (high - low) * bits as f32 / (1u64 << 24) as f32
    };
    let (half, tall, deep) = (uniform(1.5, 3.0), uniform(1.2, 1.8), uniform(4.0, 7.0));
    let back = -deep;
    let any = |k: u32, u: f32| match k {
        0 => Material::mirror("near-mirror", 0.01),
        1 => rough(0.05),
        2 => rough(0.12),
        3 => rough(0.2),
        4 => rough(0.35),
        5 => mixed(0.01, u),
        6 => mixed(0.05, u),
        _ => mixed(0.2, u),
    };
    let pick = |u: f32| any(u as u32, 0.2 + 0.6 * u.fract());
    let outer = match seed % 3 {
        0 => mixed(0.2, 0.4),
        1 => grey(0.4),
        _ => grey(0.75),
    };
    let outer = walls.unwrap_or(&outer);
    let mut things = room(v(-half, -tall, back), v(half, tall, 1.0), outer);
    for _ in 0..2 {
        let m = pick(uniform(0.0, 8.0));
        let at = v(
            uniform(-half + 0.5, half - 0.5),
            uniform(-tall + 0.4, tall - 0.4),
            uniform(back + 0.6, -2.0),
        );
        things.push(sphere(at, uniform(0.25, 0.5), 4, m));
    }
    for _ in 0..2 {
        let low = v(uniform(-half, half - 0.9), -tall, uniform(back, -2.4));
        let size = v(uniform(0.3, 0.9), uniform(0.4, 1.6), uniform(0.3, 0.8));
        things.extend(block(low, low + size, &pick(uniform(0.0, 8.0))));
    }
    let at = v(uniform(-half, half - 0.6), -tall, uniform(back + 0.5, -2.0));
    things.push(cylinder(
        at,
        uniform(0.15, 0.35),
        uniform(0.8, 2.0),
        pick(uniform(0.0, 8.0)),
    ));
    // Panes on three walls; one of them is always a near-mirror.
    let pane = |u: f32| Material::mirror("pane", if u < 0.5 { 0.01 } else { 0.05 });
    things.push(quad(
        v(-half + 0.02, uniform(-tall, 0.0), uniform(back, -3.0)),
        v(0.0, uniform(0.6, 1.4), 0.0),
        v(0.0, 0.0, uniform(0.6, 1.8)),
        pane(uniform(0.0, 1.0)),
    ));
    things.push(quad(
        v(half - 0.02, uniform(-tall, 0.0), uniform(back, -3.0)),
        v(0.0, 0.0, uniform(0.6, 1.8)),
        v(0.0, uniform(0.6, 1.4), 0.0),
        pick(uniform(0.0, 8.0)),
    ));
    things.push(quad(
        v(uniform(-half, half - 1.0), uniform(-tall, 0.0), back + 0.02),
        v(uniform(0.5, 1.0), 0.0, 0.0),
        v(0.0, uniform(0.6, 1.4), 0.0),
        pick(uniform(0.0, 8.0)),
    ));
    let beams: Vec<Vec3> = (0..5)
        .map(|_| match seed % 2 {
            0 => v(uniform(-0.9, 0.9) * half, uniform(-0.9, 0.9) * tall, back),
            _ => v(uniform(-1.6, 1.6) * half, uniform(-1.6, 1.6) * tall, back),
        })
        .collect();
    scene(things, pixels, &beams)
}
