//! Imported files: supported features, and errors that name the file, the field and a remedy.

use crate::common;

use std::path::{Path, PathBuf};

use common::data_uri;
use picofarm_scene::{
    Aim, Bsdf, Distribution, Scene, SceneError, Vec3, export,
    import::{Bounds, ImportOptions, read_reference_json, read_scene, read_scene_with},
    primitive::{self, PrimitiveSettings},
};

/// Returns one triangle under a turned, moved node.
fn gltf(buffer_uri: &str, camera_and_laser: &str) -> String {
    format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
        "nodes":[{{"name":"top","translation":[0,0,5],"children":[1],"extras":{{"label":"chair"}}}},
                 {{"name":"leaf","mesh":0,"rotation":[0,0.70710677,0,0.70710677]{camera_and_laser}}}],
        "cameras":[{{"type":"perspective","perspective":{{"yfov":1.5707964,"znear":0.01,"aspectRatio":2.0}}}}],
        "materials":[{{"name":"steel","pbrMetallicRoughness":{{"baseColorFactor":[1,1,1,1],"metallicFactor":1,"roughnessFactor":0.2}}}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"material":0}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}}],
        "bufferViews":[{{"buffer":0,"byteLength":36}}],
        "buffers":[{{"byteLength":36,"uri":"{buffer_uri}"}}]}}"#
    )
}

fn corners(first: f32) -> Vec<u8> {
    [first, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
        .iter()
        .flat_map(|x: &f32| x.to_le_bytes())
        .collect()
}

const CAMERA_AND_LASER: &str = r#","camera":0,"extras":{"laser_spots":4}"#;

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a folder"))
    }

    fn file(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, content).expect("writes");
        path
    }
}

/// Returns the error's text, which must name the file.
fn refusal(path: &Path) -> String {
    let error = read_scene(path).expect_err("must be refused").to_string();
    let name = path
        .file_name()
        .expect("a name")
        .to_string_lossy()
        .into_owned();
    assert!(error.contains(&name), "{error} must name {name}");
    error
}

#[test]
fn a_foreign_gltf_is_understood() {
    let folder = Folder::new();
    let path = folder.file("a.gltf", gltf(&data_uri(&corners(0.0)), CAMERA_AND_LASER));
    let scene = read_scene(&path).expect("reads");
    assert_eq!(
        (scene.objects.len(), scene.labels.as_slice()),
        (1, &["chair".to_owned()][..])
    );
    let p = scene.objects[0].to_world.point(Vec3::new(1.0, 0.0, 0.0));
    assert!((p - Vec3::new(0.0, 0.0, 4.0)).length() < 1e-6, "{p:?}");
    let expected = Bsdf::RoughConductor {
        alpha: 0.2f32 * 0.2,
        distribution: Distribution::Ggx,
        reflectance: 1.0,
    };
    assert_eq!(scene.objects[0].mesh.materials[0].bsdf, expected);
    let i = scene.camera.intrinsics;
    assert_eq!((i.width, i.height), (128, 64));
    assert!(
        (i.fx - 32.0).abs() < 1e-3 && (i.fy - 32.0).abs() < 1e-3,
        "{i:?}"
    );
    assert!((scene.camera.forward - Vec3::new(-1.0, 0.0, 0.0)).length() < 1e-6);
    assert_eq!(scene.laser.beams.len(), 4);
}

