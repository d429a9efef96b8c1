//! Helpers for the integration tests: small scenes, settings, and the reference transients.
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod bent;
pub mod brute;
pub mod compare;
pub mod glass;
pub mod glassware;
pub mod light;
pub mod npz;
pub mod reference;
pub mod seen;
pub mod tree;

use std::sync::Arc;

use picofarm_scene::{
    Affine, Beam, Bsdf, Camera, Intrinsics, Laser, Material, Mesh, Object, Provenance, Scene, Spot,
    Vec3,
};
use picofarm_transient::{Budget, Gate, Progress, Rendered, Settings, render};

/// Lets every render run to completion.
pub struct Quiet;

impl Progress for Quiet {
    fn at(&self, _done: f32) -> bool {
        true
    }
}

pub fn v(x: f32, y: f32, z: f32) -> Vec3 {
    Vec3::new(x, y, z)
}

/// Returns the gate of the data sets.
pub fn gate() -> Gate {
    Gate {
        start_m: 1.0,
        bin_width_m: 0.0384,
        bins: 637,
    }
}

pub fn settings(budget: Budget) -> Settings {
    Settings {
        seed: 1,
        split: true,
        ..Settings::new(gate(), budget)
    }
}

/// Returns a grey two-sided Lambertian material.
pub fn grey(reflectance: f32) -> Material {
    Material {
        name: "grey".into(),
        bsdf: Bsdf::Diffuse { reflectance },
        rgb: [reflectance; 3],
        texture: None,
        two_sided: true,
        spectrum: vec![],
    }
}

pub fn object(name: &str, positions: Vec<Vec3>, triangles: Vec<[u32; 3]>, m: Material) -> Object {
    Object {
        mesh: Arc::new(Mesh {
            name: name.into(),
            triangle_material: vec![0; triangles.len()],
            positions,
            triangles,
            materials: vec![m],
            uv: vec![],
        }),
        to_world: Affine::IDENTITY,
        label: 0,
        name: name.into(),
    }
}

/// Returns a parallelogram from a corner and two edges. Its front is on the side of a × b.
pub fn quad(corner: Vec3, a: Vec3, b: Vec3, m: Material) -> Object {
    let positions = vec![corner, corner + a, corner + a + b, corner + b];
    object("quad", positions, vec![[0, 1, 2], [0, 2, 3]], m)
}

/// Returns a sphere from a subdivided octahedron.
pub fn sphere(centre: Vec3, radius: f32, levels: u32, m: Material) -> Object {
    let axis = [
        v(1.0, 0.0, 0.0),
        v(-1.0, 0.0, 0.0),
        v(0.0, 1.0, 0.0),
        v(0.0, -1.0, 0.0),
        v(0.0, 0.0, 1.0),
        v(0.0, 0.0, -1.0),
    ];
    let mut faces: Vec<[Vec3; 3]> = vec![];
    for x in [0, 1] {
        for y in [2, 3] {
            for z in [4, 5] {
                let flip = (x + y + z) % 2 == 1;
                let (a, b, c) = (axis[x], axis[y], axis[z]);
                faces.push(if flip { [a, c, b] } else { [a, b, c] });
            }
        }
    }
    for _ in 0..levels {
        faces = faces
            .into_iter()
            .flat_map(|[a, b, c]| {
                let m = |p: Vec3, q: Vec3| (p + q).normalized();
                let (ab, bc, ca) = (m(a, b), m(b, c), m(c, a));
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            })
            .collect();
    }
    let positions = faces
        .iter()
        .flatten()
        .map(|&p| centre + p * radius)
        .collect();
    let triangles = (0..faces.len() as u32)
        .map(|i| [3 * i, 3 * i + 1, 3 * i + 2])
        .collect();
    object("sphere", positions, triangles, m)
}

/// Returns the six walls of a box, seen from inside, all of one material.
pub fn room(low: Vec3, high: Vec3, m: &Material) -> Vec<Object> {
    let s = high - low;
    let (x, y, z) = (v(s.x, 0.0, 0.0), v(0.0, s.y, 0.0), v(0.0, 0.0, s.z));
    vec![
        quad(low, z, x, m.clone()),
        quad(low, x, y, m.clone()),
        quad(low, y, z, m.clone()),
        quad(high, -x, -z, m.clone()),
        quad(high, -y, -x, m.clone()),
        quad(high, -z, -y, m.clone()),
    ]
}

/// Returns a scene with a camera at the origin that looks along −z and a laser at the same place.
pub fn scene(objects: Vec<Object>, size: u32, directions: &[Vec3]) -> Scene {
    let intrinsics = Intrinsics::from_fov(90.0, size, size);
    let camera = Camera::look_at(Vec3::ZERO, v(0.0, 0.0, -1.0), intrinsics);
    Scene {
        name: "test".into(),
        objects,
        labels: vec!["thing".into()],
        camera,
        laser: Laser {
            origin: Vec3::ZERO,
            beams: directions
                .iter()
                .map(|d| Beam {
                    direction: d.normalized(),
                    spot: None,
                })
                .collect(),
        },
        provenance: Provenance::default(),
    }
}

pub fn energy(h: &[f32]) -> f64 {
    h.iter().map(|&x| f64::from(x)).sum()
}

/// Returns settings for two bounces only.
pub fn two_only() -> Settings {
    Settings {
        max_bounces: Some(2),
        ..settings(Budget::Samples(64))
    }
}

/// Returns a Lambertian material that scatters nothing.
pub fn black() -> Material {
    grey(0.0)
}

/// Returns a beam that ends on a stated spot, with the laser at the origin.
pub fn beam_to(point: Vec3, normal: Vec3, object: u32) -> Beam {
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

/// Returns a camera at `origin`. Its image is exactly the parallelogram that `corner`, `right` and
/// `down` span (at right angles to each other, seen at a right angle).
pub fn framed(origin: Vec3, corner: Vec3, right: Vec3, down: Vec3, (w, h): (u32, u32)) -> Camera {
    let (r, d) = (right.normalized(), down.normalized());
    let forward = r.cross(d);
    let depth = (corner - origin).dot(forward);
    let (fx, fy) = (
        w as f32 * depth / right.length(),
        h as f32 * depth / down.length(),
    );
    Camera {
        intrinsics: Intrinsics {
            fx,
            fy,
            cx: -(corner - origin).dot(r) / depth * fx,
            cy: -(corner - origin).dot(d) / depth * fy,
            width: w,
            height: h,
        },
        origin,
        right: r,
        down: d,
        forward,
    }
}

/// Renders a scene, and fails if there is an error.
pub fn ok(scene: &Scene, settings: &Settings) -> Rendered {
    render(scene, settings, &Quiet).unwrap()
}

/// Returns the energy of the 3+ part and the standard error of the whole.
pub fn multi_energy(r: &Rendered) -> (f64, f64) {
    let se = f64::from(r.error.total_relative) * energy(&r.transient);
    (energy(&r.split.as_ref().unwrap().multi), se)
}

/// Fails unless `got` is `expected` within a relative `tolerance` and four standard errors.
#[track_caller]
pub fn near(what: &str, got: f64, expected: f64, tolerance: f64, se: f64) {
    println!(
        "{what}: {:+.3} % ± {:.3} %",
        100.0 * (got / expected - 1.0),
        100.0 * se / expected
    );
    let slack = tolerance * expected.abs() + 4.0 * se;
    assert!(
        (got - expected).abs() <= slack,
        "{what}: {got:e} instead of {expected:e} ± {slack:e}"
    );
}
