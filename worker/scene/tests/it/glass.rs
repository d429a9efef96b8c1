//! Bodies of glass: files restore them, Mitsuba's are supported, and invalid bodies are refused.

use crate::common;

use std::sync::Arc;

use picofarm_scene::{
    Affine, Bsdf, Material, Mesh, Object, Scene, SceneError, SpectrumPoint, Vec3, export,
    import::read_scene,
    primitive::{self, PrimitiveSettings},
};

/// Returns an octahedron with facets facing outwards.
fn octahedron(material: Material) -> Mesh {
    let tip = |k: usize| {
        let axis = |a: usize| if k / 2 == a { [0.3, -0.3][k % 2] } else { 0.0 };
        Vec3::new(axis(0), axis(1), axis(2))
    };
    // Facets of +x, +y and +z in this order, reversed for each negative one.
    let facet = |k: u32| {
        let [x, y, z] = [k & 1, 2 + (k >> 1 & 1), 4 + (k >> 2 & 1)];
        if k.count_ones().is_multiple_of(2) {
            [x, y, z]
        } else {
            [x, z, y]
        }
    };
    Mesh {
        name: "stone".into(),
        positions: (0..6).map(tip).collect(),
        uv: vec![],
        triangles: (0..8).map(facet).collect(),
        triangle_material: vec![0; 8],
        materials: vec![material],
    }
}

fn green() -> Material {
    Material {
        rgb: [0.5, 0.75, 0.625],
        bsdf: Bsdf::Dielectric {
            ior: 1.4585,
            transmittance: 0.8,
        },
        ..Material::solid_glass("green glass")
    }
}

fn room_with(mesh: Mesh) -> Scene {
    let settings = PrimitiveSettings::default();
    let mut scene = primitive::generate(5, &settings).expect("ordinary seeds succeed");
    let mut to_world = Affine::IDENTITY;
    to_world.translation = Vec3::new(0.1, 1.2, -0.3);
    scene.objects.push(Object {
        mesh: Arc::new(mesh),
        to_world,
        label: 0,
        name: "stone".into(),
    });
    scene
}

fn stone(scene: &Scene) -> &Mesh {
    &scene.objects.last().expect("objects").mesh
}

#[test]
fn bodies_of_glass_read_back_exactly() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = room_with(octahedron(green()));
    let glb = folder.path().join("room.glb");
    export::write_glb(&scene, &glb).expect("writes");
    let back = read_scene(&glb).expect("reads");
    assert_eq!(stone(&back), stone(&scene));
    assert_eq!(back.provenance, scene.provenance);
    assert_eq!(
        export::glb_bytes(&back).expect("valid"),
        export::glb_bytes(&scene).expect("valid")
    );

    let xml = folder.path().join("scene.xml");
    let notes = export::write_mitsuba(&scene, &xml).expect("writes");
    assert_eq!(notes, Vec::<String>::new());
    let back = read_scene(&xml).expect("reads");
    assert_eq!(stone(&back), stone(&scene));
    assert_eq!(back.provenance, scene.provenance);

    // Mitsuba's elements alone give the same material.
    let text = std::fs::read_to_string(&xml).expect("the file");
    let plain: Vec<&str> = text.lines().filter(|l| !l.starts_with("<!--")).collect();
    std::fs::write(&xml, plain.join("\n")).expect("writes");
    let back = read_scene(&xml).expect("reads");
    let Bsdf::Dielectric { ior, transmittance } = stone(&back).materials[0].bsdf else {
        panic!("a body of glass");
    };
    assert!((ior - 1.4585).abs() < 1e-6 && (transmittance - 0.8).abs() < 1e-6);
}

#[test]
fn other_programs_see_glass_with_a_volume() {
    let bytes = export::glb_bytes(&room_with(octahedron(green()))).expect("valid");
    let document = gltf::Gltf::from_slice(&bytes).expect("standard glTF");
    let mut materials = document.materials();
    let glass = materials.find(|m| m.name() == Some("green glass"));
    let glass = glass.expect("the glass");
    let transmission = glass.transmission().expect("transmission");
    assert_eq!(transmission.transmission_factor(), 1.0);
    assert_eq!(glass.ior(), Some(1.4585));
    assert!(glass.volume().expect("a volume").thickness_factor() > 0.0);
    let all: Vec<&str> = document.extensions_used().collect();
    assert!(all.contains(&"KHR_materials_volume"), "{all:?}");
}

