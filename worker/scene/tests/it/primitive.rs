//! Primitive rooms: reproducible, complete, and usable by the renderer.

use picofarm_scene::{
    Scene, SceneError, Vec3, export,
    primitive::{self, PrimitiveSettings},
};
use picofarm_settings::{MirrorWall, PrimitiveRooms, Spots};

fn small() -> PrimitiveSettings {
    PrimitiveSettings {
        width: 64,
        height: 64,
        ..PrimitiveSettings::default()
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_does_not() {
    let bytes = |seed| {
        let scene = primitive::generate(seed, &small()).expect("ordinary seeds succeed");
        export::glb_bytes(&scene).expect("generated scenes are valid")
    };
    assert_eq!(bytes(11), bytes(11));
    assert_ne!(bytes(11), bytes(12));
}

#[test]
fn forty_seeds_give_a_cube_a_cylinder_and_a_mirror() {
    for seed in 0..40 {
        let scene = primitive::generate(seed, &small()).expect("ordinary seeds succeed");
        scene.validate().expect("generated scenes are valid");
        let labels: Vec<&str> = scene
            .objects
            .iter()
            .map(|o| scene.labels[usize::from(o.label)].as_str())
            .collect();
        assert_eq!(labels[6..], ["cube", "cylinder", "mirror"], "seed {seed}");
        assert_eq!(scene.laser.beams.len(), 25);
    }
}

#[test]
fn settings_out_of_range_are_refused_by_name() {
    for (settings, field) in [
        (
            PrimitiveSettings {
                spots: Spots::Grid(9),
                ..small()
            },
            "spots",
        ),
        (
            PrimitiveSettings {
                rooms: PrimitiveRooms {
                    depth_m: [2.0, 1.0],
                    ..PrimitiveRooms::LIVING
                },
                ..small()
            },
            "rooms.depth_m",
        ),
        (
            PrimitiveSettings {
                width: 0,
                ..small()
            },
            "width and height",
        ),
        (
            PrimitiveSettings {
                fov_deg: 179.0,
                ..small()
            },
            "fov_deg",
        ),
    ] {
        match primitive::generate(0, &settings) {
            Err(SceneError::Invalid { field: f, .. }) => assert_eq!(f, field),
            other => panic!("expected a refusal of {field}, got {other:?}"),
        }
    }
}

fn desktop() -> PrimitiveSettings {
    PrimitiveSettings {
        width: 64,
        height: 64,
        ..PrimitiveSettings::desktop()
    }
}

fn named<'a>(scene: &'a Scene, label: &str) -> &'a picofarm_scene::Object {
    let is = |o: &&picofarm_scene::Object| scene.labels[usize::from(o.label)] == label;
    scene.objects.iter().find(is).expect("it is there")
}

/// Returns the extent of an object's mesh along its own axes.
fn extent(scene: &Scene, label: &str) -> Vec3 {
    let (lo, hi) = named(scene, label).mesh.bounds().expect("triangles");
    hi - lo
}

#[test]
fn a_box_on_a_desk_has_the_laboratorys_sizes_and_its_mirror_on_the_back_wall() {
    for seed in 0..40 {
        let scene = primitive::generate(seed, &desktop()).expect("ordinary seeds succeed");
        scene.validate().expect("generated scenes are valid");
        assert_eq!(scene.laser.beams.len(), 16);
        let cylinder = extent(&scene, "cylinder");
        assert!((cylinder.x - 0.0254).abs() < 1e-5, "one inch: {cylinder:?}");
        let cube = extent(&scene, "cube");
        assert!((0.06..=0.16).contains(&cube.x) && (0.06..=0.2).contains(&cube.y));
        // The camera looks towards -z, so the back wall has the least z.
        let back = scene.objects[..6].iter().filter_map(|o| o.mesh.bounds());
        let back = back.map(|(lo, _)| lo.z).fold(f32::INFINITY, f32::min);
        let mirror = named(&scene, "mirror").to_world.translation.z;
        assert!(mirror - back < 0.02, "seed {seed}: {mirror} and {back}");
        assert!(scene.camera.forward.z < 0.0);
        let depth = &scene.provenance.notes["depth_m"];
        let (near, far) = depth.split_once("..").expect("a range");
        assert!(near.parse::<f32>().unwrap() >= 0.3 && far.parse::<f32>().unwrap() <= 1.4);
        let fov: f32 = scene.provenance.notes["fov_deg"].parse().unwrap();
        assert!((43.0..=49.0).contains(&fov));
    }
}

#[test]
fn random_spots_differ_from_room_to_room_and_change_nothing_else() {
    let random = PrimitiveSettings {
        spots: Spots::Random(16),
        ..desktop()
    };
    let mut same = 0;
    for seed in 0..20 {
        let scene = primitive::generate(seed, &random).expect("ordinary seeds succeed");
        let grid = primitive::generate(seed, &desktop()).expect("ordinary seeds succeed");
        assert_eq!(scene.laser.beams.len(), 16);
        assert_ne!(scene.laser, grid.laser);
        // Another camera is used only if a beam of one of them is lost among mirrors.
        same += usize::from(scene.camera == grid.camera);
    }
    assert!(same >= 18, "{same} of 20 cameras are the same");
}

#[test]
fn a_laser_beside_the_camera_lights_the_points_that_the_camera_sees_there() {
    let beside = PrimitiveSettings {
        laser_m: [0.05, -0.03, 0.01],
        rooms: PrimitiveRooms {
            mirror_wall: MirrorWall::None,
            ..PrimitiveRooms::DESKTOP
        },
        ..desktop()
    };
    let at_camera = PrimitiveSettings {
        laser_m: [0.0; 3],
        ..beside.clone()
    };
    for seed in 0..10 {
        let scene = primitive::generate(seed, &beside).expect("ordinary seeds succeed");
        let other = primitive::generate(seed, &at_camera).expect("ordinary seeds succeed");
        assert_eq!(scene.camera, other.camera, "seed {seed}");
        let camera = &scene.camera;
        let away = camera.right * 0.05 + camera.down * -0.03 + camera.forward * 0.01;
        assert!((scene.laser.origin - (camera.origin + away)).length() < 1e-6);
        // Both beams of a spot are in a plane with the base line, and intersect in front of the
        // farthest wall.
        for (a, b) in scene.laser.beams.iter().zip(&other.laser.beams) {
            let normal = away.cross(b.direction);
            assert!(a.direction.dot(normal).abs() < 1e-6);
            let apart = a.direction.cross(b.direction).length();
            let distance = normal.length() / apart;
            assert!((0.25..1.7).contains(&distance), "seed {seed}: {distance} m");
        }
    }
}
