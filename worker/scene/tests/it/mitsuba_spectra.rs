//! Spectra in Mitsuba scenes: ours are restored, and those of others are read or refused by
//! element.

use crate::common;

use std::sync::Arc;

use picofarm_scene::{
    Bsdf, Material, Scene, SceneError, SpectrumPoint, export, import::read_scene,
};

fn point(nm: f32, reflectance: f32) -> SpectrumPoint {
    SpectrumPoint {
        nm,
        reflectance,
        specular_reflectance: None,
    }
}

fn read_text(name: &str, text: &str) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(name);
    std::fs::write(&path, text).expect("writes");
    read_scene(&path)
}

/// Reads a wall with a BSDF with the id `m`, in XML.
fn read(bsdf: &str) -> Result<Scene, SceneError> {
    let text = format!(
        r#"<scene version="3.0.0">
    <sensor type="perspective"><float name="fov" value="90"/>
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
    <emitter type="projector"><float name="fov" value="0.1"/><spectrum name="irradiance" value="400:1, 700:3"/>
        <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform></emitter>
    {bsdf}
    <shape type="rectangle"><ref id="m"/></shape>
</scene>"#
    );
    read_text("scene.xml", &text)
}

fn material(bsdf: &str) -> Material {
    read(bsdf).expect("reads").objects[0].mesh.materials[0].clone()
}

fn diffuse(id: &str, reflectance: &str) -> String {
    format!(
        r#"<bsdf type="diffuse"{id}><spectrum name="reflectance" value="{reflectance}"/></bsdf>"#
    )
}

fn conductor(id: &str, reflectance: &str) -> String {
    format!(
        r#"<bsdf type="roughconductor"{id}><string name="material" value="none"/><float name="alpha" value="0.2"/>
        <spectrum name="specular_reflectance" value="{reflectance}"/></bsdf>"#
    )
}

const ID: &str = r#" id="m""#;

fn materials(scene: &Scene) -> Vec<(String, Vec<SpectrumPoint>)> {
    let all = scene.objects.iter().flat_map(|o| &o.mesh.materials);
    all.map(|m| (m.name.clone(), m.spectrum.clone())).collect()
}

#[test]
fn spectra_of_an_exported_scene_come_back_exactly() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    let scene = common::spectral_room();
    let notes = export::write_mitsuba(&scene, &path).expect("writes");
    assert!(
        notes
            .iter()
            .all(|n| n.contains("its spectrum stands in the comment alone")),
        "{notes:?}"
    );
    let back = read_scene(&path).expect("reads");
    assert_eq!(materials(&back), materials(&scene));
    assert_eq!(back.provenance, scene.provenance);
    export::write_mitsuba(&common::textured_room(), &path).expect("writes");
    let text = std::fs::read_to_string(&path).expect("the file");
    assert!(!text.contains("spectrum"));
}

#[test]
fn a_material_of_ours_edited_elsewhere_drops_its_spectrum_with_a_note() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    let mut scene = common::spectral_room();
    scene.objects.truncate(2);
    export::write_mitsuba(&scene, &path).expect("writes");
    let text = std::fs::read_to_string(&path).expect("the file");
    let (from, to) = (
        "name=\"weight\" value=\"0.25\"",
        "name=\"weight\" value=\"0.5\"",
    );
    assert_eq!(text.matches(from).count(), 1);
    std::fs::write(&path, text.replace(from, to)).expect("writes");
    let back = read_scene(&path).expect("reads");
    assert_eq!(back.objects[0].mesh.materials[0].spectrum.len(), 4);
    assert_eq!(back.objects[1].mesh.materials[0].spectrum, []);
    assert!(back.provenance.notes.contains_key("import.spectra.edited"));
}

#[test]
fn spectra_in_our_comment_that_cannot_be_are_refused_by_element() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.xml");
    let mut scene = common::textured_room();
    let mesh = Arc::make_mut(&mut scene.objects[0].mesh);
    mesh.materials[0].spectrum = vec![point(532.0, 0.25), point(905.0, 0.75)];
    export::write_mitsuba(&scene, &path).expect("writes");
    let text = std::fs::read_to_string(&path).expect("the file");
    let edited = text.replace("\"nm\":905.0", "\"nm\":405.0");
    assert_ne!(edited, text);
    std::fs::write(&path, edited).expect("writes");
    let error = read_scene(&path).expect_err("descends").to_string();
    assert!(
        error.contains("scene.xml: line 5, <bsdf")
            && error.contains("comment picofarm: spectrum[1].nm = 405 does not ascend"),
        "{error}"
    );
}

