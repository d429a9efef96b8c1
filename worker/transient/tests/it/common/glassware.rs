//! Glass of tests: materials, and things of it.

use picofarm_scene::{Bsdf, Material, Object, Vec3};

use super::{object, v};

pub fn thin(ior: f32, transmittance: f32, face: bool) -> Material {
    Material {
        bsdf: Bsdf::ThinDielectric {
            ior,
            transmittance,
            face,
        },
        ..Material::glass("thin glass")
    }
}

pub fn body(ior: f32, transmittance: f32) -> Material {
    Material {
        bsdf: Bsdf::Dielectric { ior, transmittance },
        ..Material::solid_glass("glass")
    }
}

/// The same with its normals turned.
pub fn inverted(o: &Object) -> Object {
    let turned = |t: &[u32; 3]| [t[0], t[2], t[1]];
    object(
        "inverted",
        o.mesh.positions.clone(),
        o.mesh.triangles.iter().map(turned).collect(),
        o.mesh.materials[0].clone(),
    )
}

/// Two objects of one material as one: both surfaces of a vessel.
pub fn together(a: &Object, b: &Object) -> Object {
    let (mut positions, mut triangles) = (a.mesh.positions.clone(), a.mesh.triangles.clone());
    let first = positions.len() as u32;
    positions.extend(&b.mesh.positions);
    triangles.extend(b.mesh.triangles.iter().map(|t| t.map(|k| first + k)));
    object("vessel", positions, triangles, a.mesh.materials[0].clone())
}

/// A box, seen from outside, turned by an angle around the vertical through its middle. One object: a body.
pub fn cuboid(middle: Vec3, half: Vec3, angle: f32, m: Material) -> Object {
    let (s, c) = angle.sin_cos();
    let (x, y, z) = (
        v(c, 0.0, -s) * half.x,
        v(0.0, half.y, 0.0),
        v(s, 0.0, c) * half.z,
    );
    let faces = [(x, y, z), (y, z, x), (z, x, y)];
    let mut positions = vec![];
    for (out, a, b) in faces {
        positions.extend([out - a - b, out + a - b, out + a + b, out - a + b]);
        positions.extend([-out - a - b, -out - a + b, -out + a + b, -out + a - b]);
    }
    let positions: Vec<Vec3> = positions.into_iter().map(|p| middle + p).collect();
    let triangles = (0..6u32)
        .flat_map(|k| [[4 * k, 4 * k + 1, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 3]])
        .collect();
    object("box", positions, triangles, m)
}
