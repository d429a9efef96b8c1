//! Glass for tests: materials and objects.

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

/// Returns the object with its normals flipped.
pub fn inverted(o: &Object) -> Object {
    let turned = |t: &[u32; 3]| [t[0], t[2], t[1]];
    object(
        "inverted",
        o.mesh.positions.clone(),
        o.mesh.triangles.iter().map(turned).collect(),
        o.mesh.materials[0].clone(),
    )
}

/// Joins two objects of one material into one: both surfaces of a vessel.
pub fn together(a: &Object, b: &Object) -> Object {
    let (mut positions, mut triangles) = (a.mesh.positions.clone(), a.mesh.triangles.clone());
    let first = positions.len() as u32;
    positions.extend(&b.mesh.positions);
    triangles.extend(b.mesh.triangles.iter().map(|t| t.map(|k| first + k)));
    object("vessel", positions, triangles, a.mesh.materials[0].clone())
}

/// Returns a box, seen from outside, rotated by an angle around the vertical through its middle. As
/// one object, it is a body.
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
