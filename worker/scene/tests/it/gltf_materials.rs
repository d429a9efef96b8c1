//! Materials of other glTF files: textures, partial metals and extensions, and the notes on other
//! features.

use crate::common;

use std::{io::Cursor, path::Path};

use common::data_uri;
use image::{ImageFormat, RgbImage};
use picofarm_scene::{Bsdf, Distribution, Scene, SceneError, SpectrumPoint, Wrap, export, import};

/// Returns a picture with `a` in the left half and `b` in the right.
fn picture(format: ImageFormat, a: [u8; 3], b: [u8; 3]) -> Vec<u8> {
    let image = RgbImage::from_fn(16, 8, |x, _| image::Rgb(if x < 8 { a } else { b }));
    let mut out = Cursor::new(Vec::new());
    image.write_to(&mut out, format).expect("encodes");
    out.into_inner()
}

/// Returns a file with a triangle with texture coordinates, `material` and `more` top-level keys.
fn file(material: &str, more: &str) -> String {
    let numbers = [
        0., 0., 0., 1., 0., 0., 0., 1., 0., 0., 0., 1., 0., 0., 1.0f32,
    ];
    let buffer: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
    format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0,1]}}],
        "nodes":[{{"mesh":0,"translation":[0,0,-2]}},{{"camera":0,"extras":{{"laser_spots":1}}}}],
        "cameras":[{{"type":"perspective","perspective":{{"yfov":1,"znear":0.01}}}}],
        "materials":[{material}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":1}},"material":0}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}},
                     {{"bufferView":1,"componentType":5126,"count":3,"type":"VEC2"}}],
        "bufferViews":[{{"buffer":0,"byteLength":36}},{{"buffer":0,"byteOffset":36,"byteLength":24}}],
        "buffers":[{{"byteLength":60,"uri":"{}"}}]{more}}}"#,
        data_uri(&buffer)
    )
}

fn read_in(folder: &Path, text: String) -> Result<Scene, SceneError> {
    let path = folder.join("scene.gltf");
    std::fs::write(&path, text).expect("writes");
    import::read_scene(&path)
}

fn read(text: String) -> Scene {
    let folder = tempfile::tempdir().expect("a folder");
    read_in(folder.path(), text).expect("reads")
}

fn images(uri: &str) -> String {
    format!(
        r#","textures":[{{"source":0,"sampler":0}}],"samplers":[{{"wrapS":33071,"wrapT":33071}}],
        "images":[{{"uri":"{uri}"}}],"extensionsUsed":["KHR_texture_transform","KHR_materials_clearcoat"]"#
    )
}

const TEXTURED: &str = r#"{"name":"m","pbrMetallicRoughness":{"baseColorFactor":[0.5,0.5,1,1],"metallicFactor":0,
    "baseColorTexture":{"index":0,"extensions":{"KHR_texture_transform":{"offset":[0.5,0],"scale":[0.25,2]}}}}}"#;

#[test]
fn albedo_textures_come_from_data_uris_and_files_as_png_and_jpeg() {
    let folder = tempfile::tempdir().expect("a folder");
    let (red, grey) = ([255, 0, 0], [188, 188, 188]);
    for format in [ImageFormat::Png, ImageFormat::Jpeg] {
        let bytes = picture(format, red, grey);
        std::fs::write(folder.path().join("a picture"), &bytes).expect("writes");
        for uri in ["a%20picture", &data_uri(&bytes)] {
            let scene = read_in(folder.path(), file(TEXTURED, &images(uri))).expect("reads");
            let mesh = &scene.objects[0].mesh;
            // (1, 0) · (0.25, 2) + (0.5, 0)
            assert_eq!(mesh.uv, [[0.5, 0.0], [0.75, 0.0], [0.5, 2.0]]);
            let material = &mesh.materials[0];
            let texture = material.texture.as_ref().expect("a texture");
            assert_eq!(texture.wrap(), Wrap::Clamp);
            let [r, g, b] = texture.at([0.1, 0.5]);
            assert!(
                (r - 1.0).abs() < 0.02 && g < 0.01 && b < 0.01,
                "{r} {g} {b}"
            );
            let (rgb, laser) = material.factors([0.9, 0.5]);
            assert!(rgb.iter().all(|c| (c - 0.503).abs() < 0.01), "{rgb:?}");
            assert!((laser - 0.503).abs() < 0.01);
            assert!(scene.provenance.notes["import.extensions"].contains("clearcoat"));
        }
    }
}

