//! Mitsuba scenes: ours are restored, and others are read or refused by element.

use crate::common;

use std::path::{Path, PathBuf};

use picofarm_scene::{
    Aim, Bsdf, Distribution, Scene, SceneError, Vec3, export,
    import::{self, Bounds, ImportOptions, read_scene, read_scene_with},
};

/// Object, corners, texture coordinates and material.
type Facet = (usize, [Vec3; 3], Vec<[f32; 2]>, String);

/// Returns the corners of all triangles in world space with their materials' names, in order.
fn soup(scene: &Scene) -> Vec<Facet> {
    let mut all = Vec::new();
    for (k, o) in scene.objects.iter().enumerate() {
        let mut mesh = picofarm_scene::Mesh::clone(&o.mesh);
        let mut order: Vec<usize> = (0..mesh.triangles.len()).collect();
        order.sort_by_key(|&t| mesh.triangle_material[t]);
        mesh.triangles = order.iter().map(|&t| mesh.triangles[t]).collect();
        mesh.triangle_material.sort_unstable();
        for (t, m) in mesh.triangles.iter().zip(&mesh.triangle_material) {
            let corners = t.map(|v| o.to_world.point(mesh.positions[v as usize]));
            let uv = t.iter().filter_map(|v| mesh.uv.get(*v as usize)).copied();
            let material = format!("{:?}", mesh.materials[*m as usize]);
            all.push((k, corners, uv.collect(), material));
        }
    }
    all
}

#[test]
fn an_exported_scene_comes_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    let mut scene = common::textured_room();
    scene
        .provenance
        .notes
        .insert("a---b".into(), "--> <x/> \u{ffff} \u{1f600} ü\n".into());
    let notes = export::write_mitsuba(&scene, &path).expect("writes");
    assert_eq!(notes, Vec::<String>::new());
    let back = read_scene(&path).expect("reads");
    assert_eq!(back.name, scene.name);
    assert_eq!(back.labels, scene.labels);
    assert_eq!(back.camera, scene.camera);
    assert_eq!(back.laser, scene.laser);
    assert_eq!(back.provenance, scene.provenance);
    for (a, b) in back.objects.iter().zip(&scene.objects) {
        assert_eq!(
            (a.label, &a.name, a.to_world),
            (b.label, &b.name, b.to_world)
        );
        assert_eq!(a.mesh.name, b.mesh.name);
    }
    assert_eq!(soup(&back), soup(&scene));

    // Edited elements are read as they are.
    let text = std::fs::read_to_string(&path).expect("the file");
    let edited = text.replace(
        "name=\"weight\" value=\"0.25\"",
        "name=\"weight\" value=\"0.5\"",
    );
    assert_ne!(text, edited);
    std::fs::write(&path, edited).expect("writes");
    let error = read_scene(&path).expect_err("two textures").to_string();
    assert!(
        error.contains("scene.xml: line") && error.contains("same bitmap"),
        "{error}"
    );
}

#[test]
fn without_our_comment_an_exported_scene_is_still_the_same() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    let settings = picofarm_scene::primitive::PrimitiveSettings::default();
    let scene = picofarm_scene::primitive::generate(5, &settings).expect("generates");
    export::write_mitsuba(&scene, &path).expect("writes");
    let text = std::fs::read_to_string(&path).expect("the file");
    let plain: Vec<&str> = text.lines().filter(|l| !l.starts_with("<!--")).collect();
    std::fs::write(&path, plain.join("\n")).expect("writes");
    let back = read_scene(&path).expect("reads");
    let (a, b) = (back.camera, scene.camera);
    assert!((a.intrinsics.fx - b.intrinsics.fx).abs() < 1e-3);
    assert_eq!(
        (a.origin, a.intrinsics.width),
        (b.origin, b.intrinsics.width)
    );
    assert!((a.forward - b.forward).length() < 1e-6 && (a.down - b.down).length() < 1e-6);
    for (a, b) in back.laser.beams.iter().zip(&scene.laser.beams) {
        assert!((a.direction - b.direction).length() < 1e-6);
    }
    assert_eq!(back.triangle_count(), scene.triangle_count());
    let mirrors = |s: &Scene| {
        let materials = s.objects.iter().flat_map(|o| &o.mesh.materials);
        materials.filter(|m| m.is_specular()).count()
    };
    assert_eq!(mirrors(&back), mirrors(&scene));
}

const CUBE_OBJ: &str =
    "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n";

