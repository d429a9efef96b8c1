//! Converts a scene to the reference scenes' JSON (`picofarm_scene::read_reference_json`), which
//! `tests/lab/peers` renders with other renderers.

use picofarm_scene::{Bsdf, Distribution, Material, Mesh, Scene, Vec3};
use picofarm_transient::Rendered;
use serde_json::{Value, json};

/// Returns the scene in that format; `rendered` provides the ends of its beams. Every material is
/// one-sided.
///
/// # Errors
/// A description of the material that the format cannot represent.
pub fn json(name: &str, scene: &Scene, rendered: &Rendered) -> Result<Value, String> {
    let c = &scene.camera;
    let [origin, right, up, forward] = [c.origin, c.right, -c.down, c.forward].map(array);
    let i = &c.intrinsics;
    let fov = 2.0 * (0.5 * i.width as f32 / i.fx).atan().to_degrees();
    let meshes: Result<Vec<Value>, String> = scene
        .objects
        .iter()
        .map(|o| {
            let points = o.mesh.positions.iter().map(|&p| o.to_world.point(p));
            let vertices: Vec<f32> = points.flat_map(|p| [p.x, p.y, p.z]).collect();
            Ok(json!({
                "name": o.name, "bsdf": material(&o.mesh)?, "vertices": vertices,
                "faces": o.mesh.triangles.concat(),
            }))
        })
        .collect();
    let spots = rendered.spots.iter().flatten();
    let spots: Result<Vec<Value>, String> = spots
        .map(|s| {
            let of = &scene.objects[s.object as usize];
            let cos_i = s.normal.dot(s.arriving).abs();
            Ok(json!({
                "dir": array(s.arriving), "p": array(s.point), "n": array(s.normal), "laser_dist": s.path_m, "cos_i": cos_i,
                "mesh_index": s.object, "bsdf": material(&of.mesh)?,
            }))
        })
        .collect();
    let gate = &rendered.gate;
    Ok(json!({
        "name": name,
        "camera": {"fov_x_deg": fov, "origin": origin, "right": right, "up": up, "forward": forward},
        "laser": {"origin": array(scene.laser.origin)},
        "histogram": {"start_opl": gate.start_m, "bin_width_opl": gate.bin_width_m, "bins": gate.bins},
        "spots": spots?,
        "meshes": meshes?,
    }))
}

fn array(v: Vec3) -> [f32; 3] {
    [v.x, v.y, v.z]
}

/// Returns the material of a mesh, which must have exactly one.
fn material(mesh: &Mesh) -> Result<Value, String> {
    match &mesh.materials[..] {
        [
            Material {
                bsdf,
                texture: None,
                ..
            },
        ] => self::bsdf(bsdf),
        _ => Err(format!(
            "{}: several materials or a texture, which the format has not",
            mesh.name
        )),
    }
}

fn bsdf(of: &Bsdf) -> Result<Value, String> {
    let named = |d: &Distribution| match d {
        Distribution::Beckmann => "beckmann",
        Distribution::Ggx => "ggx",
    };
    Ok(match of {
        Bsdf::Diffuse { reflectance } => json!({"type": "diffuse", "reflectance": reflectance}),
        Bsdf::RoughConductor {
            alpha,
            distribution,
            reflectance,
        } => json!({
            "type": "roughconductor", "distribution": named(distribution), "alpha": alpha, "fresnel": reflectance,
        }),
        Bsdf::Mixed {
            reflectance,
            alpha,
            distribution,
            specular_reflectance,
            weight,
        } => json!({
            "type": "mixed", "reflectance": reflectance, "distribution": named(distribution), "alpha": alpha,
            "fresnel": specular_reflectance, "weight": weight,
        }),
        other => return Err(format!("{}: not a material of the format", other.name())),
    })
}
