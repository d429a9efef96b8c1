//! Helpers for several tests of files.

pub mod gltf;

use picofarm_scene::{
    Bsdf, Distribution, Scene, SpectrumPoint, Texture, Wrap,
    primitive::{self, PrimitiveSettings},
};
use std::sync::Arc;

/// Returns a base64 data URI.
pub fn data_uri(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::from("data:application/octet-stream;base64,");
    for chunk in bytes.chunks(3) {
        let mut three = [0; 3];
        three[..chunk.len()].copy_from_slice(chunk);
        let word = u32::from_be_bytes([0, three[0], three[1], three[2]]);
        for k in 0..4 {
            let digit = DIGITS[(word >> (18 - 6 * k)) as usize & 63];
            out.push(if k > chunk.len() { '=' } else { digit as char });
        }
    }
    out
}

/// Returns a small room in which the first three objects have a texture, a mix and both.
pub fn textured_room() -> Scene {
    let settings = PrimitiveSettings {
        width: 96,
        height: 64,
        ..PrimitiveSettings::default()
    };
    let mut scene = primitive::generate(3, &settings).expect("ordinary seeds succeed");
    let texel = |k: u8| [k, 255 - k, k / 2];
    let texture = |name: &str, wrap| {
        let texels = (0..24).map(|k| texel(k * 10)).collect();
        Arc::new(Texture::new(name, 6, 4, texels, wrap).expect("24 texels"))
    };
    let shared = texture("checks", Wrap::Repeat);
    for (k, object) in scene.objects.iter_mut().take(3).enumerate() {
        let mesh = Arc::make_mut(&mut object.mesh);
        let place = |p: &picofarm_scene::Vec3| [p.x * 0.7 + p.z, p.y * 0.3 - p.z];
        mesh.uv = mesh.positions.iter().map(place).collect();
        let material = &mut mesh.materials[0];
        if k != 1 {
            material.texture = Some(shared.clone());
        }
        if k == 2 {
            material.texture = Some(texture("border", Wrap::Clamp));
        }
        if k > 0 {
            material.bsdf = Bsdf::Mixed {
                reflectance: 0.4,
                alpha: 0.2,
                distribution: [Distribution::Beckmann, Distribution::Ggx][k - 1],
                specular_reflectance: 0.9,
                weight: 0.25,
            };
        }
    }
    scene
}

/// Returns [`textured_room`] with a spectrum for every material; those of mixes are of both parts.
pub fn spectral_room() -> Scene {
    let mut scene = textured_room();
    for (k, object) in scene.objects.iter_mut().enumerate() {
        let mesh = Arc::make_mut(&mut object.mesh);
        for material in &mut mesh.materials {
            let mix = matches!(material.bsdf, Bsdf::Mixed { .. });
            let row = |n: usize| SpectrumPoint {
                nm: 450.1 + 151.7 * n as f32,
                reflectance: 1.0 / (k + n + 2) as f32,
                specular_reflectance: (mix && n != 1).then_some(1.0 / (n + 3) as f32),
            };
            material.spectrum = (0..4).map(row).collect();
        }
    }
    scene
}