fn xml(bsdf: &str, more: &str) -> String {
    format!(
        r#"<?xml version="1.0" encoding="utf-8"?>
<scene version="3.0.0">
    <default name="res" value="128"/>
    <default name="resolution" value="200"/>
    <integrator type="path"><integer name="max_depth" value="8"/></integrator>
    <sensor type="perspective">
        <string name="fov_axis" value="smaller"/>
        <float name="fov" value="90"/>
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$res"/></sampler>
        <film type="hdrfilm"><integer name="width" value="$resolution"/><integer name="height" value="$res"/></film>
    </sensor>
    {bsdf}
    <shape type="rectangle" id="wall.1"><ref id="m"/>
        <transform name="to_world"><scale value="2"/><rotate y="1" angle="90"/><translate x="-1"/></transform>
    </shape>
    <shape type="obj"><string name="filename" value="a.obj"/><ref id="m"/></shape>
    <shape type="sphere"><point name="center" x="0" y="1" z="0"/><float name="radius" value="0.5"/></shape>
    <shape type="cube"/> <shape type="disk"><boolean name="flip_normals" value="true"/></shape>
    <emitter type="projector"><float name="fov" value="0.1"/><rgb name="irradiance" value="1"/>
        <transform name="to_world"><lookat origin="0,0,4" target="-1,0,0" up="0,1,0"/></transform></emitter>
    <emitter type="constant"/>
    {more}
</scene>"#
    )
}

fn read_text(name: &str, text: &str) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("a.obj"), CUBE_OBJ).expect("writes");
    let path = folder.path().join(name);
    std::fs::write(&path, text).expect("writes");
    read_scene(&path)
}

const GGX: &str = r#"<bsdf type="twosided" id="m"><bsdf type="blendbsdf"><float name="weight" value="0.25"/>
    <bsdf type="roughconductor"><string name="material" value="none"/><string name="distribution" value="ggx"/>
      <float name="alpha" value="0.2"/></bsdf>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.4, 0.6"/></bsdf></bsdf></bsdf>"#;

#[test]
fn a_foreign_scene_is_understood() {
    let scene = read_text("foreign.xml", &xml(GGX, "")).expect("reads");
    assert_eq!(scene.objects.len(), 5);
    assert_eq!(scene.labels, ["wall", "unlabelled"]);
    let Bsdf::Mixed {
        reflectance,
        alpha,
        distribution,
        specular_reflectance,
        weight,
    } = scene.objects[0].mesh.materials[0].bsdf
    else {
        panic!("a mix");
    };
    assert!((reflectance - 0.4).abs() < 1e-6);
    assert_eq!((alpha, distribution), (0.2, Distribution::Ggx));
    assert_eq!((specular_reflectance, weight), (1.0, 0.75));
    let wall = &scene.objects[0];
    assert!(wall.mesh.materials[0].two_sided && !scene.objects[3].mesh.materials[0].two_sided);
    let corner = wall.to_world.point(wall.mesh.positions[2]);
    assert!(
        (corner - Vec3::new(-1.0, 2.0, -2.0)).length() < 1e-6,
        "{corner:?}"
    );
    assert_eq!(
        scene.objects[1].mesh.uv[0],
        [0.0, 1.0],
        "OBJ counts v upwards"
    );
    let i = scene.camera.intrinsics;
    assert_eq!((i.width, i.height), (200, 128));
    assert!((i.fx - 64.0).abs() < 1e-3);
    assert!((scene.camera.right - Vec3::new(1.0, 0.0, 0.0)).length() < 1e-6);
    assert!((scene.camera.down - Vec3::new(0.0, -1.0, 0.0)).length() < 1e-6);
    let expected = Vec3::new(-1.0, 0.0, -4.0).normalized();
    assert!((scene.laser.beams[0].direction - expected).length() < 1e-6);
    assert_eq!(scene.laser.origin, Vec3::new(0.0, 0.0, 4.0));
    for note in ["emitters", "spheres", "disks"] {
        assert!(
            scene
                .provenance
                .notes
                .contains_key(&format!("import.{note}")),
            "{note}"
        );
    }
    let outward = |k: usize, centre: Vec3| {
        let o = &scene.objects[k];
        let at = |v: u32| o.to_world.point(o.mesh.positions[v as usize]);
        o.mesh.triangles.iter().all(|t| {
            let [a, b, c] = t.map(at);
            (b - a).cross(c - a).dot((a + b + c) / 3.0 - centre) > 0.0
        })
    };
    assert!(outward(2, Vec3::new(0.0, 1.0, 0.0)) && outward(3, Vec3::ZERO));
    assert!(
        outward(4, Vec3::new(0.0, 0.0, 1.0)),
        "turned by flip_normals"
    );
}