#[test]
fn a_diffuse_and_a_conductor_have_their_spectra_in_every_way_of_writing_them() {
    let rows = [point(450.0, 0.2), point(550.0, 0.4), point(905.0, 0.7)];
    for values in [
        "450:0.2, 550:0.4, 905:0.7",
        "450:0.2 550:0.4 905:0.7",
        " 450:0.2,550:0.4 ,\n  905:7e-1 ",
    ] {
        for (bsdf, two_sided) in [
            (diffuse(ID, values), false),
            (conductor(ID, values), false),
            (
                format!("<bsdf type=\"twosided\"{ID}>{}</bsdf>", diffuse("", values)),
                true,
            ),
            (
                format!(
                    "<bsdf type=\"twosided\"{ID}>{}</bsdf>",
                    conductor("", values)
                ),
                true,
            ),
        ] {
            let m = material(&bsdf);
            assert_eq!(
                (&m.spectrum[..], m.two_sided),
                (&rows[..], two_sided),
                "{bsdf}"
            );
        }
    }
    let at = material(&conductor(ID, "450:0.2, 550:0.4")).at(500.0);
    assert_eq!(at.lambertian, 0.0);
    assert!((at.conductor - 0.3).abs() < 1e-6);
}

#[test]
fn the_colour_of_a_spectrum_is_what_it_has_at_the_primaries() {
    let m = material(&diffuse(ID, "400:0, 700:0.9"));
    let expected = [0.6342, 0.4473, 0.1929];
    for (found, expected) in m.rgb.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-4, "{:?}", m.rgb);
    }
    let Bsdf::Diffuse { reflectance } = m.bsdf else {
        panic!("diffuse");
    };
    assert_eq!(reflectance, (m.rgb[0] + m.rgb[1] + m.rgb[2]) / 3.0);
    let infrared = material(&diffuse(ID, "850:0.25, 905:0.75"));
    assert_eq!(infrared.rgb, [0.25; 3]);
}

#[test]
fn spectra_without_wavelengths_are_grey_as_ever() {
    let m = material(&diffuse(ID, "0.5"));
    assert_eq!((m.rgb, m.spectrum), ([0.5; 3], vec![]));
}

