//! Damaged and hostile files of every format: no panic, no scene that fails validation, bounded
//! memory.

use crate::{
    common::{self, gltf::Gltf},
    compressed::{draco, meshopt, with_draco, with_meshopt},
};

use std::{io::Write, path::Path, sync::OnceLock};

use picofarm_scene::{
    Aim, export,
    import::{self, Bounds, ImportOptions},
};
use proptest::{prelude::*, test_runner::TestRunner};
use serde_json::Value as Json;

/// The virtual memory that reading small files may add at its peak, kB.
const MAX_GROWTH_KB: u64 = 3 << 20;

/// A way to damage a file, at a position given as a share of its length.
#[derive(Debug, Clone)]
enum Damage {
    Flip(u8),
    Set(u8),
    Cut,
    Remove(u8),
    Repeat(u8),
    /// Replaces the number at or after the position by another.
    Number(&'static str),
    /// Swaps two parts.
    Swap(f64),
}

const NUMBERS: [&str; 16] = [
    "0",
    "-1",
    "1e39",
    "-1e999",
    "4294967295",
    "4294967296",
    "18446744073709551615",
    "2147483647",
    "1e-45",
    "NaN",
    "999999999",
    "null",
    "0.5",
    "65536",
    "\"x\"",
    "[]",
];

fn damage() -> impl Strategy<Value = (f64, Damage)> {
    let kind = prop_oneof![
        (0u8..8).prop_map(Damage::Flip),
        any::<u8>().prop_map(Damage::Set),
        Just(Damage::Cut),
        any::<u8>().prop_map(Damage::Remove),
        any::<u8>().prop_map(Damage::Repeat),
        proptest::sample::select(&NUMBERS[..]).prop_map(Damage::Number),
        proptest::sample::select(&NUMBERS[..]).prop_map(Damage::Number),
        (0.0..1.0).prop_map(Damage::Swap),
    ];
    (0.0..1.0, kind)
}

fn damaged(whole: &[u8], all: &[(f64, Damage)]) -> Vec<u8> {
    let mut bytes = whole.to_vec();
    for (place, kind) in all {
        if bytes.is_empty() {
            break;
        }
        let at = (place * bytes.len() as f64) as usize;
        match kind {
            Damage::Flip(bit) => bytes[at] ^= 1 << bit,
            Damage::Set(value) => bytes[at] = *value,
            // A cut leaves most of the file, so that other damage still has an effect.
            Damage::Cut => bytes.truncate(bytes.len() - at / 8),
            Damage::Remove(n) => {
                let end = (at + usize::from(*n)).min(bytes.len());
                bytes.drain(at..end);
            }
            Damage::Repeat(n) => {
                let end = (at + usize::from(*n)).min(bytes.len());
                let part = bytes[at..end].to_vec();
                bytes.splice(at..at, part);
            }
            Damage::Number(text) => {
                let digit = |b: &u8| b.is_ascii_digit();
                if let Some(start) = bytes[at..].iter().position(digit) {
                    let start = at + start;
                    let length = bytes[start..].iter().take_while(|b| digit(b)).count();
                    bytes.splice(start..start + length, text.bytes());
                }
            }
            Damage::Swap(other) => {
                let other = (other * bytes.len() as f64) as usize;
                bytes.swap(at, other);
            }
        }
    }
    bytes
}

/// Reads `bytes` as the file `name` among the files of [`folder`]. An accepted scene must be valid.
fn survives(folder: &Path, name: &str, bytes: &[u8]) -> Result<(), TestCaseError> {
    let path = folder.join(name);
    std::fs::write(&path, bytes).expect("writes");
    let options = ImportOptions {
        laser: Aim::grid(4),
        ..ImportOptions::default()
    };
    let _ = import::fingerprint(&path, &Bounds::default());
    if let Ok(scene) = import::read_scene_with(&path, &options, &Bounds::default()) {
        prop_assert!(scene.validate().is_ok());
        for o in &scene.objects {
            prop_assert!(
                o.mesh
                    .positions
                    .iter()
                    .all(|p| o.to_world.point(*p).is_finite())
            );
            prop_assert!(o.mesh.uv.iter().flatten().all(|x| x.is_finite()));
        }
        prop_assert!(scene.laser.beams.iter().all(|b| b.direction.is_finite()));
    }
    if let Err(error) = import::read_scene(&path) {
        prop_assert!(!error.to_string().is_empty());
    }
    Ok(())
}

const DICTIONARY: &str = r#"{"type":"scene","sensor":{"type":"perspective","fov":90,"to_world":[[1,0,0,0],[0,1,0,0],[0,0,1,-3],[0,0,0,1]],
 "film":{"type":"hdrfilm","width":64,"height":64}},"white":{"type":"twosided","inner":{"type":"blendbsdf","weight":0.3,
 "a":{"type":"diffuse","reflectance":{"type":"rgb","value":[0.5,0.6,0.7]}},"b":{"type":"roughconductor","material":"none","alpha":0.1}}},
 "paint":{"type":"diffuse","reflectance":{"type":"spectrum","value":[[450,0.25],[550,0.5],[905,0.75]]}},
 "coat":{"type":"blendbsdf","weight":0.25,"a":{"type":"ref","id":"white"},"b":{"type":"blendbsdf","weight":0.5,"a":{"type":"ref","id":"paint"},"b":{"type":"roughconductor","material":"Al","alpha":0.1}}},
 "wall":{"type":"rectangle","bsdf":{"type":"ref","id":"white"}},"floor":{"type":"cube","bsdf":{"type":"ref","id":"coat"}},"ball":{"type":"sphere","center":[0,0,1],"radius":0.3,"bsdf":{"type":"ref","id":"paint"}},
 "part":{"type":"obj","filename":"part.obj"},"beam":{"type":"projector","fov":0.2}}"#;