#[test]
fn elements_outside_the_subset_are_refused_by_name() {
    let alone = |inner: &str| format!("<bsdf type=\"twosided\" id=\"m\">{inner}</bsdf>");
    for (bsdf, more, expected) in [
        (
            alone("<bsdf type=\"velvet\"/>"),
            "",
            "bsdf \"velvet\" is not supported",
        ),
        (
            alone("<bsdf type=\"phong\"/>"),
            "",
            "line 13, <bsdf type=\"phong\">",
        ),
        (
            alone("<bsdf type=\"conductor\"><string name=\"material\" value=\"Xx\"/></bsdf>"),
            "",
            "material: \"Xx\" is not known",
        ),
        (alone(""), "", "expected one BSDF"),
        (String::new(), "", "refers to \"m\""),
        (
            GGX.into(),
            "<shape type=\"hair\"/>",
            "shape \"hair\" is not supported",
        ),
        (GGX.into(), "<include filename=\"b.xml\"/>", "b.xml"),
        (
            GGX.into(),
            "<shape type=\"ply\"><string name=\"filename\" value=\"$where\"/></shape>",
            "parameter without <default>",
        ),
        (
            GGX.into(),
            "<shape type=\"ply\"><string name=\"filename\" value=\"gone.ply\"/></shape>",
            "gone.ply",
        ),
        (
            GGX.into(),
            "<emitter type=\"projector\"><float name=\"fov\" value=\"1\"/></emitter>",
            "a laser has one place",
        ),
        (
            GGX.into(),
            "<shape type=\"cube\"><transform name=\"to_world\"><scale value=\"nan\"/></transform></shape>",
            "finite number",
        ),
    ] {
        let error = read_text("bad.xml", &xml(&bsdf, more))
            .expect_err(expected)
            .to_string();
        assert!(
            error.contains("bad.xml") && error.contains(expected),
            "{error}"
        );
    }
    let whole = xml(GGX, "");
    let error = read_text("cut.xml", &whole[..whole.len() - 20])
        .expect_err("cut")
        .to_string();
    assert!(error.contains("not readable XML"), "{error}");
}

#[test]
fn lamps_are_left_out_with_a_note_and_do_not_make_a_laser() {
    let dark = xml(GGX, "").replace("type=\"projector\"", "type=\"point\"");
    let scene = read_text("dark.xml", &dark).expect("reads");
    let notes = &scene.provenance.notes;
    assert!(notes.contains_key("import.emitters"), "{notes:?}");
    assert!(notes.contains_key("chosen.laser"), "{notes:?}");
    assert_eq!(scene.laser.beams.len(), 25);
    let lit = xml(GGX, "<emitter type=\"spot\"/>");
    let scene = read_text("lit.xml", &lit).expect("reads");
    let notes = &scene.provenance.notes;
    assert!(notes.contains_key("import.emitters"), "{notes:?}");
    assert!(!notes.contains_key("chosen.laser"), "{notes:?}");
}

const DICTIONARY: &str = r#"{
    "type": "scene",
    "integrator": {"type": "transient_path", "max_depth": 5},
    "sensor": {"type": "perspective", "fov": 90, "to_world": [[1,0,0,0],[0,1,0,0],[0,0,1,-3],[0,0,0,1]],
               "film": {"type": "transient_hdr_film", "width": 64, "height": 64, "temporal_bins": 100}},
    "white": {"type": "twosided", "inner": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.6, 0.7]}}},
    "wall": {"type": "rectangle", "to_world": [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]], "bsdf": {"type": "ref", "id": "white"}},
    "ball": {"type": "sphere", "center": [0, 0, 1], "radius": 0.3,
             "bsdf": {"type": "roughconductor", "material": "Al", "alpha": 0.05, "distribution": "ggx"}},
    "beam": {"type": "projector", "fov": 0.2, "irradiance": 1.0, "to_world": [[1,0,0,0],[0,1,0,0],[0,0,1,-3],[0,0,0,1]]}
}"#;

#[test]
fn the_dictionary_of_a_scene_is_understood() {
    let scene = read_text("scene.json", DICTIONARY).expect("reads");
    let of = |name: &str| {
        scene
            .objects
            .iter()
            .find(|o| o.name == name)
            .expect("there")
    };
    let m = &of("wall").mesh.materials[0];
    assert_eq!((m.rgb, m.two_sided), ([0.5, 0.6, 0.7], true));
    let Bsdf::RoughConductor {
        alpha,
        distribution,
        reflectance,
    } = of("ball").mesh.materials[0].bsdf
    else {
        panic!("a conductor");
    };
    assert_eq!((alpha, distribution), (0.05, Distribution::Ggx));
    assert!((reflectance - 0.92).abs() < 0.01);
    assert_eq!(scene.camera.right, Vec3::new(-1.0, 0.0, 0.0));
    assert_eq!(scene.laser.beams[0].direction, Vec3::new(0.0, 0.0, 1.0));
    for (from, to, expected) in [
        ("\"sphere\"", "\"hair\"", "scene.ball (type \"hair\")"),
        ("\"twosided\"", "\"plastic\"", "\"plastic\""),
        ("0.5, 0.6, 0.7", "0.5, 0.6", "scene.white.inner.reflectance"),
        (
            "\"id\": \"white\"",
            "\"id\": \"black\"",
            "refers to \"black\"",
        ),
    ] {
        let error = read_text("bad.json", &DICTIONARY.replacen(from, to, 1))
            .expect_err(to)
            .to_string();
        assert!(
            error.contains("bad.json") && error.contains(expected),
            "{error}"
        );
    }
}

