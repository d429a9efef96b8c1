//! Tests of importing single-spot captures: PlatoNeRF's, and bounce-flash lidar's in MATLAB files.

use crate::common;

use std::path::Path;
use std::process::Command;

use crate::files::mat::{matrix, version_5};
use crate::files::npy::npy;
use common::*;
use picofarm_dataset::*;
use picofarm_exchange::import::*;
use serde_json::{Value, json};

const SIDE: usize = 32;
const BINS: usize = 120;
/// Directions of laser beams, x right, y down, z forward; they hit the wall z = 2.
const BEAMS: [[f64; 2]; 3] = [[0.3, -0.2], [-0.5, 0.1], [0.05, 0.6]];

fn norm(a: [f64; 3]) -> f64 {
    a.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Returns the histogram of a wall at z = 2 seen at 90°, lit by one beam.
fn wall(beam: [f64; 2]) -> Vec<u16> {
    let spot = [beam[0] * 2.0, beam[1] * 2.0, 2.0];
    let mut h = vec![0u16; SIDE * SIDE * BINS];
    let half = SIDE as f64 / 2.0;
    let centre = |at: usize| (at as f64 + 0.5 - half) / half;
    for (pixel, h) in h.chunks_exact_mut(BINS).enumerate() {
        let x = [2.0 * centre(pixel % SIDE), 2.0 * centre(pixel / SIDE), 2.0];
        let between = [x[0] - spot[0], x[1] - spot[1], 0.0];
        let path = norm(spot) + norm(between) + norm(x);
        let bright = if norm(between) < 0.09 { 40.0 } else { 0.25 };
        if let Some(bin) = h.get_mut((path / 0.1) as usize) {
            *bin = half::f16::from_f32(bright).to_bits();
        }
    }
    h
}

/// Writes three captures in PlatoNeRF's layout.
fn platonerf(folder: &Path) -> Value {
    std::fs::create_dir_all(folder.join("train")).unwrap();
    let frames: Vec<Value> = BEAMS
        .iter()
        .enumerate()
        .map(|(i, beam)| {
            let file = folder.join(format!("train/{i:03}.npy"));
            std::fs::write(file, npy("<f2", &[SIDE, SIDE, BINS], &wall(*beam))).unwrap();
            json!({
                "file_path": format!("./train/{i:03}"),
                "transform_matrix": [[-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
                "light_origin": [0.0, 0.0, 0.0],
                // The laser's target relative to the laser, x right, y up, z backward; not a unit
                // vector.
                "light_direction": [beam[0] * 3.0, -beam[1] * 3.0, -3.0],
                "wall_idx_cam": 0, "wall_idx_light": 0,
            })
        })
        .collect();
    json!({
        "camera_angle_x": 90.0, "frames": frames,
        "walls": [{"plane": [0.0, 0.0, 1.0], "point": [0.0, 0.0, -2.0], "x": 0.0, "y_min": -2, "y_max": 2, "z_min": -3, "z_max": 0}],
    })
}

fn gate() -> ImportOptions {
    ImportOptions {
        bin_width_m: Some(0.1),
        ..ImportOptions::default()
    }
}

fn open(folder: &Path, options: ImportOptions) -> Result<Source, ImportError> {
    Source::open(folder, None, options, None)
}

async fn published(source: &Source, index: u64, profile: Profile) -> Dataset {
    let (store, _) = in_memory(&spec(Profile::LOSSLESS)).await;
    let spec = source.spec(profile);
    let dataset = Dataset::create_or_open(store, "sets/b".into(), &spec)
        .await
        .unwrap();
    let scene = import_scene(source, index).unwrap();
    println!("{:#?}\n{:#}", scene.conversions, scene.check);
    let encoded = source.encode(&dataset, index, &scene).unwrap();
    dataset.publish_encoded(encoded).await.unwrap();
    dataset
}

fn as_f32(h: &[u16]) -> Vec<f32> {
    h.iter()
        .map(|h| half::f16::from_bits(*h).to_f32())
        .collect()
}

#[tokio::test]
async fn platonerfs_captures_become_scenes_of_one_spot_or_one_scene_of_all() {
    let folder = tempfile::tempdir().unwrap();
    let chair = folder.path().join("chair");
    let transforms = platonerf(&chair);
    std::fs::write(chair.join("transforms_train.json"), transforms.to_string()).unwrap();
    let source = open(folder.path(), gate()).unwrap();
    assert_eq!((source.format(), source.scenes()), (Format::Platonerf, 3));
    assert_eq!(source.name(1), Some("chair/001"));
    let dataset = published(&source, 1, Profile::LOSSLESS).await;
    assert_eq!(
        dataset.read_transient(1).await.unwrap(),
        as_f32(&wall(BEAMS[1]))
    );
    let spot = dataset.read_spots(1).await.unwrap()[0].unwrap();
    let expected = [BEAMS[1][0] * 2.0, BEAMS[1][1] * 2.0, 2.0];
    for (found, expected) in spot.position.iter().zip(expected) {
        assert!((f64::from(*found) - expected).abs() < 0.06, "{spot:?}");
    }
    let camera = dataset.read::<f32>(1, Quantity::Camera).await.unwrap();
    assert_eq!(
        camera[..12],
        [1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0]
    );
    assert_eq!(
        dataset.read_intrinsics(1).await.unwrap().fx,
        SIDE as f32 / 2.0
    );

    let sum = ImportOptions {
        captures: Captures::Sum,
        ..gate()
    };
    let source = open(folder.path(), sum).unwrap();
    assert_eq!((source.scenes(), source.name(0)), (1, Some("chair")));
    let dataset = published(&source, 0, Profile::LOSSLESS).await;
    let mut expected = vec![0.0f32; SIDE * SIDE * BINS];
    for beam in BEAMS {
        expected
            .iter_mut()
            .zip(as_f32(&wall(beam)))
            .for_each(|(s, h)| *s += h);
    }
    assert_eq!(dataset.read_transient(0).await.unwrap(), expected);
    assert_eq!(dataset.read_spots(0).await.unwrap().len(), 3);
}

#[test]
fn platonerfs_axes_angles_and_gate_are_checked_by_light_of_one_bounce() {
    let folder = tempfile::tempdir().unwrap();
    let plain = platonerf(folder.path());
    let refused = |change: &dyn Fn(&mut Value), options: ImportOptions, parts: &[&str]| {
        let mut other = plain.clone();
        change(&mut other);
        std::fs::write(
            folder.path().join("transforms_train.json"),
            other.to_string(),
        )
        .unwrap();
        let error = open(folder.path(), options)
            .and_then(|s| import_scene(&s, 0))
            .unwrap_err()
            .to_string();
        println!("{error}");
        for part in parts {
            assert!(error.contains(part), "{error}");
        }
    };
    refused(
        &|t| t["camera_angle_x"] = json!(1.05),
        gate(),
        &["camera_angle_x", "radians", "--fov-deg"],
    );
    refused(
        &|t| t["camera_angle_x"] = json!(60),
        gate(),
        &["000.npy: brightest pixel"],
    );
    let up = |t: &mut Value| t["frames"][0]["light_direction"][1] = json!(-0.6);
    refused(&up, gate(), &["brightest pixel"]);
    refused(
        &|_| {},
        ImportOptions::default(),
        &["brightest bin", "--bin-width-m"],
    );
    let mirrored = |t: &mut Value| t["frames"][0]["transform_matrix"][0][0] = json!(1.0);
    refused(&mirrored, gate(), &["transform_matrix", "rotation"]);
    refused(
        &|t| t["frames"] = json!([]),
        gate(),
        &["transforms_train.json: frames"],
    );
}

/// Writes a scan of 8×6 pixels of a wall at z = 2, and counts with the spot at pixel
/// (row 2, column 5) from the top left.
fn collection(folder: &Path) -> Vec<f64> {
    let (columns, rows, bins) = (8usize, 6usize, 700usize);
    let (mut theta, mut phi) = (Vec::new(), Vec::new());
    for p in 0..columns * rows {
        // From the left (x large) and from the bottom.
        let x = 0.35 - 0.1 * (p % columns) as f64;
        let y = -0.25 + 0.1 * (p / columns) as f64;
        theta.push((x / norm([x, y, 1.0])).acos());
        phi.push(y.atan2(1.0));
    }
    let pixels = columns * rows;
    let mut counts = vec![0.0; pixels * bins];
    for p in 0..pixels {
        counts[(600 + p % 5) * pixels + p] = 7.0;
    }
    let brightest = (rows - 1 - 2) * columns + 5;
    counts[650 * pixels + brightest] = 200.0;
    let scan = [
        matrix("num_u", [1, 1], &[columns as f64]),
        matrix("num_v", [1, 1], &[rows as f64]),
        matrix("thetaMap", [pixels as i32, 1], &theta),
        matrix("phiMap", [pixels as i32, 1], &phi),
    ];
    std::fs::write(folder.join("detector_scan_8x6.mat"), version_5(&scan)).unwrap();
    let cube = [
        matrix("abc", [1, 1], &[0.5]),
        matrix("dataCube", [pixels as i32, bins as i32], &counts),
    ];
    std::fs::write(folder.join("spot_1.mat"), version_5(&cube)).unwrap();
    counts
}

/// The t0 for which bin 651 of the made-up counts is a path of 1.5 m.
const T0: f64 = 651.0 * 8e-12 - 1.5 / 299_792_458.0;

fn lidar(t0_s: f64) -> ImportOptions {
    ImportOptions {
        t0_s: Some(t0_s),
        laser_m: Some([0.257, 0.0, 0.0]),
        gate_start_m: Some(0.9),
        bins: Some(300),
        ..ImportOptions::default()
    }
}

#[tokio::test]
async fn matlab_captures_are_put_upright_and_their_spot_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let counts = collection(folder.path());
    // Bin 650 is bin 651 when counted from 1: a path of 1.5 m in total.
    let (width, c) = (8e-12, 299_792_458.0);
    let t0 = T0;
    let source = open(folder.path(), lidar(t0)).unwrap();
    assert_eq!(
        (source.format(), source.name(0)),
        (Format::BfLidar, Some("./spot_1"))
    );
    let dataset = published(&source, 0, Profile::CountsU16).await;
    let gate = dataset.spec().gate;
    let first = ((gate.start_m / c + t0) / width - 0.5).round() as usize;
    assert!((gate.start_m - 0.9).abs() <= 0.5 * c * width);
    let h = dataset.read_transient(0).await.unwrap();
    for row in 0..6 {
        for column in 0..8 {
            let there = (5 - row) * 8 + column;
            for bin in 0..300 {
                let expected = counts[(first + bin) * 48 + there] as f32;
                assert_eq!(
                    h[(row * 8 + column) * 300 + bin],
                    expected,
                    "{row} {column} {bin}"
                );
            }
        }
    }
    let i = dataset.read_intrinsics(0).await.unwrap();
    assert!(
        (i.fx - 10.0).abs() < 1e-4 && (i.fy - 10.0).abs() < 1e-4,
        "{i:?}"
    );
    assert!(
        (i.cx - 4.0).abs() < 1e-4 && (i.cy - 3.0).abs() < 1e-4,
        "{i:?}"
    );
    let spot = dataset.read_spots(0).await.unwrap()[0].unwrap();
    let position = spot.position.map(f64::from);
    // In the direction of its pixel, and 1.5 m there and back.
    assert!((position[0] / position[2] - 0.15).abs() < 1e-5, "{spot:?}");
    assert!((position[1] / position[2] + 0.05).abs() < 1e-5, "{spot:?}");
    assert!(
        (norm(position) + f64::from(spot.path_m) - 1.5).abs() < 1e-3,
        "{spot:?}"
    );
    let laser = dataset.read::<f32>(0, Quantity::Laser).await.unwrap();
    assert_eq!(laser, [-0.257, 0.0, 0.0]);
    // A code rounds counts, but the manifest states what they are.
    let coded = published(&source, 0, Profile::parse("sqrt-u16").unwrap()).await;
    let manifest = coded.manifest(0).await.unwrap();
    let value = manifest.provenance.plan["value"].as_str().unwrap();
    assert!(value.starts_with("counts"), "{value}");
}

#[test]
fn matlab_captures_that_do_not_fit_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    collection(folder.path());
    let refused = |options: ImportOptions, parts: &[&str]| {
        let error = open(folder.path(), options)
            .and_then(|s| import_scene(&s, 0))
            .unwrap_err()
            .to_string();
        println!("{error}");
        for part in parts {
            assert!(error.contains(part), "{error}");
        }
    };
    refused(ImportOptions::default(), &["spot_1.mat: t0", "--t0-s"]);
    let no_laser = ImportOptions {
        laser_m: None,
        ..lidar(T0)
    };
    refused(no_laser, &["laser", "--laser-m"]);
    refused(
        lidar(14.2428e-9),
        &["spot_1.mat: dataCube", "300 bins from 0.9 m"],
    );
    let scan = folder.path().join("detector_scan_8x6.mat");
    let whole = std::fs::read(&scan).unwrap();
    std::fs::write(&scan, &whole[..whole.len() - 40]).unwrap();
    refused(lidar(T0), &["detector_scan_8x6.mat", "cut off"]);
    std::fs::write(&scan, b"no MATLAB").unwrap();
    refused(lidar(T0), &["detector_scan_8x6.mat", "scipy.io.savemat"]);
    std::fs::write(&scan, version_5(&[matrix("num_u", [1, 1], &[8.0])])).unwrap();
    refused(lidar(T0), &["a numeric array num_v", "num_u"]);
}

#[tokio::test]
async fn files_of_scipy_and_h5py_are_read() {
    let python = std::env::var_os("PICOFARM_PYTHON");
    let ready = python.as_ref().is_some_and(|python| {
        let probe = Command::new(python)
            .args(["-c", "import h5py, numpy, scipy.io"])
            .output();
        probe.is_ok_and(|o| o.status.success())
    });
    let Some(python) = python.filter(|_| ready) else {
        println!(
            "skipped: set PICOFARM_PYTHON to a Python with numpy, scipy and h5py to run this test"
        );
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let collection = folder.path().join("collection");
    std::fs::create_dir(&collection).unwrap();
    let script = Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap())
        .join("../../tests/interop/make_mat.py");
    let output = Command::new(&python)
        .arg(script)
        .arg(&collection)
        .args(["20", "16", "5000", "14.2428e-9"])
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let options = ImportOptions {
        t0_s: Some(14.2428e-9),
        laser_m: Some([0.257, 0.0, 0.0]),
        ..ImportOptions::default()
    };
    let source = open(&collection, options.clone()).unwrap();
    assert_eq!(source.scenes(), 2);
    let dataset = published(&source, 0, Profile::CountsU16).await;
    let (gate, c, width) = (dataset.spec().gate, 299_792_458.0, 8e-12);
    assert_eq!(gate.bins, 1502);
    let first = ((gate.start_m / c + 14.2428e-9) / width - 0.5).round() as usize;
    let h = dataset.read_transient(0).await.unwrap();
    let raw = std::fs::read(folder.path().join("expected.npy")).unwrap();
    let expected: Vec<f32> = bytemuck::pod_collect_to_vec(&raw[raw.len() - 320 * 5000 * 4..]);
    for (found, expected) in h.chunks_exact(1502).zip(expected.chunks_exact(5000)) {
        assert_eq!(found, &expected[first..first + 1502]);
    }
    // x = 0.1 to the left, y = −0.1 up.
    let spot = dataset.read_spots(0).await.unwrap()[0].unwrap();
    for (found, expected) in spot.position.iter().zip([-0.1, 0.1, 2.0]) {
        assert!((found - expected).abs() < 0.06, "{spot:?}");
    }
    let sum = ImportOptions {
        captures: Captures::Sum,
        ..options.clone()
    };
    let source = open(&collection, sum).unwrap();
    assert_eq!(
        (source.scenes(), source.spec(Profile::CountsU16).spots),
        (1, 2)
    );
    assert_eq!(import_scene(&source, 0).unwrap().files.len(), 3);

    // A file of a few KiB that announces 2^60 counts.
    let code = "import h5py, sys\n\
                with h5py.File(sys.argv[1], 'w') as f:\n    \
                f.create_dataset('dataCube', (1 << 50, 320), chunks=(64, 320), compression='gzip', dtype='f8')";
    let path = collection.join("spot_1.mat");
    let written = Command::new(&python).args(["-c", code]).arg(&path).status();
    assert!(written.unwrap().success());
    assert!(path.metadata().unwrap().len() < 1 << 16);
    let bins = Some(1 << 20);
    let source = open(&collection, ImportOptions { bins, ..options }).unwrap();
    let error = import_scene(&source, 0).unwrap_err().to_string();
    assert!(
        error.contains("spot_1.mat") && error.contains("announces"),
        "{error}"
    );
}
