//! Canonical `.glb` files are restored exactly, and appear completely or not at all.

use picofarm_scene::{
    Bsdf, Material, Scene, export,
    import::read_scene,
    primitive::{self, PrimitiveSettings},
};

use crate::common;

fn scene() -> Scene {
    let settings = PrimitiveSettings {
        width: 96,
        height: 64,
        ..PrimitiveSettings::default()
    };
    primitive::generate(3, &settings).expect("ordinary seeds succeed")
}

#[test]
fn a_written_scene_reads_back_exactly() {
    comes_back(scene());
}

#[test]
fn textures_and_mixes_read_back_exactly() {
    comes_back(common::textured_room());
}

#[test]
fn spectra_read_back_exactly() {
    comes_back(common::spectral_room());
}

#[test]
fn files_of_scenes_without_spectra_do_not_mention_them() {
    let bytes = export::glb_bytes(&common::textured_room()).expect("valid");
    let word = b"spectrum";
    assert!(!bytes.windows(word.len()).any(|w| w == word));
}

fn comes_back(scene: Scene) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("room.glb");
    export::write_glb(&scene, &path).expect("writes");
    let back = read_scene(&path).expect("reads");
    assert_eq!(back.name, scene.name);
    assert_eq!(back.labels, scene.labels);
    assert_eq!(back.camera, scene.camera);
    assert_eq!(back.laser, scene.laser);
    assert_eq!(back.provenance, scene.provenance);
    assert_eq!(back.objects.len(), scene.objects.len());
    for (a, b) in back.objects.iter().zip(&scene.objects) {
        assert_eq!(
            (a.label, &a.name, a.to_world),
            (b.label, &b.name, b.to_world)
        );
        assert_eq!(a.mesh, b.mesh);
    }
    assert_eq!(
        export::glb_bytes(&back).expect("valid"),
        std::fs::read(&path).expect("the file"),
        "writing again gives the same bytes"
    );
    let left: Vec<_> = std::fs::read_dir(folder.path()).expect("lists").collect();
    assert_eq!(left.len(), 1, "no temporary file stays behind");
}

#[test]
fn other_programs_see_metal_with_the_square_root_of_alpha() {
    let bytes = export::glb_bytes(&scene()).expect("valid");
    let document = gltf::Gltf::from_slice(&bytes).expect("standard glTF");
    let mirror = document
        .materials()
        .find(|m| m.name() == Some("mirror"))
        .expect("a mirror");
    let pbr = mirror.pbr_metallic_roughness();
    assert_eq!(pbr.metallic_factor(), 1.0);
    assert!((pbr.roughness_factor() - 0.1).abs() < 1e-6);
    assert_eq!(document.cameras().count(), 1);
}

#[test]
fn normals_are_of_unit_length_and_do_not_change_what_is_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("room.glb");
    let bytes = export::glb_bytes_with_normals(&scene()).expect("valid");
    std::fs::write(&path, &bytes).expect("writes");
    let back = read_scene(&path).expect("reads");
    assert_eq!(
        export::glb_bytes(&back).expect("valid"),
        export::glb_bytes(&scene()).expect("valid")
    );
    let gltf::Gltf { document, blob } = gltf::Gltf::from_slice(&bytes).expect("standard glTF");
    for mesh in document.meshes() {
        for primitive in mesh.primitives() {
            let reader = primitive.reader(|_| blob.as_deref());
            let positions = reader.read_positions().expect("positions").count();
            let normals: Vec<[f32; 3]> = reader.read_normals().expect("normals").collect();
            assert_eq!(normals.len(), positions, "{:?}", mesh.name());
            for n in normals {
                let square: f32 = n.iter().map(|x| x * x).sum();
                assert!((square - 1.0).abs() < 1e-5, "{n:?}");
            }
        }
    }
}

/// Returns the scene as a file in which another program changed the mirror's roughness to 0.5.
fn edited(scene: &Scene) -> Vec<u8> {
    let mut bytes = export::glb_bytes(scene).expect("valid");
    let factor = b"\"roughnessFactor\":0.1}";
    let at = bytes
        .windows(factor.len())
        .position(|w| w == factor)
        .expect("the mirror's roughness");
    bytes[at + 18..at + 21].copy_from_slice(b"0.5");
    bytes
}