#[test]
fn files_that_a_scene_refers_to_are_part_of_its_fingerprint() {
    let folder = tempfile::tempdir().expect("a folder");
    let path: PathBuf = folder.path().join("scene.xml");
    export::write_mitsuba(&common::textured_room(), &path).expect("writes");
    let before = import::fingerprint(&path, &Bounds::default()).expect("hashes");
    let change = |file: &Path| {
        let mut bytes = std::fs::read(file).expect("the file");
        *bytes.last_mut().expect("bytes") ^= 1;
        std::fs::write(file, bytes).expect("writes");
        import::fingerprint(&path, &Bounds::default()).expect("hashes")
    };
    let after = change(&folder.path().join("meshes/0000-0.ply"));
    assert_ne!(before, after);
    assert_ne!(
        after,
        change(&folder.path().join("textures/material0-reflectance.png"))
    );
}

#[test]
fn a_grid_stated_on_import_replaces_the_beams() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    export::write_mitsuba(&common::textured_room(), &path).expect("writes");
    let options = ImportOptions {
        laser: Aim::grid(4),
        ..ImportOptions::default()
    };
    let scene = read_scene_with(&path, &options, &Bounds::default()).expect("reads");
    assert_eq!(scene.laser.beams.len(), 4);
}

#[test]
fn thin_glass_comes_back_as_it_went_and_is_read_from_others() {
    use picofarm_scene::Material;
    let folder = tempfile::tempdir().expect("a folder");
    for (k, face) in [false, true].into_iter().enumerate() {
        let mut scene = common::textured_room();
        let mut glass = Material::glass("green glass");
        glass.rgb = [0.5, 0.75, 0.625];
        glass.bsdf = Bsdf::ThinDielectric {
            ior: 1.52,
            transmittance: 0.625,
            face,
        };
        let mesh = std::sync::Arc::make_mut(&mut scene.objects[0].mesh);
        mesh.materials[0] = glass.clone();
        let path = folder.path().join(format!("{k}.xml"));
        let notes = export::write_mitsuba(&scene, &path).expect("writes");
        assert_eq!(
            notes.iter().any(|n| n.contains("whole pane")),
            face,
            "{notes:?}"
        );
        let back = import::read_scene(&path).expect("reads");
        let all = |s: &picofarm_scene::Scene| -> Vec<Material> {
            let each = s.objects.iter().flat_map(|o| o.mesh.materials.clone());
            each.filter(Material::is_glass).collect()
        };
        assert_eq!(all(&back), [glass.clone()]);
        let glb = folder.path().join(format!("{k}.glb"));
        export::write_glb(&scene, &glb).expect("writes");
        assert_eq!(all(&import::read_scene(&glb).expect("reads")), [glass]);
    }
    // Mitsuba's own terms: named media; reflections only without a tint.
    let plain = r#"{"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.6, 0.7]}}"#;
    let text = |glass: &str| {
        DICTIONARY.replacen(
            &format!(r#"{{"type": "twosided", "inner": {plain}}}"#),
            glass,
            1,
        )
    };
    let read = |glass: &str| read_text("scene.json", &text(glass));
    let scene = read(r#"{"type": "thindielectric"}"#).expect("reads");
    assert!(!scene.provenance.notes.contains_key("import.glass"));
    let wall = scene
        .objects
        .iter()
        .find(|o| o.name == "wall")
        .expect("there");
    let Bsdf::ThinDielectric { ior, .. } = wall.mesh.materials[0].bsdf else {
        panic!("glass");
    };
    assert!((ior - 1.5046 / 1.000_277).abs() < 1e-6, "{ior}");
    let dull = r#"{"type": "thindielectric", "int_ior": "water", "ext_ior": 1.0, "specular_reflectance": 0.0}"#;
    let scene = read(dull).expect("reads");
    let note = &scene.provenance.notes["import.glass"];
    assert!(note.contains("specular_reflectance is not used"), "{note}");
    for (glass, expected) in [
        (
            r#"{"type": "thindielectric", "int_ior": "jelly"}"#,
            "\"jelly\" is not known",
        ),
        (
            r#"{"type": "thindielectric", "int_ior": 0.5}"#,
            "outside [1, 4]",
        ),
        (
            r#"{"type": "twosided", "inner": {"type": "thindielectric"}}"#,
            "thindielectric by itself",
        ),
    ] {
        let error = read(glass).expect_err(expected).to_string();
        assert!(error.contains(expected), "{error}");
    }
}
