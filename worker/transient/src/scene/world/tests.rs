//! The lift off a surface: rays that start there do not hit their own plane.

use std::sync::Arc;

use picofarm_scene::{
    Affine, Camera, Intrinsics, Laser, Material, Mesh, Object, Provenance, Scene, Vec3,
};
use proptest::prelude::*;

use super::*;
use crate::{
    api::{Stop, Unstopped},
    numeric::frame::frame,
    scene::intersection::lift,
};

/// Returns a parallelogram around a point, and a far facet that extends the scene to its maximum
/// size in render units.
fn scene(middle: Vec3, normal: Vec3, side: f32) -> Scene {
    let (t, b) = frame(normal);
    let corner = |x: f32, y: f32| middle + t * (x * side) + b * (y * side);
    let positions = vec![
        corner(-0.7, -0.5),
        corner(0.5, -0.6),
        corner(0.8, 0.5),
        corner(-0.4, 0.6),
        Vec3::new(0.0, 0.0, 7.0),
        Vec3::new(0.01, 0.0, 7.0),
        Vec3::new(0.0, 0.01, 7.0),
    ];
    let mesh = Mesh {
        name: "plane".into(),
        triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6]],
        triangle_material: vec![0; 3],
        positions,
        materials: vec![Material::diffuse("grey", [0.5; 3])],
        uv: vec![],
    };
    Scene {
        name: "plane".into(),
        objects: vec![Object {
            mesh: Arc::new(mesh),
            to_world: Affine::IDENTITY,
            label: 0,
            name: "plane".into(),
        }],
        labels: vec!["plane".into()],
        camera: Camera::look_at(Vec3::ZERO, middle, Intrinsics::from_fov(90.0, 8, 8)),
        laser: Laser {
            origin: Vec3::ZERO,
            beams: vec![],
        },
        provenance: Provenance::default(),
    }
}

fn unit() -> impl Strategy<Value = Vec3> {
    // Rooms mostly consist of upright and slightly tilted planes.
    let tilt = prop_oneof![Just(0.0f32), 1e-4f32..0.1, 0.1f32..1.0];
    (0..3usize, any::<bool>(), tilt.clone(), tilt).prop_map(|(axis, flip, a, b)| {
        let mut n = [a, b, a];
        n[axis] = if flip { -1.0 } else { 1.0 };
        n[(axis + 2) % 3] = b;
        Vec3::from(n).normalized()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    #[test]
    fn rays_from_a_lifted_point_never_meet_the_plane_they_start_from(
        normal in unit(),
        at in (-3.0f32..3.0, -3.0f32..3.0, -6.0f32..-0.05),
        side in 0.1f32..10.0,
        turns in prop::collection::vec((0.0f32..std::f32::consts::TAU, 1e-3f32..1.0, -1.0f32..1.0, -1.0f32..1.0), 8),
    ) {
        let s = scene(Vec3::new(at.0, at.1, at.2), normal, side);
        let world = World::new(&s, f64::INFINITY, Stop(&Unstopped)).unwrap();
        let mut stack = world.bvh.stack();
        for (angle, height, x, y) in turns {
            // A ray from the camera to a point of the plane.
            let (t, b) = frame(normal);
            let goal = Vec3::new(at.0, at.1, at.2) + (t * x + b * y) * (0.3 * side);
            let Some(h) = world.closest(&mut stack, Vec3::ZERO, goal.normalized()) else {
                continue;
            };
            prop_assume!(h.n.dot(goal.normalized()) < -1e-3);
            let (t, b) = frame(h.n);
            let flat = t * libm::cosf(angle) + b * libm::sinf(angle);
            let w = (flat * (1.0 - height * height).sqrt() + h.n * height).normalized();
            let met = world.closest(&mut stack, lift(h.p, h.n), w).filter(|m| m.triangle < 2);
            prop_assert!(met.is_none(), "{} units away", met.map_or(0.0, |m| (m.p - h.p).length()));
        }
    }
}
