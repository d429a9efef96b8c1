//! Two-bounce times and masks from foreign measurements: imported and reconstructed.

use std::{fs, path::Path};

use futures::executor::block_on;
use picofarm_dataset::{Dataset, Quantity};
use picofarm_store::open_store;
use picofarm_tests::Farm;
use serde_json::json;

const SIDE: usize = 48;

/// Returns a `.npy` file of 32-bit floats.
fn npy(shape: &[usize], values: &[f32]) -> Vec<u8> {
    let shape = shape.iter().map(|n| format!("{n},")).collect::<String>();
    let head = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({shape}), }}");
    let padded = format!(
        "{head:<width$}\n",
        width = (head.len() + 11).next_multiple_of(64) - 11
    );
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((padded.len() as u16).to_le_bytes());
    bytes.extend(padded.bytes());
    bytes.extend(values.iter().flat_map(|x| x.to_le_bytes()));
    bytes
}

fn length(a: [f32; 3]) -> f32 {
    a.iter().map(|x| x * x).sum::<f32>().sqrt()
}

/// Writes the first scene of `rooms` as files, with two-bounce paths as an instrument would measure
/// them, and without depth.
fn measured(store: &Path, folder: &Path) {
    let (at, prefix) = open_store(store.to_str().unwrap()).unwrap();
    let read = async {
        let rooms = Dataset::open(at, prefix.join("rooms")).await.unwrap();
        (
            rooms.read_transient(0).await.unwrap(),
            rooms.read::<f32>(0, Quantity::Depth).await.unwrap(),
            rooms.read_spots(0).await.unwrap(),
            rooms.read_visibility(0).await.unwrap(),
            rooms.read_intrinsics(0).await.unwrap(),
            rooms.spec().gate,
        )
    };
    let (histogram, depth, spots, lit, i, gate) = block_on(read);
    let mut paths = Vec::new();
    for (spot, lit) in spots.iter().zip(lit.chunks_exact(SIDE * SIDE)) {
        let spot = spot.unwrap();
        for (pixel, lit) in lit.iter().enumerate() {
            let (u, v) = ((pixel % SIDE) as f32 + 0.5, (pixel / SIDE) as f32 + 0.5);
            let z = depth[pixel];
            let x = [(u - i.cx) / i.fx * z, (v - i.cy) / i.fy * z, z];
            let away = [0, 1, 2].map(|k| x[k] - spot.position[k]);
            let path = spot.path_m + length(away) + length(x);
            paths.push(if *lit == 1 && z > 0.0 { path } else { 0.0 });
        }
    }
    let places: Vec<f32> = spots.iter().flat_map(|s| s.unwrap().position).collect();
    let lengths: Vec<f32> = spots.iter().map(|s| s.unwrap().path_m).collect();
    let masks: Vec<f32> = lit.iter().map(|l| f32::from(*l)).collect();
    let n = spots.len();
    fs::create_dir_all(folder).unwrap();
    let put = |name: &str, shape: &[usize], values: &[f32]| {
        fs::write(folder.join(name), npy(shape, values)).unwrap();
    };
    put("h.npy", &[SIDE, SIDE, gate.bins as usize], &histogram);
    put("spots.npy", &[n, 3], &places);
    put("beams.npy", &[n], &lengths);
    put("lit.npy", &[n, SIDE, SIDE], &masks);
    put("paths.npy", &[n, SIDE, SIDE], &paths);
    let about = json!({
        "format": "picofarm-scene-1",
        "length_unit": "m",
        "histogram": {"file": "h.npy", "axes": ["row", "column", "bin"],
                      "gate_start": gate.start_m, "bin_width": gate.bin_width_m, "gate_unit": "length"},
        "camera": {"fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy, "pixel_centre": 0.5, "axes": ["right", "down", "forward"]},
        "laser": [0.0, 0.0, 0.0],
        "spots": {"file": "spots.npy", "paths": "beams.npy"},
        "visibility": {"file": "lit.npy", "one_means": "lit"},
        "two_bounce": {"file": "paths.npy"},
    });
    fs::write(folder.join("scene.json"), about.to_string()).unwrap();
}

fn submit(farm: &Farm, stages: &[String]) -> String {
    let file = farm.store().with_file_name("job.toml");
    fs::write(&file, format!("name = \"rooms\"\n{}", stages.concat())).unwrap();
    let answer = farm.json(&["job", "submit", file.to_str().unwrap()]);
    answer["job"].as_str().unwrap().to_owned()
}

/// Returns the number of vertices of a mesh, and their mean distance from the camera.
fn vertices(farm: &Farm, folder: &str, from: [f32; 3]) -> (usize, f32) {
    let ply = fs::read(farm.store().join(folder).join("scenes/0/mesh.ply")).unwrap();
    let end = ply.windows(11).position(|w| w == b"end_header\n").unwrap();
    let head = String::from_utf8_lossy(&ply[..end]).into_owned();
    let count = head.lines().find_map(|l| l.strip_prefix("element vertex "));
    let count: usize = count.unwrap().parse().unwrap();
    let number = |b: &[u8]| f32::from_le_bytes(b.try_into().unwrap());
    let far = ply[end + 11..]
        .chunks_exact(12)
        .take(count)
        .map(|v| length([0, 1, 2].map(|k| number(&v[k * 4..][..4]) - from[k])));
    (count, far.sum::<f32>() / count as f32)
}

#[test]
fn a_room_from_given_times_and_masks_is_that_of_the_depth_that_they_come_from() {
    let farm = Farm::start("given-times");
    let store = farm.store();
    let place = |name: &str| store.join(name).to_str().unwrap().to_owned();
    let room = farm.store().with_file_name("chair.glb");
    let made = [
        "scene",
        "generate",
        "--kind",
        "plato",
        "--out",
        room.to_str().unwrap(),
    ];
    farm.run(&made).code(0);
    let reconstruct = |name: &str, source: &str, from: &str| {
        format!(
            r#"
[[stage]]
name = "{name}"
kind = "reconstruct"
source = {source}
reconstruct = {{ from = "{from}", views = 0, grid = {{ nodes = 64, iterations = 20 }} }}
output = {{ store = {store:?}, dataset = "{name}" }}
"#
        )
    };
    let rooms = format!(
        r#"
[[stage]]
name = "rooms"
scenes = {{ kind = "files", files = [{room:?}], spots = 16 }}
render = {{ resolution = {SIDE}, samples = 2, bins = 391, bin_width_m = 0.0384 }}
output = {{ store = {store:?}, dataset = "rooms" }}
"#
    );
    let _worker = farm.worker("worker");
    let id = submit(
        &farm,
        &[rooms, reconstruct("truth-3d", "\"rooms\"", "truth")],
    );
    assert_eq!(farm.until_ended(&id)["state"], "done");
    let files = farm.store().with_file_name("files");
    measured(&store, &files);
    let imported = farm.json(&[
        "dataset",
        "import",
        files.to_str().unwrap(),
        &place("given"),
    ]);
    assert_eq!(imported["imported"], 1, "{imported}");

    let by_name = |name: &str| format!("{{ store = {store:?}, dataset = {name:?} }}");
    let id = submit(
        &farm,
        &[reconstruct("given-3d", &by_name("given"), "given")],
    );
    assert_eq!(farm.until_ended(&id)["state"], "done");
    // The import has no pose, so its mesh is in the camera's coordinates.
    let (few, near) = vertices(&farm, "given-3d", [0.0; 3]);
    let (many, far) = vertices(&farm, "truth-3d", [0.0; 3]);
    assert!(few.abs_diff(many) * 20 < many, "{few} and {many} vertices");
    assert!((near - far).abs() < 0.02, "{near} and {far} m");

    let id = submit(&farm, &[reconstruct("none-3d", &by_name("rooms"), "given")]);
    assert_eq!(farm.until_ended(&id)["state"], "failed");
    let failed = farm.json(&["job", "explain", &id]).to_string();
    assert!(failed.contains("has no two-bounce paths"), "{failed}");
}