fn blend(a: &str, b: &str) -> String {
    format!(r#"<bsdf type="blendbsdf"{ID}><float name="weight" value="0.25"/>{a}{b}</bsdf>"#)
}

#[test]
fn a_blend_has_rows_at_the_wavelengths_of_both_parts() {
    let row = |nm, reflectance, specular| SpectrumPoint {
        specular_reflectance: Some(specular),
        ..point(nm, reflectance)
    };
    let (a, b) = (
        diffuse("", "400:0, 600:0.5, 800:1"),
        conductor("", "500:1, 600:0.5"),
    );
    let expected = [
        row(400.0, 0.0, 1.0),
        row(500.0, 0.25, 1.0),
        row(600.0, 0.5, 0.5),
        row(800.0, 1.0, 0.5),
    ];
    for (bsdf, weight) in [(blend(&a, &b), 0.25), (blend(&b, &a), 0.75)] {
        let m = material(&bsdf);
        assert_eq!(m.spectrum, expected);
        assert!(matches!(m.bsdf, Bsdf::Mixed { weight: w, .. } if w == weight));
    }
}

#[test]
fn a_part_of_a_blend_without_a_spectrum_reflects_its_mean_at_every_wavelength() {
    let rgb = |part: String, colour: &str| {
        let start = part.find("<spectrum").expect("a spectrum");
        let name = if part.contains("specular") {
            "specular_reflectance"
        } else {
            "reflectance"
        };
        format!(
            r#"{}<rgb name="{name}" value="{colour}"/></bsdf>"#,
            &part[..start]
        )
    };
    let grey = blend(&diffuse("", "500:0.5"), &rgb(conductor("", ""), "0.75"));
    let scene = read(&grey).expect("reads");
    let m = &scene.objects[0].mesh.materials[0];
    assert_eq!(m.spectrum, [point(500.0, 0.5)]);
    assert_eq!((m.at(905.0).lambertian, m.at(905.0).conductor), (0.5, 0.75));
    assert!(!scene.provenance.notes.contains_key("import.spectra"));
    let coloured = blend(
        &rgb(diffuse("", ""), "0.75 0.5 0.25"),
        &conductor("", "500:1"),
    );
    let scene = read(&coloured).expect("reads");
    let m = &scene.objects[0].mesh.materials[0];
    assert_eq!((m.at(460.0).lambertian, m.at(460.0).conductor), (0.5, 1.0));
    assert!(scene.provenance.notes.contains_key("import.spectra"));
}

#[test]
fn spectra_that_cannot_be_are_refused_by_element() {
    let gold = conductor(ID, "500:0.5").replace("none", "Au");
    let glass = format!(
        r#"<bsdf type="thindielectric"{ID}><spectrum name="specular_transmittance" value="500:1"/></bsdf>"#
    );
    let rgb = diffuse(ID, "500:1").replace("spectrum", "rgb");
    for (bsdf, expected) in [
        (
            diffuse(ID, "550:0.4, 450:0.2"),
            "line 7, <bsdf type=\"diffuse\">: reflectance: spectrum[1].nm = 450 does not ascend",
        ),
        (
            diffuse(ID, "450:0.4, 450:0.2"),
            "spectrum[1].nm = 450 does not ascend",
        ),
        (
            conductor(ID, "450:1.5"),
            "specular_reflectance: spectrum[0].reflectance = 1.5 lies outside [0, 1]",
        ),
        (diffuse(ID, "450:-0.5"), "lies outside [0, 1]"),
        (diffuse(ID, "10:0.5"), "spectrum[0].nm = 10 lies outside"),
        (
            diffuse(ID, "450:x"),
            "line 7, <spectrum>: expected a finite number, found \"x\"",
        ),
        (diffuse(ID, "450:nan"), "found \"nan\""),
        (diffuse(ID, "inf:0.5"), "found \"inf\""),
        (diffuse(ID, "450:"), "expected a finite number"),
        (
            diffuse(ID, "450:0.5, 0.7"),
            "expected wavelength:value, found \"0.7\"",
        ),
        (diffuse(ID, "450:0.5:0.7"), "found \"0.5:0.7\""),
        (diffuse(ID, ":"), "expected a finite number"),
        (rgb, "<rgb>: expected 1 or 3 numbers"),
        (gold, "a spectrum needs material \"none\""),
        (
            glass,
            "specular_transmittance: spectra on glass are not supported",
        ),
        (
            blend(&diffuse("", "450:0.5"), &conductor("", "450:2")),
            "<bsdf type=\"roughconductor\">: specular_reflectance",
        ),
    ] {
        let error = read(&bsdf).expect_err(expected).to_string();
        assert!(
            error.contains("scene.xml: line ") && error.contains(expected),
            "{error}"
        );
    }
}

#[test]
fn the_dictionary_states_spectra_as_pairs() {
    let text = |value: &str| {
        format!(
            r#"{{"type": "scene", "sensor": {{"type": "perspective", "fov": 90}}, "beam": {{"type": "projector", "fov": 0.1}},
            "wall": {{"type": "rectangle", "bsdf": {{"type": "diffuse", "reflectance": {{"type": "spectrum", "value": {value}}}}}}}}}"#
        )
    };
    let of = |value: &str| read_text("scene.json", &text(value));
    let scene = of("[[450, 0.2], [905, 0.7]]").expect("reads");
    let m = &scene.objects[0].mesh.materials[0];
    assert_eq!(m.spectrum, [point(450.0, 0.2), point(905.0, 0.7)]);
    let constant = of("0.5").expect("reads");
    assert_eq!(constant.objects[0].mesh.materials[0].rgb, [0.5; 3]);
    for (value, expected) in [
        (
            "[[450, 0.2], [905]]",
            "scene.wall.bsdf.reflectance: expected pairs",
        ),
        ("[[450, 0.2], 905]", "expected pairs"),
        ("[[450, \"x\"]]", "expected pairs"),
        ("[[450, 0.2], [400, 0.2]]", "does not ascend"),
    ] {
        let error = of(value).expect_err(expected).to_string();
        assert!(
            error.contains("scene.json") && error.contains(expected),
            "{error}"
        );
    }
}
