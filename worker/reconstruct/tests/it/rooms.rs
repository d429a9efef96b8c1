//! Whole reconstructions of small measuring rooms.

use crate::common;

use common::{measured, room, small};
use picofarm_reconstruct::{
    Evidence, Settings, Shadows, Unwatched, World, reconstruct,
    render::Renderer,
    score::{floaters, mesh_score, score_views},
    surface,
};
use picofarm_scene::{
    import::read_scene,
    plato::{self, PlatoObject},
};

#[test]
fn visible_depth_is_found_to_a_centimetre() {
    let (scene, rendered) = room(PlatoObject::Chair, 16, 192);
    let settings = Settings {
        nodes: 160,
        ..small()
    };
    let made = reconstruct(measured(&scene, &rendered), settings, &Unwatched).unwrap();
    let truth = &rendered.truth.range;
    let errors = made
        .depth
        .range
        .iter()
        .zip(truth)
        .filter(|(r, _)| r.is_finite());
    let errors: Vec<f32> = errors.map(|(r, t)| (r - t).abs()).collect();
    assert!(
        errors.len() * 100 > truth.len() * 98,
        "{} have a depth",
        errors.len()
    );
    let mean = errors.iter().sum::<f32>() / errors.len() as f32;
    assert!(mean < 0.01, "closed form: {mean} m");
    // The same depths through the field, with voxels of 2.7 cm.
    let view = Renderer::new(&made.field).view(&scene.camera);
    let mut errors: Vec<f32> = view
        .iter()
        .zip(truth)
        .map(|(d, t)| (d.unwrap_or(9.0) - t).abs())
        .collect();
    errors.sort_by(f32::total_cmp);
    assert!(
        errors[errors.len() / 2] < 0.01,
        "field: {} m",
        errors[errors.len() / 2]
    );
    assert_eq!(made.planes.len(), 5, "{:?}", made.planes);
}

#[test]
fn a_hidden_box_is_found_by_its_shadows_and_not_without_them() {
    let (scene, rendered) = room(PlatoObject::HiddenBox, 16, 128);
    let world = World::new(&scene);
    let views: Vec<_> = plato::views(32).into_iter().skip(45).step_by(9).collect();
    let score = |shadows| {
        let settings = Settings {
            nodes: 96,
            shadows,
            iterations: 60,
            batch: 8192,
            ..small()
        };
        let made = reconstruct(measured(&scene, &rendered), settings, &Unwatched).unwrap();
        let score = score_views(&Renderer::new(&made.field), &scene.camera, &world, &views);
        score.occluded_objects.l1_m
    };
    let (with, carved, without) = (
        score(Shadows::Optimise),
        score(Shadows::Carve),
        score(Shadows::Ignore),
    );
    assert!(
        with < 0.2 && without > 0.5,
        "{with} m with shadows, {without} m without"
    );
    assert!(carved < 0.5 * without, "{carved} m carved");
}

#[test]
fn the_mesh_lies_on_the_true_surfaces_and_little_floats() {
    let (scene, rendered) = room(PlatoObject::Chair, 16, 128);
    let world = World::new(&scene);
    let settings = Settings {
        nodes: 96,
        ..small()
    };
    let made = reconstruct(measured(&scene, &rendered), settings, &Unwatched).unwrap();
    let mesh = surface(&made.field);
    let score = mesh_score(&mesh, &world, &made.field, 1).unwrap();
    assert!(score.chamfer_m < 0.04 && score.f_score > 0.85, "{score:?}");
    let floats = floaters(&made.field, &world, 1).unwrap();
    assert!(floats.volume_m3 < 0.1, "{floats:?}");
    // Facets face empty space: the room's inner faces enclose its air with their backs outwards.
    let volume: f64 = mesh
        .triangles
        .iter()
        .map(|t| t.map(|v| mesh.positions[v as usize]))
        .map(|[a, b, c]| f64::from(a.dot(b.cross(c))) / 6.0)
        .sum();
    assert!(volume < 0.0, "signed volume {volume}");
    let ply = mesh.ply();
    assert!(ply.starts_with(b"ply\nformat binary_little_endian 1.0\n"));
    // The importer of scenes reads the other format exactly, with the camera and the beams of the
    // measurement.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mesh.glb");
    std::fs::write(&path, mesh.glb(&made.measured).unwrap()).unwrap();
    let back = read_scene(&path).unwrap();
    back.validate().unwrap();
    let [object] = &back.objects[..] else {
        panic!("{} objects", back.objects.len());
    };
    assert_eq!(object.mesh.positions, mesh.positions);
    assert_eq!(object.mesh.triangles, mesh.triangles);
    assert!(object.mesh.materials[0].two_sided);
    assert_eq!(back.camera, made.measured.camera);
    assert_eq!(back.laser.beams.len(), 16);
    let nothing = picofarm_reconstruct::Surface::default();
    std::fs::write(&path, nothing.glb(&made.measured).unwrap()).unwrap();
    let refusal = read_scene(&path).unwrap_err().to_string();
    assert!(refusal.contains("has no meshes"), "{refusal}");
    assert!(
        made.evidence.contains(&Evidence::None),
        "some nodes are guesses, and said to be"
    );
    assert!(made.evidence.contains(&Evidence::Paths));
}

#[test]
fn without_planes_what_the_camera_does_not_face_stays_open() {
    let (scene, rendered) = room(PlatoObject::Empty, 8, 64);
    let settings = Settings {
        planes: false,
        ..small()
    };
    let made = reconstruct(measured(&scene, &rendered), settings, &Unwatched).unwrap();
    assert!(made.planes.is_empty());
    let renderer = Renderer::new(&made.field);
    let side = picofarm_scene::Vec3::new(1.0, 0.0, 0.05).normalized();
    assert_eq!(renderer.depth(scene.camera.origin, side), None);
}