#[test]
fn damaged_or_missing_images_are_refused_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let missing = read_in(folder.path(), file(TEXTURED, &images("gone.png")));
    assert!(
        missing
            .expect_err("no file")
            .to_string()
            .contains("gone.png")
    );
    let mut png = picture(ImageFormat::Png, [0; 3], [255; 3]);
    png.truncate(60);
    let cut = read_in(folder.path(), file(TEXTURED, &images(&data_uri(&png))));
    let error = cut.expect_err("cut short").to_string();
    assert!(error.contains("materials[0]: images[0]: image"), "{error}");
}

#[test]
fn a_metal_in_part_is_a_mix() {
    let material = r#"{"pbrMetallicRoughness":{"baseColorFactor":[0.8,0.8,0.8,1],"metallicFactor":0.25,"roughnessFactor":0.5}}"#;
    let scene = read(file(material, ""));
    let expected = Bsdf::Mixed {
        reflectance: 0.8,
        alpha: 0.25,
        distribution: Distribution::Ggx,
        specular_reflectance: 0.8,
        weight: 0.25,
    };
    assert_eq!(scene.objects[0].mesh.materials[0].bsdf, expected);
}

#[test]
fn a_metallic_roughness_texture_counts_by_its_means() {
    let material = r#"{"pbrMetallicRoughness":{"metallicRoughnessTexture":{"index":0}}}"#;
    let png = picture(ImageFormat::Png, [0, 255, 0], [0, 255, 255]);
    let scene = read(file(material, &images(&data_uri(&png))));
    let Bsdf::Mixed { weight, alpha, .. } = scene.objects[0].mesh.materials[0].bsdf else {
        panic!("half metal");
    };
    assert_eq!((weight, alpha), (0.5, 1.0));
    let notes = &scene.provenance.notes;
    assert!(notes.contains_key("import.metallic_roughness_textures"));
}

#[test]
fn an_unlit_material_is_lambertian_whatever_its_metalness() {
    let material = r#"{"pbrMetallicRoughness":{"baseColorFactor":[0.25,0.5,0.75,1]},
        "extensions":{"KHR_materials_unlit":{}}}"#;
    let scene = read(file(
        material,
        r#","extensionsUsed":["KHR_materials_unlit"]"#,
    ));
    let expected = Bsdf::Diffuse { reflectance: 0.5 };
    assert_eq!(scene.objects[0].mesh.materials[0].bsdf, expected);
}

#[test]
fn a_specular_glossiness_texture_counts_by_its_means() {
    let material = r#"{"extensions":{"KHR_materials_pbrSpecularGlossiness":{
        "diffuseFactor":[0.5,0.5,0.5,1],"glossinessFactor":0.5,"specularGlossinessTexture":{"index":0}}}}"#;
    let of = |png: &[u8]| {
        let scene = read(file(material, &images(&data_uri(png))));
        let note = &scene.provenance.notes["import.specular_glossiness_textures"];
        assert!(note.contains("means"), "{note}");
        scene.objects[0].mesh.materials[0].bsdf
    };
    let dark = picture(ImageFormat::Png, [20; 3], [20; 3]);
    assert_eq!(of(&dark), Bsdf::Diffuse { reflectance: 0.5 });
    let half = picture(ImageFormat::Png, [255; 3], [0; 3]);
    let Bsdf::Mixed { weight, alpha, .. } = of(&half) else {
        panic!("half metal");
    };
    assert!((weight - 0.5).abs() < 1e-6 && (alpha - 0.25).abs() < 1e-6);
}