const ASCII_PLY: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
    property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n\
    property list uchar int vertex_indices\nend_header\n0 0 0 1 2 3\n1 0 0 1 2 3\n1 1 0 1 2 3\n0 1 0 9 9 9\n\
    3 0 1 2\n4 0 1 2 3\n";

const OBJ: &str = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvn 0 0 1\no a\nusemtl b\nf 1/1/1 2/1/1 3/1/1\nf -3 -2 -1\n";

/// A scene in the words of older and of other programs' Mitsuba files.
const SHAPES: &str = r#"<scene version="0.6.0"><default name="spp" value="4"/><default name="tint" value="0.5"/>
<sensor type="perspective"><float name="fov" value="60"/><string name="fov_axis" value="x"/>
<transform name="toWorld"><lookAt origin="0, 1, -4" target="0, 0, 0" up="0, 1, 0"/><translate x="0.1"/><scale value="1"/><rotate y="1" angle="5"/></transform>
<film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/></film>
<sampler type="independent"><integer name="sampleCount" value="$spp"/></sampler></sensor>
<bsdf type="plastic" id="p"><rgb name="diffuseReflectance" value="$tint, .2, .3"/><float name="intIOR" value="1.5"/></bsdf>
<bsdf type="principled" id="q"><rgb name="base_color" value=".8 .2 .3"/><float name="metallic" value="0.4"/><float name="roughness" value="0.3"/></bsdf>
<bsdf type="mask" id="m"><float name="opacity" value="0.9"/><bsdf type="conductor"><string name="material" value="Au"/></bsdf></bsdf>
<shape type="shapegroup" id="g"><shape type="serialized"><string name="filename" value="shape.serialized"/><integer name="shapeIndex" value="0"/><ref id="p"/></shape></shape>
<shape type="instance"><ref id="g"/><transform name="toWorld"><matrix value="1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1"/></transform></shape>
<shape type="serialized"><string name="filename" value="shape.serialized"/><boolean name="faceNormals" value="true"/><ref id="q"/></shape>
<shape type="cylinder"><point name="p0" x="0" y="0" z="0"/><point name="p1" value="0 1 0"/><float name="radius" value="0.2"/><ref id="m"/></shape>
<shape type="sphere"><point name="center" x="0" y="0" z="1"/><float name="radius" value="0.5"/><emitter type="area"><spectrum name="radiance" value="400:1, 700:2"/></emitter></shape>
<shape type="disk"/><emitter type="constant"/><integrator type="path"/></scene>"#;

const ASCII_STL: &str = "solid corner\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n\
    facet normal 0 1 0\nouter loop\nvertex 0 0 0\nvertex 0 0 1e0\nvertex 1 0 0\nendloop\nendfacet\nendsolid corner\n";

const MESH_OBJ: &str = "mtllib mesh.mtl\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0 1.0\nv 0 0 1\nvt 0 0\nvt 1 0 0\nvt 1 1\n\
    g a b\ns 1\nusemtl red\nf 1/1 2/2 3/3 \\\n4/1\nusemtl tex\nf -5 -4 -1\nusemtl none\nf 1//1 4//1 5//1\nl 1 2\np 1\n";