#[test]
fn a_missing_camera_or_laser_is_chosen_and_can_be_stated() {
    let folder = Folder::new();
    let uri = data_uri(&corners(0.0));
    let bare = folder.file("bare.gltf", gltf(&uri, ""));
    let scene = read_scene(&bare).expect("a camera is chosen");
    let notes = &scene.provenance.notes;
    assert!(notes.contains_key("chosen.camera") && notes.contains_key("chosen.laser"));
    assert!(!notes.contains_key("chosen.unit"), "glTF is in metres");
    let dark = folder.file("dark.gltf", gltf(&uri, r#","camera":0"#));
    let scene = read_scene(&dark).expect("a laser is chosen");
    assert_eq!(scene.camera.intrinsics.width, 128);
    let options = ImportOptions {
        laser: Aim::grid(4),
        ..ImportOptions::default()
    };
    let scene = read_scene_with(&dark, &options, &Bounds::default()).expect("the grid is stated");
    assert_eq!(scene.laser.beams.len(), 4);
}

#[test]
fn damaged_gltf_files_are_refused_by_field() {
    let folder = Folder::new();
    let missing = folder.file("m.gltf", gltf("lost.bin", CAMERA_AND_LASER));
    let error = read_scene(&missing).expect_err("no buffer").to_string();
    assert!(
        error.contains("lost.bin") && error.contains("cannot read"),
        "{error}"
    );
    folder.file("short.bin", [0u8; 8]);
    let short = folder.file("s.gltf", gltf("short.bin", CAMERA_AND_LASER));
    assert!(refusal(&short).contains("buffers[0]: has 8 of 36 bytes"));
    let nan = folder.file(
        "n.gltf",
        gltf(&data_uri(&corners(f32::NAN)), CAMERA_AND_LASER),
    );
    assert!(refusal(&nan).contains("positions[0]"));
    let knot = gltf(&data_uri(&corners(0.0)), r#","children":[0]"#);
    let knot = folder.file("knot.gltf", knot);
    assert!(refusal(&knot).contains("no node of its scene has a mesh"));
    let scene = primitive::generate(1, &PrimitiveSettings::default()).expect("generates");
    let glb = export::glb_bytes(&scene).expect("valid");
    for keep in [4, 11, 40, glb.len() / 2, glb.len() - 1] {
        let cut = folder.file("cut.glb", &glb[..keep]);
        assert!(!refusal(&cut).is_empty());
    }
    let other = folder.file("what.json", "{\"a\": 1}");
    assert!(refusal(&other).contains("neither `asset`"));
    let absent = folder.0.path().join("absent.glb");
    assert!(matches!(read_scene(&absent), Err(SceneError::Read { .. })));
}

fn reference_json(bsdf: &str, vertex: &str) -> String {
    format!(
        r#"{{"name":"r","camera":{{"fov_x_deg":90,"origin":[0,0,0],"right":[1,0,0],"up":[0,1,0],"forward":[0,0,-1]}},
        "laser":{{"origin":[0,0,0]}},
        "spots":[{{"dir":[0,0,-1],"p":[0,0,-1],"n":[0,0,1],"laser_dist":1,"mesh_index":0}}],
        "meshes":[{{"name":"back","bsdf":{bsdf},"vertices":[{vertex},-1,-1,1,-1,-1,0,1,-1],"faces":[0,1,2]}}]}}"#
    )
}

#[test]
fn reference_scenes_may_have_conductors_and_mixes() {
    let folder = Folder::new();
    let read = |bsdf: &str| {
        let path = folder.file("scene.json", reference_json(bsdf, "-1"));
        let scene = read_scene(&path).expect("reads");
        scene.objects[0].mesh.materials[0].bsdf
    };
    let conductor = r#"{"type":"roughconductor","distribution":"ggx","alpha":0.1,"fresnel":0.8}"#;
    let expected = Bsdf::RoughConductor {
        alpha: 0.1,
        distribution: Distribution::Ggx,
        reflectance: 0.8,
    };
    assert_eq!(read(conductor), expected);
    let mixed = r#"{"type":"mixed","distribution":"beckmann","alpha":0.2,"fresnel":0.9,"reflectance":0.5,"weight":0.25}"#;
    let expected = Bsdf::Mixed {
        reflectance: 0.5,
        alpha: 0.2,
        distribution: Distribution::Beckmann,
        specular_reflectance: 0.9,
        weight: 0.25,
    };
    assert_eq!(read(mixed), expected);
}

#[test]
fn malformed_reference_scenes_are_refused_by_field() {
    let folder = Folder::new();
    let good = r#"{"type":"diffuse","reflectance":0.5}"#;
    let path = folder.file("good.json", reference_json(good, "-1"));
    assert_eq!(read_scene(&path).expect("reads").objects.len(), 1);
    for (name, bsdf, vertex, expected) in [
        (
            "glass.json",
            r#"{"type":"dielectric"}"#,
            "-1",
            "bsdf.type: \"dielectric\" is not known",
        ),
        (
            "phong.json",
            r#"{"type":"roughconductor","distribution":"phong","alpha":0.1}"#,
            "-1",
            "bsdf.distribution: \"phong\"",
        ),
        (
            "weight.json",
            r#"{"type":"mixed","distribution":"ggx","alpha":0.1,"reflectance":0.5}"#,
            "-1",
            "bsdf.weight: missing",
        ),
        (
            "alpha.json",
            r#"{"type":"roughconductor","distribution":"beckmann"}"#,
            "-1",
            "bsdf.alpha: missing",
        ),
        (
            "null.json",
            good,
            "null",
            "vertices[0..]: null is not a number",
        ),
        ("nan.json", good, "NaN", "nan.json"),
        (
            "bright.json",
            r#"{"type":"diffuse","reflectance":1.5}"#,
            "-1",
            "reflectance = 1.5",
        ),
    ] {
        let path = folder.file(name, reference_json(bsdf, vertex));
        let error = refusal(&path);
        assert!(error.contains(expected), "{error}");
    }
}

/// Returns the reference scenes' folder, or `None` with a message if this checkout has none.
fn reference(name: &str) -> Option<PathBuf> {
    let path = Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap())
        .join("../../../shared/reference/transients")
        .join(name);
    if path.exists() {
        return Some(path);
    }
    println!("skipped: {} is not here", path.display());
    None
}