#[test]
fn extensions_are_honoured_or_noted() {
    let glossy = r#"{"extensions":{"KHR_materials_pbrSpecularGlossiness":{"diffuseFactor":[0.5,0.5,0.5,1],
        "specularFactor":[0.4,0.4,0.4],"glossinessFactor":0.5}}}"#;
    let used = r#","extensionsUsed":["KHR_materials_pbrSpecularGlossiness"],"extensionsRequired":["KHR_materials_pbrSpecularGlossiness"]"#;
    let scene = read(file(glossy, used));
    let Bsdf::Mixed {
        weight,
        alpha,
        reflectance,
        specular_reflectance,
        ..
    } = scene.objects[0].mesh.materials[0].bsdf
    else {
        panic!("a mix");
    };
    assert_eq!((weight, alpha, reflectance), (0.4, 0.25, 0.5));
    assert!((specular_reflectance - 1.0).abs() < 1e-6);

    for (material, note) in [
        (
            r#"{"emissiveFactor":[1,1,1],"pbrMetallicRoughness":{"metallicFactor":0}}"#,
            "emission",
        ),
        (
            r#"{"extensions":{"KHR_materials_ior":{"ior":1.4}}}"#,
            "coats",
        ),
        (r#"{"extensions":{"KHR_materials_unlit":{}}}"#, "unlit"),
        (
            r#"{"extensions":{"KHR_materials_transmission":{"transmissionFactor":0.4}}}"#,
            "transmission",
        ),
        (
            r#"{"pbrMetallicRoughness":{"metallicFactor":0},"extensions":{"KHR_materials_transmission":{"transmissionFactor":1}}}"#,
            "glass",
        ),
        (
            r#"{"extensions":{"KHR_materials_sheen":{}}}"#,
            "materials.KHR_materials_sheen",
        ),
        (r#"{"alphaMode":"BLEND"}"#, "transparency"),
    ] {
        let scene = read(file(material, ""));
        let key = format!("import.{note}");
        assert!(
            scene.provenance.notes.contains_key(&key),
            "{key}: {:?}",
            scene.provenance.notes
        );
    }
}

#[test]
fn what_lets_light_through_is_thin_glass() {
    let of = |material: &str| {
        let scene = read(file(material, ""));
        scene.objects[0].mesh.materials[0].clone()
    };
    let glass = |ior, transmittance, face| Bsdf::ThinDielectric {
        ior,
        transmittance,
        face,
    };
    let tinted = of(
        r#"{"pbrMetallicRoughness":{"baseColorFactor":[1,0.5,0.75,1],"metallicFactor":0},
            "extensions":{"KHR_materials_transmission":{"transmissionFactor":0.8},"KHR_materials_ior":{"ior":1.6}}}"#,
    );
    assert_eq!(tinted.bsdf, glass(1.6, 0.6, false));
    assert_eq!(tinted.rgb, [0.8, 0.4, 0.6]);
    // A solid, which has two faces, with absorption along the path.
    let solid = of(r#"{"pbrMetallicRoughness":{"metallicFactor":0},
            "extensions":{"KHR_materials_transmission":{"transmissionFactor":1},
            "KHR_materials_volume":{"thicknessFactor":0.02,"attenuationDistance":0.01,"attenuationColor":[0.5,0.5,0.5]}}}"#);
    assert_eq!(solid.bsdf, glass(1.5, 0.25, true));
    // Glass by opacity, in the blending mode only.
    let text = |mode: &str, opacity: f32| {
        format!(
            r#"{{"alphaMode":"{mode}","pbrMetallicRoughness":{{"baseColorFactor":[1,1,1,{opacity}],"metallicFactor":0}}}}"#
        )
    };
    assert_eq!(of(&text("BLEND", 0.25)).bsdf, glass(1.5, 0.75, false));
    for opaque in [text("BLEND", 0.75), text("OPAQUE", 0.25)] {
        assert_eq!(of(&opaque).bsdf, Bsdf::Diffuse { reflectance: 1.0 });
    }
    // A metal transmits nothing.
    let metal = of(
        r#"{"pbrMetallicRoughness":{"metallicFactor":1,"roughnessFactor":0.5},
            "extensions":{"KHR_materials_transmission":{"transmissionFactor":1}}}"#,
    );
    assert!(matches!(metal.bsdf, Bsdf::RoughConductor { .. }));
}

fn point(nm: f32, reflectance: f32) -> SpectrumPoint {
    SpectrumPoint {
        nm,
        reflectance,
        specular_reflectance: None,
    }
}