const MTL: &str = "newmtl red\nKd 0.8 0.1 0.1\nKs .5 .5 .5\nNs 200\nd 0.5\nillum 2\nnewmtl tex\nKd .5 .5 .5\nmap_Kd -s 1 1 1 -o 0 0 0 wood.png\n\
    Pr 0.2\nPm 1\nTr 0.1\nKe 1 1 1\nmap_Bump -bm 0.5 b.png\n";

/// A binary STL of two triangles.
fn binary_stl() -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes.extend(2u32.to_le_bytes());
    for z in [0.0f32, 1.0] {
        let corners = [0.0, 0.0, 1.0, 0.0, 0.0, z, 1.0, 0.0, z, 0.0, 1.0, z];
        bytes.extend(corners.iter().flat_map(|x: &f32| x.to_le_bytes()));
        bytes.extend([0; 2]);
    }
    bytes
}

/// The content of a serialized mesh before compression: a square with normals and texture
/// coordinates.
fn serialized_content() -> Vec<u8> {
    let mut bytes = 0x1003u32.to_le_bytes().to_vec();
    bytes.extend(b"square\0");
    bytes.extend(4u64.to_le_bytes());
    bytes.extend(2u64.to_le_bytes());
    let positions = [0.0f32, 0., 0., 1., 0., 0., 1., 1., 0., 0., 1., 0.];
    let normals = [0.0f32, 0., 1.].repeat(4);
    let uv = [0.0f32, 0., 1., 0., 1., 1., 0., 1.];
    let floats = positions.iter().chain(&normals).chain(&uv);
    bytes.extend(floats.flat_map(|x| x.to_le_bytes()));
    bytes.extend([0u32, 1, 2, 0, 2, 3].iter().flat_map(|i| i.to_le_bytes()));
    bytes
}

/// Returns a serialized file of one mesh with this content.
fn serialized(content: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0x1c, 0x04, 4, 0];
    let mut encoder = flate2::write::ZlibEncoder::new(&mut bytes, flate2::Compression::fast());
    encoder.write_all(content).expect("memory takes it");
    encoder.finish().expect("memory takes it");
    bytes.extend(0u64.to_le_bytes());
    bytes.extend(1u32.to_le_bytes());
    bytes
}

const FILES: [&str; 20] = [
    "room.glb",
    "room.gltf",
    "room.xml",
    "scene.json",
    "mesh.ply",
    "meshes/0000-0.ply",
    "part.obj",
    "shapes.xml",
    "shape.serialized",
    "inside.serialized",
    "mesh.stl",
    "text.stl",
    "mesh.obj",
    "mesh.mtl",
    "packed.gltf",
    "draco.drc",
    "meshopt.vertices",
    "meshopt.triangles",
    "texture.webp",
    "texture.ktx2",
];

/// Returns the file that is written, what is written, and the scene that is read, if a file is read
/// through another one.
fn written(name: &'static str, bytes: Vec<u8>) -> (&'static str, Vec<u8>, Option<&'static str>) {
    match name {
        "meshes/0000-0.ply" => (name, bytes, Some("room.xml")),
        "part.obj" => (name, bytes, Some("scene.json")),
        "shape.serialized" => (name, bytes, Some("shapes.xml")),
        // Damage before compression, which would hide it.
        "inside.serialized" => ("shape.serialized", serialized(&bytes), Some("shapes.xml")),
        "mesh.mtl" => (name, bytes, Some("mesh.obj")),
        // Damage before the text of base64, which would hide it.
        "draco.drc" | "meshopt.vertices" | "meshopt.triangles" | "texture.webp"
        | "texture.ktx2" => ("packed.gltf", packed(name, bytes), None),
        _ => (name, bytes, None),
    }
}

/// A Lambertian and mixes, with textures and spectra. Small, so that damage hits what matters.
fn room() -> picofarm_scene::Scene {
    let mut scene = common::spectral_room();
    scene.objects.truncate(4);
    scene
}

/// Returns a glTF file with this content.
fn packed(name: &str, bytes: Vec<u8>) -> Vec<u8> {
    let mut file = Gltf::new();
    let [vertices, triangles] = meshopt();
    match name {
        "draco.drc" => with_draco(&mut file, &bytes),
        "meshopt.vertices" => with_meshopt(&mut file, &[bytes, triangles]),
        "meshopt.triangles" => with_meshopt(&mut file, &[vertices, bytes]),
        "texture.webp" => file.textured(&bytes, "image/webp"),
        _ => file.textured(&bytes, "image/ktx2"),
    }
    file.bytes()
}

