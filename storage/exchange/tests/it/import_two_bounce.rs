//! Tests of two-bounce times and detections next to bounce-flash lidar's captures, or next to the
//! arrays of our own layout.

use crate::common;

use std::path::Path;

use crate::files::mat::{matrix, version_5};
use crate::files::npy::npy;
use crate::files::room::Room;
use common::*;
use picofarm_dataset::*;
use picofarm_exchange::import::*;
use serde_json::{Value, json};

const C: f64 = 299_792_458.0;
const COLUMNS: usize = 8;
const ROWS: usize = 6;
const PIXELS: usize = COLUMNS * ROWS;
/// The laser's position: x left, y up, z forward.
const LASER: [f64; 3] = [0.257, 0.0, 0.0];
/// Spots on the wall z = 2, in the same axes.
const SPOTS: [[f64; 3]; 3] = [[0.4, 0.3, 2.0], [-0.5, 0.2, 2.0], [0.1, 0.35, 2.0]];

fn norm(a: [f64; 3]) -> f64 {
    a.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn away(a: [f64; 3], b: [f64; 3]) -> f64 {
    norm([a[0] - b[0], a[1] - b[1], a[2] - b[2]])
}

/// Returns the point of the wall that a pixel of the files sees: from the left (x large) and from
/// the bottom.
fn seen(pixel: usize) -> [f64; 3] {
    let x = 0.7 - 0.2 * (pixel % COLUMNS) as f64;
    let y = -0.5 + 0.2 * (pixel / COLUMNS) as f64;
    [x, y, 2.0]
}

/// Returns the path from the laser via the spot and the point to the camera.
fn path(spot: [f64; 3], point: [f64; 3]) -> f64 {
    away(spot, LASER) + away(spot, point) + norm(point)
}

fn lit(spot: usize, pixel: usize) -> bool {
    !(pixel + spot).is_multiple_of(5)
}

/// The content of the files of times and detections.
struct Given {
    t2: Vec<f64>,
    has: Vec<f64>,
    points: Vec<f64>,
}

/// Returns the files' content, with the spots' y multiplied by `sign`.
fn given(sign: f64) -> Given {
    let pairs = (0..PIXELS).flat_map(|p| (0..3).map(move |s| (s, p)));
    let rows = [SPOTS[0], SPOTS[1], SPOTS[2], [0.0; 3]];
    Given {
        t2: pairs
            .clone()
            .map(|(s, p)| path(SPOTS[s], seen(p)) / C)
            .collect(),
        has: pairs.map(|(s, p)| f64::from(u8::from(lit(s, p)))).collect(),
        points: (0..3)
            .flat_map(|axis| {
                rows.map(|row| {
                    if axis == 1 {
                        sign * row[axis]
                    } else {
                        row[axis]
                    }
                })
            })
            .collect(),
    }
}

fn write(folder: &Path, given: &Given, spots: i32) {
    let put = |name: &str, arrays: &[Vec<u8>]| {
        std::fs::write(folder.join(name), version_5(arrays)).unwrap();
    };
    let dims = [spots, given.t2.len() as i32 / spots];
    put("t2.mat", &[matrix("t2", dims, &given.t2)]);
    let points = [given.points.len() as i32 / 3, 3];
    put(
        "two_bounce_detections.mat",
        &[
            matrix("has_2B", dims, &given.has),
            matrix("illum_pts", points, &given.points),
        ],
    );
}

/// Writes three captures of the wall; only the spots are bright.
fn collection(folder: &Path) {
    let angles: Vec<(f64, f64)> = (0..PIXELS)
        .map(|p| {
            let point = seen(p);
            ((point[0] / norm(point)).acos(), point[1].atan2(point[2]))
        })
        .collect();
    let of = |pick: fn(&(f64, f64)) -> f64| angles.iter().map(pick).collect::<Vec<_>>();
    let scan = [
        matrix("num_u", [1, 1], &[COLUMNS as f64]),
        matrix("num_v", [1, 1], &[ROWS as f64]),
        matrix("thetaMap", [PIXELS as i32, 1], &of(|a| a.0)),
        matrix("phiMap", [PIXELS as i32, 1], &of(|a| a.1)),
    ];
    std::fs::write(folder.join("detector_scan_8x6.mat"), version_5(&scan)).unwrap();
    let bins = 2_100;
    for (number, spot) in SPOTS.iter().enumerate() {
        let mut counts = vec![0.0; PIXELS * bins];
        let nearest =
            (0..PIXELS).min_by(|a, b| away(seen(*a), *spot).total_cmp(&away(seen(*b), *spot)));
        let bin = ((away(*spot, LASER) + norm(*spot)) / C / 8e-12) as usize;
        counts[bin * PIXELS + nearest.unwrap()] = 200.0;
        let cube = matrix("dataCube", [PIXELS as i32, bins as i32], &counts);
        let name = format!("spot_{}.mat", number + 1);
        std::fs::write(folder.join(name), version_5(&[cube])).unwrap();
    }
}

fn options(captures: Captures) -> ImportOptions {
    ImportOptions {
        t0_s: Some(0.0),
        laser_m: Some(LASER),
        captures,
        ..ImportOptions::default()
    }
}

async fn published(source: &Source, profile: Profile) -> (Dataset, ImportedScene) {
    let (store, _) = in_memory(&spec(Profile::LOSSLESS)).await;
    let spec = source.spec(profile);
    let dataset = Dataset::create_or_open(store, "sets/b".into(), &spec)
        .await
        .unwrap();
    let scene = import_scene(source, 0).unwrap();
    let encoded = source.encode(&dataset, 0, &scene).unwrap();
    dataset.publish_encoded(encoded).await.unwrap();
    (dataset, scene)
}

#[tokio::test]
async fn times_and_detections_become_paths_and_masks_and_spots_upside_down_are_turned() {
    for sign in [1.0, -1.0] {
        let folder = tempfile::tempdir().unwrap();
        collection(folder.path());
        write(folder.path(), &given(sign), 3);
        let source = Source::open(folder.path(), None, options(Captures::Sum), None).unwrap();
        let (dataset, scene) = published(&source, Profile::CountsU16).await;
        let paths = dataset
            .read::<f32>(0, Quantity::TwoBouncePath)
            .await
            .unwrap();
        let masks = dataset.read_visibility(0).await.unwrap();
        let spots = dataset.read_spots(0).await.unwrap();
        for (s, spot) in SPOTS.iter().enumerate() {
            let found = spots[s].unwrap();
            for (found, expected) in found.position.iter().zip([-spot[0], -spot[1], spot[2]]) {
                assert!(
                    (f64::from(*found) - expected).abs() < 1e-6,
                    "{found} {expected}"
                );
            }
            assert!((f64::from(found.path_m) - away(*spot, LASER)).abs() < 1e-6);
            for row in 0..ROWS {
                for column in 0..COLUMNS {
                    let there = (ROWS - 1 - row) * COLUMNS + column;
                    let at = (s * ROWS + row) * COLUMNS + column;
                    assert_eq!(masks[at] == 1, lit(s, there), "{s} {row} {column}");
                    let expected = if lit(s, there) {
                        path(*spot, seen(there))
                    } else {
                        0.0
                    };
                    assert!(
                        (f64::from(paths[at]) - expected).abs() < 1e-5,
                        "{s} {row} {column}"
                    );
                }
            }
        }
        assert!(!scene.missing.contains(&"visibility"));
        assert!(scene.missing.contains(&"depth"));
        let turned = scene.conversions.iter().any(|c| c.contains("upside down"));
        assert_eq!(turned, sign < 0.0, "{:?}", scene.conversions);
        let checks = scene.check.as_array().unwrap().last().unwrap();
        let spread = |name: &str| checks[name].as_f64().unwrap();
        let (upright, over) = (spread("spread_m"), spread("spread_of_spots_upside_down_m"));
        assert!((upright < 1e-5) != (over < 1e-5), "{checks}");
    }
}

#[tokio::test]
async fn captures_that_stay_apart_take_no_times_along() {
    let folder = tempfile::tempdir().unwrap();
    collection(folder.path());
    write(folder.path(), &given(1.0), 3);
    let source = Source::open(folder.path(), None, options(Captures::Separate), None).unwrap();
    assert_eq!(source.scenes(), 3);
    assert!(!source.spec(Profile::CountsU16).two_bounce);
    assert!(
        import_scene(&source, 1)
            .unwrap()
            .missing
            .contains(&"visibility")
    );
}

#[test]
fn times_that_do_not_fit_are_refused_by_file_and_array() {
    let folder = tempfile::tempdir().unwrap();
    collection(folder.path());
    let refused = |parts: &[&str]| {
        let opened = Source::open(folder.path(), None, options(Captures::Sum), None);
        let said = opened
            .and_then(|s| import_scene(&s, 0))
            .unwrap_err()
            .to_string();
        for part in parts {
            assert!(said.contains(part), "{part:?}: {said}");
        }
    };
    let whole = given(1.0);
    write(folder.path(), &whole, 2);
    refused(&["t2.mat: t2", "[3, 48]", "[2, 72]"]);
    let few = Given {
        points: vec![1.0; 6],
        ..given(1.0)
    };
    write(folder.path(), &few, 3);
    refused(&["two_bounce_detections.mat: illum_pts", "[4, 3]", "[2, 3]"]);
    let grey = Given {
        has: vec![0.5; PIXELS * 3],
        ..given(1.0)
    };
    write(folder.path(), &grey, 3);
    refused(&["has_2B", "0 and 1", "0.5"]);
    let early = Given {
        t2: whole.t2.iter().map(|t| t - 2e-8).collect(),
        ..given(1.0)
    };
    write(folder.path(), &early, 3);
    refused(&["t2.mat: t2", "none that are long enough", "--laser-m"]);
    std::fs::remove_file(folder.path().join("t2.mat")).unwrap();
    refused(&[
        "t2.mat and two_bounce_detections.mat",
        "two_bounce_detections.mat alone",
    ]);
}

/// Writes our own layout with two-bounce paths in millimetres and without depth.
fn own(folder: &Path) -> (Value, Vec<f32>) {
    let room = Room::new(16, 200);
    let (w, h) = (room.width, room.height);
    let put = |name: &str, bytes: Vec<u8>| std::fs::write(folder.join(name), bytes).unwrap();
    let spots = [0u32, 7];
    put(
        "h.npy",
        npy("<f4", &[h, w, room.bins], &room.transient(&spots)),
    );
    let lights = spots
        .map(|s| room.lights[s as usize].map(|x| x * 1e3))
        .concat();
    put("spots.npy", npy("<f4", &[2, 3], &lights));
    let paths: Vec<f32> = (0..2 * w * h)
        .map(|i| if i % 3 == 0 { 0.0 } else { 3e3 + i as f32 })
        .collect();
    put("paths.npy", npy("<f4", &[2, h, w], &paths));
    let description = json!({
        "format": "picofarm-scene-1",
        "length_unit": "mm",
        "histogram": {"file": "h.npy", "axes": ["row", "column", "bin"],
                      "gate_start": room.gate[0] * 1e3, "bin_width": room.gate[1] * 1e3, "gate_unit": "length"},
        "camera": {"fx": 8.0, "fy": 8.0, "cx": 8.0, "cy": 8.0, "pixel_centre": 0.5, "axes": ["right", "down", "forward"]},
        "laser": [0.0, 0.0, 0.0],
        "spots": {"file": "spots.npy"},
        "two_bounce": {"file": "paths.npy"},
    });
    (description, paths)
}

#[tokio::test]
async fn our_own_layout_may_have_two_bounce_paths_and_no_depth() {
    let folder = tempfile::tempdir().unwrap();
    let (description, paths) = own(folder.path());
    let describe =
        |d: &Value| std::fs::write(folder.path().join("scene.json"), d.to_string()).unwrap();
    describe(&description);
    let source = Source::open(folder.path(), None, ImportOptions::default(), None).unwrap();
    let (dataset, scene) = published(&source, Profile::LOSSLESS).await;
    let found = dataset
        .read::<f32>(0, Quantity::TwoBouncePath)
        .await
        .unwrap();
    let metres: Vec<f32> = paths
        .iter()
        .map(|x| (f64::from(*x) * 1e-3) as f32)
        .collect();
    assert_eq!(found, metres);
    assert!(
        ["depth", "range"]
            .iter()
            .all(|name| scene.missing.contains(name))
    );
    assert!(scene.conversions.iter().any(|c| c.contains("not checked")));

    let odd: Vec<f32> = paths.iter().map(|x| x - 1.0).collect();
    std::fs::write(
        folder.path().join("paths.npy"),
        npy("<f4", &[2, 16, 16], &odd),
    )
    .unwrap();
    let said = import_scene(&source, 0).unwrap_err().to_string();
    assert!(
        said.contains("paths.npy: values") && said.contains("-0.001"),
        "{said}"
    );
    std::fs::write(
        folder.path().join("paths.npy"),
        npy("<f4", &[16, 16], &odd[..256]),
    )
    .unwrap();
    let said = import_scene(&source, 0).unwrap_err().to_string();
    assert!(
        said.contains("paths.npy: shape") && said.contains("[2, 16, 16]"),
        "{said}"
    );
}

/// Writes our own layout with true paths of six spots, in the order `order`. `late` metres are
/// added to the paths, and x of the spots is multiplied by `x`. With `depth`, depth is also
/// written.
fn bounced(folder: &Path, order: [u32; 6], late: f32, x: f32, depth: bool) -> Source {
    let spots = [3u32, 17, 34, 51, 68, 86];
    let room = Room::new(16, 637);
    let (w, h) = (room.width, room.height);
    let put = |name: &str, bytes: Vec<u8>| std::fs::write(folder.join(name), bytes).unwrap();
    put(
        "h.npy",
        npy("<f4", &[h, w, room.bins], &room.transient(&spots)),
    );
    let lights = spots.map(|s| room.lights[s as usize]);
    let lights = lights.map(|[a, b, c]| [x * a, b, c]).concat();
    put("spots.npy", npy("<f4", &[6, 3], &lights));
    let paths = order.map(|s| {
        let path = |p| room.path(s as usize, p) as f32 + late;
        (0..w * h).map(path).collect::<Vec<f32>>()
    });
    put("paths.npy", npy("<f4", &[6, h, w], &paths.concat()));
    let mut description = json!({
        "format": "picofarm-scene-1",
        "length_unit": "m",
        "histogram": {"file": "h.npy", "axes": ["row", "column", "bin"],
                      "gate_start": room.gate[0], "bin_width": room.gate[1], "gate_unit": "length"},
        "camera": {"fx": 8.0, "fy": 8.0, "cx": 8.0, "cy": 8.0, "pixel_centre": 0.5, "axes": ["right", "down", "forward"]},
        "laser": [0.0, 0.0, 0.0],
        "spots": {"file": "spots.npy"},
        "two_bounce": {"file": "paths.npy"},
    });
    if depth {
        put("depth.npy", npy("<f4", &[h, w], &room.depth));
        description["depth"] = json!({"file": "depth.npy", "kind": "z"});
    }
    std::fs::write(folder.join("scene.json"), description.to_string()).unwrap();
    Source::open(folder, None, ImportOptions::default(), None).unwrap()
}

#[test]
fn two_bounce_paths_must_fit_spots_and_depth() {
    const RIGHT: [u32; 6] = [3, 17, 34, 51, 68, 86];
    const EXCHANGED: [u32; 6] = [86, 17, 34, 51, 68, 3];
    for depth in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let scene = import_scene(&bounced(folder.path(), RIGHT, 0.0, 1.0, depth), 0).unwrap();
        let found = &scene.check["two_bounce_paths"];
        assert!(found["residual_m"].as_f64().unwrap() < 1e-3, "{found}");
        assert!(found["pairs"].as_u64().unwrap() > 1000, "{found}");
        let refused = |order, late, x| {
            let source = bounced(folder.path(), order, late, x, depth);
            import_scene(&source, 0).unwrap_err().to_string()
        };
        let said = refused(EXCHANGED, 0.0, 1.0);
        assert!(
            said.contains("paths.npy: paths") && said.contains("exchanged"),
            "{said}"
        );
        if depth {
            let said = refused(RIGHT, 0.1, 1.0);
            assert!(said.contains("0.100 m longer"), "{said}");
        } else {
            let said = refused(RIGHT, 0.0, -1.0);
            assert!(said.contains("paths.npy: paths"), "{said}");
        }
    }
}