#[test]
fn anyone_may_state_a_spectrum_in_a_materials_extras() {
    let text = |metallic: f32, rows: &str| {
        let material = format!(
            r#"{{"extras":{{"price":3,"spectrum":{rows}}},"pbrMetallicRoughness":{{"baseColorFactor":[0.1,0.2,0.3,1],
            "metallicFactor":{metallic},"roughnessFactor":0.5}}}}"#
        );
        file(&material, "")
    };
    let rows = r#"[{"nm":532,"reflectance":0.3},{"nm":904.6,"reflectance":0.7}]"#;
    let scene = read(text(0.0, rows));
    let material = &scene.objects[0].mesh.materials[0];
    assert_eq!(material.spectrum, [point(532.0, 0.3), point(904.6, 0.7)]);
    assert_eq!(material.rgb, [0.1, 0.2, 0.3]);
    assert_eq!(material.at(1550.0).lambertian, 0.7);

    let rows = r#"[{"nm":905,"reflectance":0.7,"specular_reflectance":0.9}]"#;
    let scene = read(text(0.5, rows));
    let at = scene.objects[0].mesh.materials[0].at(905.0);
    assert_eq!((at.lambertian, at.conductor), (0.7, 0.9));

    // Extras of another type are ignored.
    for extras in ["[[1]]", "\"spectrum\"", "{\"colour\":1}"] {
        let scene = read(file(&format!(r#"{{"extras":{extras}}}"#), ""));
        assert_eq!(scene.objects[0].mesh.materials[0].spectrum, []);
    }
}

#[test]
fn spectra_that_cannot_be_are_refused_by_material() {
    let folder = tempfile::tempdir().expect("a folder");
    for (rows, expected) in [
        ("0.5", "expected [{\"nm\": 905, \"reflectance\": 0.7}, …]"),
        ("[905,0.7]", "expected [{\"nm\": 905"),
        (r#"[{"nm":905}]"#, "missing field `reflectance`"),
        (r#"[{"nm":905,"value":1}]"#, "unknown field `value`"),
        (r#"[{"nm":905,"reflectance":"x"}]"#, "expected f32"),
        (
            r#"[{"nm":905,"reflectance":1.5}]"#,
            "spectrum[0].reflectance = 1.5 lies outside [0, 1]",
        ),
        (
            r#"[{"nm":90,"reflectance":0.5}]"#,
            "spectrum[0].nm = 90 lies outside [200, 20000]",
        ),
        (
            r#"[{"nm":905,"reflectance":0.5},{"nm":532,"reflectance":0.5}]"#,
            "spectrum[1].nm = 532 does not ascend",
        ),
        (
            r#"[{"nm":905,"reflectance":0.5,"specular_reflectance":0.5}]"#,
            "specular_reflectance is of mixed materials alone",
        ),
    ] {
        let material = format!(r#"{{"extras":{{"spectrum":{rows}}}}}"#);
        let error = read_in(folder.path(), file(&material, ""))
            .expect_err(rows)
            .to_string();
        assert!(
            error.contains("scene.gltf: materials[0].extras.spectrum") && error.contains(expected),
            "{error}"
        );
    }
    let glass = r#"{"alphaMode":"BLEND","pbrMetallicRoughness":{"baseColorFactor":[1,1,1,0.25]},
        "extras":{"spectrum":[{"nm":905,"reflectance":0.5}]}}"#;
    let error = read_in(folder.path(), file(glass, ""))
        .expect_err("glass")
        .to_string();
    assert!(
        error.contains("materials[0].extras.spectrum: glass takes none"),
        "{error}"
    );
    let ours = r#"{"pbrMetallicRoughness":{"metallicFactor":0,"roughnessFactor":1},"extras":{"picofarm":{
        "bsdf":{"type":"diffuse","reflectance":0.5},"two_sided":true,"spectrum":[{"nm":905,"reflectance":-1}]}}}"#;
    let error = read_in(folder.path(), file(ours, ""))
        .expect_err("ours")
        .to_string();
    assert!(
        error.contains("materials[0].extras.picofarm.spectrum[0].reflectance = -1"),
        "{error}"
    );
}

#[test]
fn a_spectrum_stated_beside_our_own_extras_counts_and_is_written_with_them() {
    let folder = tempfile::tempdir().expect("a folder");
    for (roughness, stated, expected) in [
        ("1", "", vec![point(905.0, 0.1)]),
        ("0.5", "", vec![]),
        (
            "1",
            r#","spectrum":[{"nm":532,"reflectance":0.6}]"#,
            vec![point(532.0, 0.6)],
        ),
        (
            "0.5",
            r#","spectrum":[{"nm":532,"reflectance":0.6}]"#,
            vec![point(532.0, 0.6)],
        ),
        ("1", r#","spectrum":[]"#, vec![]),
    ] {
        let material = format!(
            r#"{{"pbrMetallicRoughness":{{"metallicFactor":0,"roughnessFactor":{roughness}}},"extras":{{"picofarm":{{
            "bsdf":{{"type":"diffuse","reflectance":0.5}},"two_sided":true,"spectrum":[{{"nm":905,"reflectance":0.1}}]}}{stated}}}}}"#
        );
        let scene = read(file(&material, ""));
        assert_eq!(
            scene.objects[0].mesh.materials[0].spectrum, expected,
            "{roughness} {stated}"
        );
        let path = folder.path().join("ours.glb");
        export::write_glb(&scene, &path).expect("writes");
        let back = import::read_scene(&path).expect("reads");
        assert_eq!(
            back.objects[0].mesh.materials,
            scene.objects[0].mesh.materials
        );
    }
}