/// Returns a glTF file with Draco's and meshopt's meshes, and sparse places.
fn packed_file() -> Vec<u8> {
    let mut file = Gltf::new();
    with_draco(&mut file, &draco(7));
    let first = file.primitive().clone();
    with_meshopt(&mut file, &meshopt());
    let primitives = file.json["meshes"][1]["primitives"].as_array_mut();
    primitives.expect("a list").push(first);
    file.json["extensionsRequired"] = serde_json::json!([]);
    file.json["accessors"][0]["sparse"] = serde_json::json!({"count": 1,
        "indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 0}});
    file.bytes()
}

/// Returns a WebP image of 3×2 texels.
fn webp() -> Vec<u8> {
    let texels: Vec<u8> = (0..24).map(|k| k * 9).collect();
    let mut bytes = Vec::new();
    let encoder = image_webp::WebPEncoder::new(&mut bytes);
    let kind = image_webp::ColorType::Rgba8;
    encoder.encode(&texels, 3, 2, kind).expect("encodes");
    bytes
}

/// Returns a KTX2 image of 3×2 texels, deflated.
fn ktx2() -> Vec<u8> {
    let mut deflated = Vec::new();
    let mut encoder = flate2::write::ZlibEncoder::new(&mut deflated, flate2::Compression::fast());
    encoder.write_all(&[7; 24]).expect("memory takes it");
    encoder.finish().expect("memory takes it");
    let mut bytes = b"\xabKTX 20\xbb\r\n\x1a\n".to_vec();
    for number in [37u32, 1, 3, 2, 0, 0, 1, 1, 3, 104, 4, 0, 0] {
        bytes.extend(number.to_le_bytes());
    }
    for number in [0u64, 0, 108, deflated.len() as u64, 24] {
        bytes.extend(number.to_le_bytes());
    }
    bytes.extend(4u32.to_le_bytes());
    bytes.extend(deflated);
    bytes
}

/// Returns the undamaged files, in the order of [`FILES`].
fn files() -> &'static [Vec<u8>] {
    static ALL: OnceLock<Vec<Vec<u8>>> = OnceLock::new();
    ALL.get_or_init(|| {
        let scene = room();
        let folder = tempfile::tempdir().expect("a folder");
        export::write_mitsuba(&scene, &folder.path().join("room.xml")).expect("writes");
        let read = |name: &str| std::fs::read(folder.path().join(name)).expect("the file");
        let glb = export::glb_bytes(&scene).expect("valid");
        let length = u32::from_le_bytes([glb[12], glb[13], glb[14], glb[15]]) as usize;
        let json = String::from_utf8(glb[20..20 + length].to_vec()).expect("JSON");
        let uri = common::data_uri(&glb[28 + length..]);
        let gltf = json.replace(
            "\"buffers\":[{",
            &format!("\"buffers\":[{{\"uri\":\"{uri}\","),
        );
        vec![
            glb,
            gltf.into_bytes(),
            read("room.xml"),
            DICTIONARY.into(),
            ASCII_PLY.into(),
            read("meshes/0000-0.ply"),
            OBJ.into(),
            SHAPES.into(),
            serialized(&serialized_content()),
            serialized_content(),
            binary_stl(),
            ASCII_STL.into(),
            MESH_OBJ.into(),
            MTL.into(),
            packed_file(),
            draco(7),
            meshopt()[0].clone(),
            meshopt()[1].clone(),
            webp(),
            ktx2(),
        ]
    })
}

/// Returns a folder with all files that the scenes refer to.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = room();
    export::write_mitsuba(&scene, &folder.path().join("room.xml")).expect("writes");
    let write = |name: &str, bytes: &[u8]| {
        std::fs::write(folder.path().join(name), bytes).expect("writes");
    };
    write("part.obj", OBJ.as_bytes());
    write("shape.serialized", &serialized(&serialized_content()));
    write("mesh.mtl", MTL.as_bytes());
    folder
}

/// Returns a test runner. `PICOFARM_FUZZ` multiplies the number of cases.
fn runner(cases: u32) -> TestRunner {
    let times = std::env::var("PICOFARM_FUZZ").ok();
    let times = times.and_then(|n| n.parse::<u32>().ok()).unwrap_or(1);
    TestRunner::new(ProptestConfig {
        cases: cases * times,
        failure_persistence: None,
        ..ProptestConfig::default()
    })
}

fn count(json: &Json) -> usize {
    1 + match json {
        Json::Array(items) => items.iter().map(count).sum(),
        Json::Object(fields) => fields.values().map(count).sum(),
        _ => 0,
    }
}