#[test]
fn thin_glass_of_exports_without_reflections_is_ours_still() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    let glass = Bsdf::ThinDielectric {
        ior: 1.52,
        transmittance: 0.625,
        face: true,
    };
    let mut material = green();
    material.bsdf = glass;
    export::write_mitsuba(&room_with(octahedron(material)), &path).expect("writes");
    let text = std::fs::read_to_string(&path).expect("the file");
    let line = text.lines().find(|l| l.contains("\"thindielectric\""));
    let line = line.expect("the glass");
    assert!(!line.contains("specular_reflectance"), "{line}");
    let air = r#"<float name="ext_ior" value="1"/>"#;
    let before = format!(r#"{air}<rgb name="specular_reflectance" value="0 0 0"/>"#);
    std::fs::write(&path, text.replacen(air, &before, 1)).expect("writes");
    let back = read_scene(&path).expect("reads");
    assert_eq!(stone(&back).materials[0].bsdf, glass);
    let notes = &back.provenance.notes;
    assert!(!notes.contains_key("import.materials"), "{notes:?}");
}

fn dictionary(shape: &str, bsdf: &str) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.json");
    let text = format!(
        r#"{{"type": "scene", "sensor": {{"type": "perspective", "fov": 90}}, "beam": {{"type": "projector", "fov": 0.1}},
        "stone": {{{shape}, "bsdf": {bsdf}}}}}"#
    );
    std::fs::write(&path, text).expect("writes");
    read_scene(&path)
}

#[test]
fn mitsubas_dielectric_is_a_body_on_closed_shapes() {
    let sphere = r#""type": "sphere", "center": [0, 0, 3], "radius": 0.3"#;
    for shape in [sphere, r#""type": "cube""#] {
        let scene = dictionary(shape, r#"{"type": "dielectric"}"#).expect(shape);
        let material = &stone(&scene).materials[0];
        let Bsdf::Dielectric { ior, transmittance } = material.bsdf else {
            panic!("a body of glass");
        };
        assert!((ior - 1.5046 / 1.000_277).abs() < 1e-6, "{ior}");
        assert_eq!((transmittance, material.rgb), (1.0, [1.0; 3]));
        assert!(!scene.provenance.notes.contains_key("import.glass"));
    }
    let water = r#"{"type": "dielectric", "int_ior": "water", "ext_ior": 1.0, "specular_reflectance": 0.5,
        "specular_transmittance": {"type": "rgb", "value": [0.75, 0.5, 0.25]}}"#;
    let scene = dictionary(sphere, water).expect("reads");
    let material = &stone(&scene).materials[0];
    let expected = Bsdf::Dielectric {
        ior: 1.333,
        transmittance: 0.5,
    };
    assert_eq!((material.bsdf, material.rgb), (expected, [0.75, 0.5, 0.25]));
    let notes = &scene.provenance.notes;
    assert!(notes.contains_key("import.glass"), "{notes:?}");
    let rough = water.replacen("int_ior", "rough\": 1, \"int_ior", 1);
    let said = dictionary(sphere, &rough).expect_err("rough").to_string();
    assert!(said.contains("\"rough\""), "{said}");
}

