//! Damaged and hostile files of every format: no panic, no scene that fails validation, bounded
//! memory.

use crate::common;

use std::{path::Path, sync::OnceLock};

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

const FILES: [&str; 7] = [
    "room.glb",
    "room.gltf",
    "room.xml",
    "scene.json",
    "mesh.ply",
    "meshes/0000-0.ply",
    "part.obj",
];

/// A Lambertian and mixes, with textures and spectra. Small, so that damage hits what matters.
fn room() -> picofarm_scene::Scene {
    let mut scene = common::spectral_room();
    scene.objects.truncate(4);
    scene
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
        ]
    })
}

/// Returns a folder with all files that the scenes refer to.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = room();
    export::write_mitsuba(&scene, &folder.path().join("room.xml")).expect("writes");
    std::fs::write(folder.path().join("part.obj"), OBJ).expect("writes");
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
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).expect("writes");
        // Meshes are read through the scenes that name them; one may be edge-on to a framing
        // camera.
        if !name.ends_with(".obj") && !name.starts_with("meshes/") {
            import::read_scene_with(&path, &options, &Bounds::default()).expect(name);
        }
    }
}

#[test]
fn damaged_files_never_panic_nor_pass_as_sound_nor_fill_the_memory() {
    let before = peak_kb();
    let shared = folder();
    let strategy = (0..FILES.len(), proptest::collection::vec(damage(), 1..5));
    let mut runner = runner(1500);
    let outcome = runner.run(&strategy, |(which, all)| {
        let bytes = damaged(&files()[which], &all);
        let name = FILES[which];
        // Meshes are read through the scenes that name them.
        let (scene, as_scene) = match name {
            "meshes/0000-0.ply" => ("room.xml", 2),
            "part.obj" => ("scene.json", 3),
            _ => return survives(shared.path(), name, &bytes),
        };
        std::fs::write(shared.path().join(name), &bytes).expect("writes");
        let result = survives(shared.path(), scene, &files()[as_scene]);
        std::fs::write(shared.path().join(name), &files()[which]).expect("writes");
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
