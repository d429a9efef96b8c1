//! Writes PLY: one mesh, or a whole scene in world space with the colour and instance of each face.

use std::fmt::Write as _;

use crate::{Mesh, Scene, Vec3, texture::srgb_byte};

/// Encodes a mesh as binary little-endian PLY, with texture coordinates `u`, `v` (v down) if it has
/// them.
pub(super) fn mesh_bytes(mesh: &Mesh) -> Vec<u8> {
    let uv = (!mesh.uv.is_empty()).then_some(mesh.uv.as_slice());
    let mut out = header(mesh.positions.len(), uv.is_some(), mesh.triangles.len(), "");
    for (k, p) in mesh.positions.iter().enumerate() {
        vertex(&mut out, *p, uv.map(|uv| uv[k]));
    }
    for t in &mesh.triangles {
        face(&mut out, *t);
    }
    out
}

/// Encodes a scene as one mesh in world space: each face has its material's sRGB colour (`red`,
/// `green`, `blue`) and its object's index (`instance`). PLY cannot represent camera, laser, BSDFs
/// and textures.
pub(super) fn scene_bytes(scene: &Scene) -> Vec<u8> {
    let vertices = scene.objects.iter().map(|o| o.mesh.positions.len()).sum();
    let faces =
        "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uint instance\n";
    let mut out = header(vertices, false, scene.triangle_count(), faces);
    for object in &scene.objects {
        for p in &object.mesh.positions {
            vertex(&mut out, object.to_world.point(*p), None);
        }
    }
    let mut base = 0;
    for (instance, object) in scene.objects.iter().enumerate() {
        let mesh = &object.mesh;
        for (t, &m) in mesh.triangles.iter().zip(&mesh.triangle_material) {
            face(&mut out, t.map(|v| v + base));
            let material = &mesh.materials[m as usize];
            let texture = material.texture.as_ref().map_or([1.0; 3], |t| t.mean());
            for (c, f) in material.rgb.into_iter().zip(texture) {
                out.push(srgb_byte(c * f));
            }
            out.extend((instance as u32).to_le_bytes());
        }
        base += mesh.positions.len() as u32;
    }
    out
}

fn header(vertices: usize, uv: bool, faces: usize, more: &str) -> Vec<u8> {
    let mut text = String::from("ply\nformat binary_little_endian 1.0\ncomment picofarm\n");
    let uv = if uv {
        "property float u\nproperty float v\n"
    } else {
        ""
    };
    write!(
        text,
        "element vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n{uv}\
         element face {faces}\nproperty list uchar uint vertex_indices\n{more}end_header\n"
    )
    .expect("strings take every text");
    text.into_bytes()
}

fn vertex(out: &mut Vec<u8>, p: Vec3, uv: Option<[f32; 2]>) {
    for x in [p.x, p.y, p.z].into_iter().chain(uv.into_iter().flatten()) {
        out.extend(x.to_le_bytes());
    }
}

fn face(out: &mut Vec<u8>, corners: [u32; 3]) {
    out.push(3);
    for v in corners {
        out.extend(v.to_le_bytes());
    }
}