#[test]
fn mitsubas_glass_that_is_no_body_is_refused_with_a_way_out() {
    let sphere = r#""type": "sphere""#;
    for (shape, bsdf, expected) in [
        (
            r#""type": "sphere", "flip_normals": true"#,
            r#"{"type": "dielectric"}"#,
            "in Mitsuba set flip_normals",
        ),
        (
            sphere,
            r#"{"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}"#,
            "lies outside [1, 4]; a cavity belongs",
        ),
        (
            sphere,
            r#"{"type": "dielectric", "int_ior": "jelly"}"#,
            "\"jelly\" is not known",
        ),
        (
            sphere,
            r#"{"type": "dielectric", "specular_transmittance": {"type": "bitmap", "filename": "a.png"}}"#,
            "a.png",
        ),
        (
            sphere,
            r#"{"type": "dielectric", "specular_transmittance": {"type": "spectrum", "value": [[450, 0.2]]}}"#,
            "spectra on glass are not supported",
        ),
        (
            sphere,
            r#"{"type": "twosided", "inner": {"type": "dielectric"}}"#,
            "dielectric or thindielectric by itself",
        ),
    ] {
        let error = dictionary(shape, bsdf).expect_err(expected).to_string();
        assert!(
            error.contains("scene.json") && error.contains(expected),
            "{error}"
        );
    }
}

#[test]
fn mitsubas_open_glass_is_thin_with_a_note() {
    let scene = dictionary(r#""type": "rectangle""#, r#"{"type": "dielectric"}"#).expect("reads");
    let bsdf = stone(&scene).materials[0].bsdf;
    assert!(matches!(bsdf, Bsdf::ThinDielectric { .. }), "{bsdf:?}");
    let note = &scene.provenance.notes["import.glass.open"];
    assert!(note.contains("not closed"), "{note}");
}

/// Returns the fault of the scene, if the field is that of the glass.
fn refusal(mesh: Mesh) -> String {
    let scene = room_with(mesh);
    let k = scene.objects.len() - 1;
    let Err(SceneError::Invalid { field, what, .. }) = scene.validate() else {
        panic!("expected an invalid scene");
    };
    assert_eq!(
        field,
        format!("objects[{k}] (stone).materials[green glass]")
    );
    what
}

#[test]
fn bodies_are_within_their_limits_closed_and_face_outwards() {
    room_with(octahedron(green())).validate().expect("a body");
    for (ior, transmittance, expected) in [
        (0.9, 1.0, "ior = 0.9 lies outside [1, 4]"),
        (4.5, 1.0, "ior = 4.5 lies outside [1, 4]"),
        (f32::NAN, 1.0, "ior = NaN lies outside [1, 4]"),
        (1.5, 1.5, "transmittance = 1.5 lies outside [0, 1]"),
        (1.5, -0.5, "transmittance = -0.5 lies outside [0, 1]"),
    ] {
        let bsdf = Bsdf::Dielectric { ior, transmittance };
        let what = refusal(octahedron(Material { bsdf, ..green() }));
        assert!(what.contains(expected), "{what}");
    }
    let texture = common::textured_room().objects[0].mesh.materials[0]
        .texture
        .clone();
    assert!(texture.is_some());
    let what = refusal(octahedron(Material { texture, ..green() }));
    assert!(what.contains("glass takes no texture"), "{what}");
    let spectrum = vec![SpectrumPoint {
        nm: 905.0,
        reflectance: 0.5,
        specular_reflectance: None,
    }];
    let what = refusal(octahedron(Material {
        spectrum,
        ..green()
    }));
    assert!(what.contains("spectrum: glass takes none"), "{what}");

    let mut open = octahedron(green());
    open.triangles.pop();
    open.triangle_material.pop();
    let what = refusal(open);
    assert!(
        what.starts_with("dielectric: the surface has a rim") && what.contains("thin_dielectric"),
        "{what}"
    );
    let mut inverted = octahedron(green());
    inverted.triangles.iter_mut().for_each(|t| t.swap(0, 1));
    let what = refusal(inverted);
    assert!(
        what.contains("face the inside of the body, expected the outside"),
        "{what}"
    );
    let mut torn = octahedron(green());
    torn.triangles[3].swap(0, 1);
    assert!(refusal(torn).contains("face opposite sides"));

    // Another material may have a rim.
    let mut two = octahedron(green());
    two.materials.push(Material::diffuse("paper", [0.5; 3]));
    two.triangles.push([0, 2, 4]);
    two.triangle_material.push(1);
    room_with(two)
        .validate()
        .expect("a body with a label on it");
}
