//! A laboratory's pipeline: files with a wrong t0 are imported, and a job calibrates them, takes
//! the flash apart and reconstructs the room.

use std::{fs, path::Path};

use futures::executor::block_on;
use picofarm_dataset::{Quantity, SingleRender};
use picofarm_tests::{Cli, Farm};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

const BIN_M: f64 = 0.0384;
/// Photons in the brightest bin of the median pixel.
const PHOTONS: f32 = 400.0;

/// Renders a room, and writes what a laboratory would: counts of each spot, and a description whose
/// t0 is a bin late.
fn measured(cli: &Cli, folder: &Path) {
    let room = "scene generate --kind plato --object armchair --spots 16 --out room.glb";
    let render = "scene render room.glb --out truth --resolution 48 --samples 16 --groups per-spot \
                  --gate-start-m 1 --bins 400 --bin-width-m 0.0384";
    for line in [room, render] {
        cli.run(&line.split_whitespace().collect::<Vec<_>>()).ok();
    }
    let truth = block_on(SingleRender::open(&folder.join("truth"))).unwrap();
    let set = &truth.dataset;
    let sum = block_on(set.read_transient(0)).unwrap();
    let tops = sum
        .chunks(400)
        .map(|h| h.iter().copied().fold(0.0, f32::max));
    let mut tops: Vec<f32> = tops.collect();
    tops.sort_by(f32::total_cmp);
    let scale = PHOTONS / tops[tops.len() / 2];
    let spots = block_on(set.read_spots(0)).unwrap();
    let mut files = Vec::new();
    for k in 0..spots.len() {
        let h = block_on(set.read_spot(0, k as u32)).unwrap();
        let shape = "(48, 48, 400)";
        let mut head = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}");
        while !(10 + head.len() + 1).is_multiple_of(64) {
            head.push(' ');
        }
        head.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((head.len() as u16).to_le_bytes());
        bytes.extend(head.as_bytes());
        bytes.extend(h.iter().flat_map(|x| (x * scale).round().to_le_bytes()));
        files.push(format!("spot_{k}.npy"));
        fs::write(folder.join(&files[k]), bytes).unwrap();
    }
    let i = block_on(set.read_intrinsics(0)).unwrap();
    let laser = block_on(set.read::<f32>(0, Quantity::Laser)).unwrap();
    let places: Vec<[f32; 3]> = spots.iter().map(|s| s.unwrap().position).collect();
    let description = json!({
        "histograms": files,
        "gate": {"start_m": 1.0 + BIN_M, "bin_width_m": BIN_M},
        "camera": {"fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy},
        "laser_m": laser, "spots_m": places,
    });
    fs::write(folder.join("capture.json"), description.to_string()).unwrap();
}

fn json_of(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

#[test]
fn a_job_corrects_t0_then_takes_the_flash_apart_and_reconstructs_and_names_its_source() {
    let farm = Farm::start("calibrated");
    let (store, folder) = (farm.store(), farm.scratch.path());
    let cli = farm.cli();
    measured(&cli, folder);
    let lab = store.join("lab");
    cli.run(&[
        "capture",
        "import",
        "capture.json",
        "--out",
        lab.to_str().unwrap(),
    ])
    .ok();
    let job = format!(
        r#"
name = "laboratory"
[[stage]]
name = "calibrate"
kind = "calibrate"
source = {{ store = {store:?}, dataset = "lab" }}
output = {{ store = {store:?}, dataset = "right" }}
[[stage]]
name = "physics"
kind = "demultiplex"
source = "calibrate"
output = {{ store = {store:?}, dataset = "apart" }}
[[stage]]
name = "3d"
kind = "reconstruct"
source = "calibrate"
reconstruct = {{ from = "predictions", predictions = "physics", grid = {{ nodes = 40, iterations = 5 }} }}
output = {{ store = {store:?}, dataset = "room-3d" }}
"#
    );
    let file = folder.join("job.toml");
    fs::write(&file, job).unwrap();
    let id = farm.json(&["job", "submit", file.to_str().unwrap()]);
    let _worker = farm.worker("worker");
    let ended = farm.until_ended(id["job"].as_str().unwrap());
    assert_eq!(ended["state"], "done", "{ended}");

    let manifest = json_of(&store.join("right/manifests/0.json"));
    let plan = &manifest["provenance"]["plan"];
    assert_eq!(plan["kind"], "calibrate");
    let source = fs::read(lab.join("manifests/0.json")).unwrap();
    let named = hex::encode(Sha256::digest(&source));
    assert_eq!(plan["source"]["manifest_sha256"], named);
    let causes = plan["report"]["causes"].as_array().unwrap();
    assert!(
        causes
            .iter()
            .any(|c| c["fault"] == "time_zero" && c["corrected"] == true),
        "{causes:?}"
    );
    let gate = &json_of(&store.join("right/zarr.json"))["attributes"]["gate"];
    let late = (gate["start_m"].as_f64().unwrap() - 1.0) / BIN_M;
    assert!(late.abs() < 0.15, "{late} bins");
    let metrics = json_of(&store.join("room-3d/scenes/0/metrics.json"));
    assert!(metrics["agreement"].is_object(), "{metrics}");
    // Histograms of each spot stay.
    assert!(store.join("right/transient_spots").is_dir());
}
