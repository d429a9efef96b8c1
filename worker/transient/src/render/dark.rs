//! Gates that no light reaches: known from lengths alone, before any ray is traced.

use picofarm_scene::Vec3;

use crate::{api::Gate, emitter::Emitters, world::World};

/// Share of the laser's power below which light is none.
const NONE: f64 = 1e-6;

/// Whether all light comes after a gate's end, or all but a millionth before its start. Every path is at least as long as the
/// straight ways to its spot and from there to the camera, and one of some bounces at most as long as so many times the way across
/// the scene; at each bounce the brightest surface's albedo is left.
pub(super) fn dark(world: &World, emitters: &Emitters, gate: &Gate, max_bounces: u32) -> bool {
    // Glass makes ways longer, and what it reflects may be all of the light.
    if emitters.list.is_empty() || world.has_glass() || world.has_bodies() {
        return false;
    }
    let each = || emitters.list.iter();
    let first = each().map(|e| e.path_m + world.metres(e.p.length()));
    if first.fold(f64::INFINITY, f64::min) >= gate.end_m() * (1.0 + ROUNDING) {
        return true;
    }
    let corners = || world.triangles.iter().flatten().copied();
    let low = corners().fold(Vec3::ZERO, Vec3::min);
    let high = corners().fold(Vec3::ZERO, Vec3::max);
    let across = world.metres((high - low).length()) * (1.0 + ROUNDING);
    let last = each().map(|e| e.path_m).fold(0.0, f64::max);
    let bounces = (gate.start_m - last) / across;
    if bounces.is_nan() || bounces <= 1.0 {
        return false;
    }
    if bounces > f64::from(max_bounces) {
        return true;
    }
    let albedos = world.surfaces.iter().chain(world.several.iter().flatten());
    let most = f64::from(albedos.fold(0.0f32, |a, s| a.max(s.albedo())));
    most < 1.0 && libm::pow(most, bounces.floor()) < NONE * (1.0 - most)
}

/// What lengths in f32 may be off.
const ROUNDING: f64 = 1e-5;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use picofarm_scene::{
        Affine, Beam, Camera, Intrinsics, Laser, Material, Mesh, Object, Provenance, Scene,
    };

    use super::*;
    use crate::{
        api::{Stop, Unstopped},
        beam::find_spots,
    };

    /// A wall 3 m before camera and laser.
    fn wall(reflectance: f32) -> Scene {
        let at = |x: f32, y: f32| Vec3::new(x, y, -3.0);
        let mesh = Mesh {
            name: "wall".into(),
            positions: vec![at(-2.0, -2.0), at(2.0, -2.0), at(2.0, 2.0), at(-2.0, 2.0)],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            triangle_material: vec![0; 2],
            materials: vec![Material::diffuse("grey", [reflectance; 3])],
            uv: vec![],
        };
        let ahead = Vec3::new(0.0, 0.0, -1.0);
        Scene {
            name: "wall".into(),
            objects: vec![Object {
                mesh: Arc::new(mesh),
                to_world: Affine::IDENTITY,
                label: 0,
                name: "wall".into(),
            }],
            labels: vec!["wall".into()],
            camera: Camera::look_at(Vec3::ZERO, ahead, Intrinsics::from_fov(90.0, 8, 8)),
            laser: Laser {
                origin: Vec3::ZERO,
                beams: vec![Beam {
                    direction: ahead,
                    spot: None,
                }],
            },
            provenance: Provenance::default(),
        }
    }

    #[test]
    fn a_gate_is_dark_where_its_light_comes_later_or_has_faded() {
        let is_dark = |reflectance: f32, start_m: f64, most: u32| {
            let gate = Gate {
                start_m,
                bin_width_m: 0.5,
                bins: 4,
            };
            let scene = wall(reflectance);
            let world = World::new(&scene, f64::INFINITY, Stop(&Unstopped)).unwrap();
            let spots = find_spots(&world, &scene.laser.beams);
            let emitters = Emitters::new(&scene, &world, &spots).unwrap();
            dark(&world, &emitters, &gate, most)
        };
        // The spot's own light comes after 6 m; the box around wall and camera is 6.4 m across.
        assert!(is_dark(0.5, 3.9, u32::MAX));
        assert!(!is_dark(0.5, 4.1, u32::MAX));
        assert!(!is_dark(0.5, 100.0, u32::MAX));
        assert!(is_dark(0.5, 160.0, u32::MAX), "24 bounces leave 6e-8");
        assert!(!is_dark(0.9, 160.0, u32::MAX), "and 8 % of 0.9 each");
        assert!(is_dark(0.9, 160.0, 20));
        assert!(!is_dark(1.0, 1e5, u32::MAX));
    }
}
