//! Files without camera, laser or unit open as they are, and say what was chosen for them.

use std::path::PathBuf;

use picofarm_scene::{
    Aim, Camera, Scene, SceneError, Vec3, export,
    import::{Bounds, ImportOptions, Unit, View, read_scene_with},
    primitive::{self, PrimitiveSettings},
};
use serde_json::json;

/// A closed box with outward (`+1`) or inward (`-1`) facets, as PLY.
fn cuboid(lo: [f64; 3], hi: [f64; 3], inward: bool) -> String {
    let mut text = String::from(
        "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n\
         element face 6\nproperty list uchar int vertex_indices\nend_header\n",
    );
    for k in 0..8 {
        let side = |axis: usize| {
            if k >> axis & 1 == 1 {
                hi[axis]
            } else {
                lo[axis]
            }
        };
        text += &format!("{} {} {}\n", side(0), side(1), side(2));
    }
    for face in [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ] {
        let [a, b, c, d] = face;
        text += &match inward {
            false => format!("4 {a} {b} {c} {d}\n"),
            true => format!("4 {d} {c} {b} {a}\n"),
        };
    }
    text
}

fn read(name: &str, bytes: &[u8], options: &ImportOptions) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().expect("a folder");
    let path: PathBuf = folder.path().join(name);
    std::fs::write(&path, bytes).expect("writes");
    read_scene_with(&path, options, &Bounds::default())
}

/// Returns whether a point is inside the image.
fn sees(camera: &Camera, p: Vec3) -> bool {
    let (c, i) = (camera.to_camera(p), camera.intrinsics);
    let (x, y) = (c.x / c.z * i.fx + i.cx, c.y / c.z * i.fy + i.cy);
    c.z > 0.0 && (0.0..i.width as f32).contains(&x) && (0.0..i.height as f32).contains(&y)
}

fn corners(scene: &Scene) -> Vec<Vec3> {
    let object = &scene.objects[0];
    let points = object.mesh.positions.iter();
    points.map(|p| object.to_world.point(*p)).collect()
}

#[test]
fn an_object_is_seen_whole_from_outside() {
    for (lo, hi) in [
        ([0.0; 3], [1.0; 3]),
        ([-3.0, 0.0, -0.01], [3.0, 0.2, 0.01]),
        ([100.0, 0.0, 50.0], [100.1, 2.0, 50.1]),
    ] {
        let text = cuboid(lo, hi, false);
        let scene = read("a.ply", text.as_bytes(), &ImportOptions::default()).expect("reads");
        assert!(scene.path_range_m().is_some(), "spots hit the object");
        for p in corners(&scene) {
            assert!(sees(&scene.camera, p), "{lo:?} {hi:?} {p:?}");
        }
        let notes = &scene.provenance.notes;
        assert!(notes["chosen.camera"].contains("in front"), "{notes:?}");
        assert!(notes["chosen.camera"].contains("--look-from"));
        assert!(notes["chosen.laser"].contains("--spots"));
        assert!(notes["chosen.unit"].contains("--unit"));
        assert_eq!(scene.laser.beams.len(), 25);
    }
}

#[test]
fn an_empty_room_is_seen_from_inside() {
    let (lo, hi) = ([-2.0, 0.0, -3.0], [2.0, 2.5, 3.0]);
    let text = cuboid(lo, hi, true);
    let scene = read("a.ply", text.as_bytes(), &ImportOptions::default()).expect("reads");
    let origin: [f32; 3] = scene.camera.origin.into();
    for k in 0..3 {
        assert!(
            f64::from(origin[k]) > lo[k] && f64::from(origin[k]) < hi[k],
            "{origin:?}"
        );
    }
    // Along the room, not across it.
    assert!(
        scene.camera.forward.z.abs() > 0.7,
        "{:?}",
        scene.camera.forward
    );
    assert!(scene.provenance.notes["chosen.camera"].contains("indoors"));
}

#[test]
fn a_small_hollow_thing_is_seen_from_outside() {
    let text = cuboid([0.0; 3], [0.4, 0.5, 0.3], true);
    let scene = read("a.ply", text.as_bytes(), &ImportOptions::default()).expect("reads");
    let note = &scene.provenance.notes["chosen.camera"];
    assert!(note.contains("in front"), "{note}");
}