/// Returns the distance of a point from a triangle's plane, and whether it is within the triangle's
/// edges (with a tolerance).
fn on_triangle(p: Vec3, [a, b, c]: [Vec3; 3]) -> bool {
    let n = (b - a).cross(c - a).normalized();
    let inside = [(a, b), (b, c), (c, a)]
        .iter()
        .all(|&(s, e)| (e - s).cross(p - s).dot(n) >= -1e-4);
    n.is_finite() && (p - a).dot(n).abs() < 1e-4 && inside
}

fn spots_lie_on_their_meshes(scene: &Scene) {
    for (i, beam) in scene.laser.beams.iter().enumerate() {
        let spot = beam.spot.expect("reference scenes state their spots");
        let mesh = &scene.objects[spot.object as usize].mesh;
        let corner = |v: u32| mesh.positions[v as usize];
        let on = mesh
            .triangles
            .iter()
            .any(|t| on_triangle(spot.point, t.map(corner)));
        assert!(on, "spot {i} at {:?} is not on {}", spot.point, mesh.name);
        let along = scene.laser.origin + beam.direction * spot.path_m;
        assert!((along - spot.point).length() < 1e-4, "spot {i}");
        assert!(
            spot.normal.dot(spot.arriving) < 0.0,
            "spot {i} is lit from its front"
        );
    }
}

#[test]
fn the_reference_scenes_are_read_with_their_spots() {
    for (name, objects, triangles, spots) in [
        ("room-diffuse-1", 13, 1480, 1),
        ("room-diffuse", 13, 1480, 25),
        ("room-mirror", 14, 1482, 25),
    ] {
        let Some(path) = reference(&format!("{name}.json")) else {
            continue;
        };
        let scene = read_reference_json(&path).expect("reads");
        assert_eq!(scene.name, name);
        assert_eq!(scene.objects.len(), objects);
        assert_eq!(scene.triangle_count(), triangles);
        assert_eq!(scene.laser.beams.len(), spots);
        assert_eq!(scene.camera.forward, Vec3::new(0.0, 0.0, -1.0));
        assert_eq!(scene.camera.down, Vec3::new(0.0, -1.0, 0.0));
        assert_eq!(scene.camera.intrinsics.fx, 32.0);
        assert!(scene.objects.iter().all(|o| !o.mesh.materials[0].two_sided));
        let mirrors = scene
            .objects
            .iter()
            .filter(|o| o.mesh.materials[0].is_specular());
        assert_eq!(mirrors.count(), usize::from(name == "room-mirror"));
        spots_lie_on_their_meshes(&scene);
    }
}