fn read_bytes(bytes: &[u8]) -> Scene {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("edited.glb");
    std::fs::write(&path, bytes).expect("writes");
    read_scene(&path).expect("reads")
}

fn mirrors(scene: &Scene) -> Vec<&Material> {
    let all = scene.objects.iter().flat_map(|o| &o.mesh.materials);
    all.filter(|m| matches!(m.bsdf, Bsdf::RoughConductor { .. }))
        .collect()
}

#[test]
fn a_roughness_edited_elsewhere_takes_effect() {
    let back = read_bytes(&edited(&scene()));
    let Bsdf::RoughConductor { alpha, .. } = mirrors(&back)[0].bsdf else {
        panic!("a conductor");
    };
    assert_eq!(alpha, 0.25);
    let notes = back.provenance.notes;
    assert!(notes.contains_key("import.materials"));
    assert!(!notes.contains_key("import.spectra.edited"));
}

#[test]
fn a_roughness_edited_elsewhere_drops_the_spectrum_with_a_note() {
    let scene = common::spectral_room();
    assert_eq!(mirrors(&scene).len(), 1);
    let back = read_bytes(&edited(&scene));
    assert_eq!(mirrors(&back)[0].spectrum, []);
    assert!(back.provenance.notes.contains_key("import.spectra.edited"));
    let kept = |s: &Scene| {
        let all = s.objects.iter().flat_map(|o| &o.mesh.materials);
        all.filter(|m| !m.spectrum.is_empty()).count()
    };
    assert_eq!(kept(&back), kept(&scene) - 1);
}

/// The scene as a file in which another program set a factor of one mesh's first material.
fn with_factor(scene: &Scene, mesh: usize, factor: &str, value: f32) -> Vec<u8> {
    let bytes = export::glb_bytes(scene).expect("valid");
    let length = u32::from_le_bytes([bytes[12], bytes[13], bytes[14], bytes[15]]) as usize;
    let mut json: serde_json::Value =
        serde_json::from_slice(&bytes[20..20 + length]).expect("JSON");
    let slot = json["meshes"][mesh]["primitives"][0]["material"].as_u64();
    let slot = slot.expect("a material") as usize;
    json["materials"][slot]["pbrMetallicRoughness"][factor] = value.into();
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut out = bytes[..8].to_vec();
    out.extend(((bytes.len() - length + text.len()) as u32).to_le_bytes());
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(&bytes[16..20]);
    out.extend(text);
    out.extend(&bytes[20 + length..]);
    out
}

#[test]
fn a_mix_edited_elsewhere_becomes_what_the_standard_factors_say() {
    let scene = common::spectral_room();
    for (factor, new) in [("metallicFactor", 0.9), ("roughnessFactor", 0.125)] {
        let back = read_bytes(&with_factor(&scene, 1, factor, new));
        let [before, after] = [&scene, &back].map(|s| s.objects[1].mesh.materials[0].clone());
        assert!(matches!(before.bsdf, Bsdf::Mixed { .. }));
        assert!(matches!(after.bsdf, Bsdf::Mixed { .. }), "{:?}", after.bsdf);
        assert_ne!(before.bsdf, after.bsdf);
        assert_eq!(after.spectrum, []);
        let notes = &back.provenance.notes;
        assert!(
            notes.contains_key("import.materials") && notes.contains_key("import.spectra.edited")
        );
    }
}

#[test]
fn a_material_of_several_parts_is_refused_by_its_place() {
    let bytes = export::glb_bytes(&common::spectral_room()).expect("valid");
    // Of the same length, so that the file stays whole.
    let (ours, several) = (&b"\"type\":\"mixed\""[..], &b"\"type\":\"sever\""[..]);
    let at = bytes.windows(ours.len()).position(|w| w == ours);
    let at = at.expect("a mix");
    let mut bytes = bytes;
    bytes[at..at + ours.len()].copy_from_slice(several);
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("old.glb");
    std::fs::write(&path, bytes).expect("writes");
    let error = read_scene(&path).expect_err("no such kind").to_string();
    assert!(
        error.contains("materials[") && error.contains("expected one of `diffuse`"),
        "{error}"
    );
}