#[test]
fn a_generated_room_without_its_camera_is_seen_from_inside() {
    for seed in 0..6 {
        let room = primitive::generate(seed, &PrimitiveSettings::default()).expect("a room");
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("room.ply");
        export::write_ply(&room, &path).expect("writes");
        let read = |options| read_scene_with(&path, &options, &Bounds::default()).expect("reads");
        let scene = read(ImportOptions::default());
        let note = &scene.provenance.notes["chosen.camera"];
        assert!(note.contains("indoors"), "seed {seed}: {note}");
    }
}

#[test]
fn stray_triangles_do_not_move_the_camera_away() {
    let mut text = cuboid([0.0; 3], [1.0; 3], false);
    text = text.replace("element vertex 8", "element vertex 11");
    text = text.replace("element face 6", "element face 7");
    let at = text.find("4 0 2 3 1").expect("the first face");
    text.insert_str(at, "40 0 0\n40.001 0 0\n40 0.001 0\n");
    text += "3 8 9 10\n";
    let scene = read("a.ply", text.as_bytes(), &ImportOptions::default()).expect("reads");
    let distance = (scene.camera.origin - Vec3::splat(0.5)).length();
    assert!(distance < 4.0, "{distance}");
}

#[test]
fn a_stated_view_unit_and_laser_are_used_and_not_noted() {
    let text = cuboid([0.0; 3], [1000.0; 3], false);
    let options = ImportOptions {
        view: View {
            from: Some(Vec3::new(0.5, 3.0, 4.0)),
            at: Some(Vec3::new(0.5, 0.5, 0.5)),
            fov_deg: Some(90.0),
            ..View::default()
        },
        laser: Aim::grid(4),
        unit: Some(Unit::Millimetre),
        ..ImportOptions::default()
    };
    let scene = read("a.ply", text.as_bytes(), &options).expect("reads");
    assert_eq!(scene.camera.origin, Vec3::new(0.5, 3.0, 4.0));
    assert_eq!(scene.camera.intrinsics.fx, 128.0);
    let ahead = scene.camera.to_camera(Vec3::splat(0.5));
    assert!(ahead.x.abs() < 1e-5 && ahead.y.abs() < 1e-5 && ahead.z > 0.0);
    assert_eq!(scene.laser.beams.len(), 4);
    assert!(corners(&scene).iter().all(|p| p.x < 1.001));
    let chosen = |k: &&String| k.starts_with("chosen.");
    let notes = &scene.provenance.notes;
    assert_eq!(notes.keys().filter(chosen).count(), 0, "{notes:?}");
}

#[test]
fn the_unstated_half_of_a_view_is_noted() {
    let text = cuboid([0.0; 3], [1.0; 3], false);
    let point = Some(Vec3::new(3.0, 2.0, 4.0));
    let from = View {
        from: point,
        ..View::default()
    };
    let at = View {
        at: point,
        ..View::default()
    };
    for (view, option) in [(from, "--look-at"), (at, "--look-from")] {
        let options = ImportOptions {
            view,
            ..ImportOptions::default()
        };
        let scene = read("a.ply", text.as_bytes(), &options).expect("reads");
        let note = &scene.provenance.notes["chosen.camera"];
        assert!(note.contains(&format!("{option} changes it")), "{note}");
    }
}

#[test]
fn the_first_of_several_cameras_is_noted() {
    let camera = |x: f64| json!({"type": "perspective", "fov": 60, "to_world": [[1,0,0,x],[0,1,0,0],[0,0,1,-4],[0,0,0,1]]});
    let file = json!({
        "type": "scene", "left": camera(-0.1), "right": camera(0.1), "shape": {"type": "cube"},
    });
    let bytes = file.to_string().into_bytes();
    let scene = read("a.json", &bytes, &ImportOptions::default()).expect("reads");
    let note = &scene.provenance.notes["chosen.camera"];
    assert!(note.starts_with("the first of 2, \"left\""), "{note}");
    let options = ImportOptions {
        view: View {
            camera: Some("right".into()),
            ..View::default()
        },
        ..ImportOptions::default()
    };
    let scene = read("a.json", &bytes, &options).expect("reads");
    assert!(!scene.provenance.notes.contains_key("chosen.camera"));
}