/// Replaces the value at a position in depth-first order, or removes it. Counts `place` down to it.
fn edit(json: &mut Json, place: &mut usize, value: Option<&Json>) {
    let mut step = |child: &mut Json| {
        if *place == 0 {
            return true;
        }
        *place -= 1;
        if *place == 0 {
            if let Some(value) = value {
                *child = value.clone();
            }
            return value.is_none();
        }
        edit(child, place, value);
        false
    };
    match json {
        Json::Array(items) => {
            if let Some(k) = items.iter_mut().position(&mut step)
                && k < items.len()
                && value.is_none()
            {
                items.remove(k);
            }
        }
        Json::Object(fields) => {
            let found = fields
                .iter_mut()
                .find_map(|(k, v)| step(v).then(|| k.clone()));
            if let (Some(k), None) = (found, value) {
                fields.remove(&k);
            }
        }
        _ => {}
    }
}

#[test]
fn json_with_values_missing_or_of_other_kinds_never_panics() {
    let shared = folder();
    let values = [
        "null",
        "0",
        "-1",
        "1e30",
        "4294967295",
        "0.5",
        "true",
        "\"\"",
        "\"ggx\"",
        "[]",
        "{}",
        "[0,0,0]",
    ];
    let values: Vec<Option<Json>> = values
        .iter()
        .map(|v| serde_json::from_str(v).ok())
        .chain([None, None, None])
        .collect();
    let edits = proptest::collection::vec((0.0..1.0, 0..values.len()), 1..4);
    let outcome = runner(1500).run(&(any::<bool>(), edits), |(gltf, edits)| {
        let (name, which) = if gltf {
            ("room.gltf", 1)
        } else {
            ("scene.json", 3)
        };
        let mut json: Json = serde_json::from_slice(&files()[which]).expect("JSON");
        for (place, k) in edits {
            let mut place = 1 + (place * (count(&json) - 1) as f64) as usize;
            edit(&mut json, &mut place, values[k].as_ref());
        }
        survives(shared.path(), name, json.to_string().as_bytes())
    });
    if let Err(e) = outcome {
        panic!("{e}");
    }
}

fn peak_kb() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmPeak:"))?;
    line.split_ascii_whitespace().nth(1)?.parse().ok()
}

#[test]
fn the_undamaged_files_are_read() {
    let folder = folder();
    let options = ImportOptions {
        laser: Aim::grid(4),
        ..ImportOptions::default()
    };
    for (name, bytes) in FILES.iter().zip(files()) {
        let (file, bytes, _) = written(name, bytes.clone());
        let path = folder.path().join(file);
        std::fs::write(&path, bytes).expect("writes");
        // Meshes are read through the scenes that name them; one may be edge-on to a framing
        // camera.
        if *name != "part.obj" && written(name, vec![]).2.is_none() {
            import::read_scene_with(&path, &options, &Bounds::default()).expect(name);
        }
    }
}

#[test]
fn damaged_files_never_panic_nor_pass_as_sound_nor_fill_the_memory() {
    let before = peak_kb();
    let shared = folder();
    // `PICOFARM_FUZZ_FILE` damages one file alone.
    let only = std::env::var("PICOFARM_FUZZ_FILE").ok();
    let chosen: Vec<usize> = (0..FILES.len())
        .filter(|k| only.as_deref().is_none_or(|only| only == FILES[*k]))
        .collect();
    assert!(!chosen.is_empty(), "PICOFARM_FUZZ_FILE is one of {FILES:?}");
    let which = proptest::sample::select(chosen);
    let strategy = (which, proptest::collection::vec(damage(), 1..5));
    let mut runner = runner(2500);
    let outcome = runner.run(&strategy, |(which, all)| {
        let bytes = damaged(&files()[which], &all);
        let (name, bytes, scene) = written(FILES[which], bytes);
        let Some(scene) = scene else {
            return survives(shared.path(), name, &bytes);
        };
        std::fs::write(shared.path().join(name), &bytes).expect("writes");
        let whole = |name| {
            let at = FILES.iter().position(|f| *f == name).expect("a file");
            &files()[at]
        };
        let result = survives(shared.path(), scene, whole(scene));
        std::fs::write(shared.path().join(name), whole(name)).expect("writes");
        result
    });
    if let Err(e) = outcome {
        panic!("{e}");
    }
    if let (Some(before), Some(after)) = (before, peak_kb()) {
        let growth = after - before;
        assert!(
            growth < MAX_GROWTH_KB,
            "reading small files took {growth} kB"
        );
    }
}