#[tokio::test]
async fn captures_of_one_scene_are_kept_next_to_their_sum_if_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    collection(folder.path());
    let source = Source::open(folder.path(), None, options(Captures::Both), None).unwrap();
    assert_eq!(source.scenes(), 1);
    assert!(source.spec(Profile::CountsU16).per_spot);
    let (dataset, _) = published(&source, Profile::CountsU16).await;
    let sum = dataset.read_transient(0).await.unwrap();
    let mut expected = vec![0.0; sum.len()];
    for spot in 0..3 {
        let one = dataset.read_spot(0, spot).await.unwrap();
        assert_eq!(one.iter().sum::<f32>(), 200.0);
        let apart = Source::open(folder.path(), None, options(Captures::Separate), None).unwrap();
        let (alone, _) = published_scene(&apart, u64::from(spot)).await;
        assert_eq!(one, alone);
        expected.iter_mut().zip(one).for_each(|(e, x)| *e += x);
    }
    assert_eq!(sum, expected);
}

/// Returns the histograms of a scene, and the data set.
async fn published_scene(source: &Source, index: u64) -> (Vec<f32>, Dataset) {
    let (store, _) = in_memory(&spec(Profile::LOSSLESS)).await;
    let spec = source.spec(Profile::CountsU16);
    let dataset = Dataset::create_or_open(store, "sets/b".into(), &spec)
        .await
        .unwrap();
    let scene = import_scene(source, index).unwrap();
    let encoded = source.encode(&dataset, index, &scene).unwrap();
    dataset.publish_encoded(encoded).await.unwrap();
    (dataset.read_transient(index).await.unwrap(), dataset)
}