#[test]
fn a_large_mesh_without_a_unit_is_in_millimetres() {
    let text = cuboid([0.0; 3], [800.0, 1200.0, 400.0], false);
    let scene = read("a.ply", text.as_bytes(), &ImportOptions::default()).expect("reads");
    assert!(corners(&scene).iter().all(|p| p.y < 1.21));
    assert!(scene.provenance.notes["chosen.unit"].starts_with("mm"));
}

#[test]
fn faults_of_a_view_name_the_option() {
    let text = cuboid([0.0; 3], [1.0; 3], false);
    let view = |view: View| ImportOptions {
        view,
        ..ImportOptions::default()
    };
    let point = Some(Vec3::splat(3.0));
    for (options, expected) in [
        (
            view(View {
                from: point,
                at: point,
                ..View::default()
            }),
            "look-from and look-at: are the same point",
        ),
        (
            view(View {
                up: Some(Vec3::ZERO),
                ..View::default()
            }),
            "up: expected a direction",
        ),
        (
            view(View {
                camera: Some("left".into()),
                ..View::default()
            }),
            "the file has no such camera; it has none",
        ),
    ] {
        let error = read("a.ply", text.as_bytes(), &options)
            .expect_err(expected)
            .to_string();
        assert!(
            error.contains("a.ply") && error.contains(expected),
            "{error}"
        );
    }
}

#[test]
fn light_arrives_between_the_nearest_and_the_farthest_surface() {
    let (lo, hi) = ([-2.0, 0.0, -3.0], [2.0, 2.5, 3.0]);
    let text = cuboid(lo, hi, true);
    let scene = read("a.ply", text.as_bytes(), &ImportOptions::default()).expect("reads");
    let [first, last] = scene.path_range_m().expect("light returns");
    let diagonal = (16.0f64 + 6.25 + 36.0).sqrt();
    assert!(first > 0.1 && last < 3.0 * diagonal, "{first} {last}");
    assert!(last > 2.0 * 4.0, "{first} {last}");
    // Three times the size, three times the paths.
    let text = cuboid(lo.map(|x| 3.0 * x), hi.map(|x| 3.0 * x), true);
    let large = read("a.ply", text.as_bytes(), &ImportOptions::default()).expect("reads");
    let [a, b] = large.path_range_m().expect("light returns");
    assert!((a / first - 3.0).abs() < 1e-3 && (b / last - 3.0).abs() < 1e-3);
}

#[test]
fn chosen_spots_hit_what_the_camera_sees_and_do_not_meet() {
    let text = cuboid([0.0; 3], [0.2, 2.0, 0.2], false);
    let scene = read("a.ply", text.as_bytes(), &ImportOptions::default()).expect("reads");
    let note = &scene.provenance.notes["chosen.laser"];
    assert!(note.contains("spread"), "{note}");
    let beams = &scene.laser.beams;
    assert_eq!(beams.len(), 25);
    for (k, a) in beams.iter().enumerate() {
        // A beam meets the slim box if its closest approach to the axis is within the box.
        let (o, d) = (scene.laser.origin, a.direction);
        let along = |t: f32| o + d * t;
        let inside = (0..4000).map(|n| along(n as f32 * 0.002)).any(|p| {
            (0.0..=0.2).contains(&p.x) && (0.0..=2.0).contains(&p.y) && (0.0..=0.2).contains(&p.z)
        });
        assert!(inside, "beam {k}");
        for b in &beams[k + 1..] {
            assert!((a.direction - b.direction).length() > 1e-3);
        }
    }
}

#[test]
fn chosen_spots_do_not_aim_at_glass() {
    let pane = |x: f64, bsdf: &str| {
        json!({"type": "rectangle", "to_world": [[1,0,0,x],[0,1,0,0],[0,0,1,0],[0,0,0,1]],
            "bsdf": {"type": bsdf}})
    };
    let file = json!({
        "type": "scene", "glass": pane(-1.1, "thindielectric"), "wall": pane(1.1, "diffuse"),
        "camera": {"type": "perspective", "fov": 60,
            "to_world": [[-1,0,0,0],[0,1,0,0],[0,0,-1,5],[0,0,0,1]]},
    });
    let bytes = file.to_string().into_bytes();
    let scene = read("a.json", &bytes, &ImportOptions::default()).expect("reads");
    for beam in &scene.laser.beams {
        let x = scene.laser.origin.x + beam.direction.x * 5.0 / -beam.direction.z;
        assert!(x > 0.0, "{:?}", beam.direction);
    }
}
