//! Tests that our own layout of `.npy` files is imported according to its description, and refused
//! if the histograms contradict it.

use crate::common;

use std::path::Path;

use crate::files::npy::npy;
use crate::files::room::Room;
use common::*;
use picofarm_dataset::*;
use picofarm_exchange::import::*;
use serde_json::{Value, json};

/// Writes `room` as scene `folder`, with spots 0, 7, 14, …. Returns its description.
fn write(room: &Room, folder: &Path) -> Value {
    std::fs::create_dir_all(folder).unwrap();
    let (w, h, n) = (room.width, room.height, 15);
    let spots: Vec<u32> = (0..n as u32).map(|s| s * 7).collect();
    let put = |name: &str, bytes: Vec<u8>| std::fs::write(folder.join(name), bytes).unwrap();
    put(
        "h.npy",
        npy("<f4", &[h, w, room.bins], &room.transient(&spots)),
    );
    put("depth.npy", npy("<f4", &[h, w], &room.depth));
    let lights: Vec<f32> = spots
        .iter()
        .flat_map(|s| room.lights[*s as usize])
        .collect();
    put("spots.npy", npy("<f4", &[n, 3], &lights));
    let lit: Vec<u8> = spots
        .iter()
        .flat_map(|s| room.lit[*s as usize * w * h..][..w * h].to_vec())
        .collect();
    put("lit.npy", npy("|u1", &[n, h, w], &lit));
    put("mirror.npy", npy("|u1", &[h, w], &room.specular));
    json!({
        "format": "picofarm-scene-1",
        "length_unit": "m",
        "histogram": {"file": "h.npy", "axes": ["row", "column", "bin"],
                      "gate_start": room.gate[0], "bin_width": room.gate[1], "gate_unit": "length"},
        "camera": {"fx": w as f64 / 2.0, "fy": w as f64 / 2.0, "cx": w as f64 / 2.0, "cy": h as f64 / 2.0,
                   "pixel_centre": 0.5, "axes": ["right", "down", "forward"]},
        "laser": [0.0, 0.0, 0.0],
        "spots": {"file": "spots.npy"},
        "depth": {"file": "depth.npy", "kind": "z"},
        "visibility": {"file": "lit.npy", "one_means": "lit"},
        "specular": {"file": "mirror.npy"},
    })
}

fn describe(folder: &Path, description: &Value) {
    std::fs::write(folder.join("scene.json"), description.to_string()).unwrap();
}

fn open(folder: &Path) -> Result<Source, ImportError> {
    Source::open(folder, None, ImportOptions::default(), None)
}

fn refusal(folder: &Path, description: &Value) -> String {
    describe(folder, description);
    let found = open(folder).and_then(|s| import_scene(&s, 0));
    found.unwrap_err().to_string()
}

#[test]
fn masks_in_another_order_of_rows_columns_or_spots_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let room = Room::new(48, 200);
    let description = write(&room, folder.path());
    describe(folder.path(), &description);
    let whole = import_scene(&open(folder.path()).unwrap(), 0).unwrap();
    assert!(
        whole.check["lit_over_shadow"].as_f64().unwrap() > 0.0,
        "{}",
        whole.check
    );
    let (n, h, w) = (15, 48, 48);
    let lit: Vec<u8> = (0..n)
        .flat_map(|s| room.lit[s * 7 * w * h..][..w * h].to_vec())
        .collect();
    type Place = fn(usize, usize, usize) -> usize;
    let orders: [(&str, Place); 5] = [
        ("rows and columns exchanged", |s, r, c| {
            (s * 48 + c) * 48 + r
        }),
        ("right to left", |s, r, c| (s * 48 + r) * 48 + 47 - c),
        ("bottom to top", |s, r, c| (s * 48 + 47 - r) * 48 + c),
        ("other ends", |s, r, c| (s * 48 + 47 - r) * 48 + 47 - c),
        ("last spot first", |s, r, c| ((14 - s) * 48 + r) * 48 + c),
    ];
    for (words, place) in orders {
        let mut turned = vec![0; lit.len()];
        for s in 0..n {
            for r in 0..h {
                for c in 0..w {
                    turned[place(s, r, c)] = lit[(s * h + r) * w + c];
                }
            }
        }
        std::fs::write(
            folder.path().join("lit.npy"),
            npy("|u1", &[n, h, w], &turned),
        )
        .unwrap();
        let said = refusal(folder.path(), &description);
        assert!(
            // Shadows of half the image, when reversed, also look like the other polarity.
            said.contains("lit.npy: polarity of the visibility masks")
                || said.contains("lit.npy: order of the visibility masks") && said.contains(words),
            "{words}: {said}"
        );
    }
}

/// Tests the statements in docs/import.md on the errors that the check does not detect.
#[test]
fn the_check_tells_gates_and_fields_of_view_apart_from_a_small_error_on() {
    let folder = tempfile::tempdir().unwrap();
    let room = Room::new(48, 400);
    let description = write(&room, folder.path());
    let passes = |change: &dyn Fn(&mut Value)| {
        let mut changed = description.clone();
        change(&mut changed);
        describe(folder.path(), &changed);
        open(folder.path())
            .and_then(|s| import_scene(&s, 0))
            .is_ok()
    };
    let width = room.gate[1];
    let gate =
        |bins: f64| passes(&|d| d["histogram"]["gate_start"] = json!(room.gate[0] + bins * width));
    let view = |factor: f64| {
        passes(&|d| {
            for field in ["fx", "fy"] {
                d["camera"][field] = json!(24.0 * factor);
            }
        })
    };
    let gates: Vec<f64> = (-16..=16)
        .map(|k| f64::from(k) * 0.25)
        .filter(|k| gate(*k))
        .collect();
    let views: Vec<f64> = (-30..=30)
        .map(|k| 1.0 + f64::from(k) * 0.01)
        .filter(|k| view(*k))
        .collect();
    println!("gates off by {gates:?} bins pass, focal lengths times {views:?}");
    assert!(
        gates.contains(&0.0) && gates.iter().all(|k| k.abs() <= 2.0),
        "{gates:?}"
    );
    assert!(
        views.contains(&1.0) && views.iter().all(|k| (k - 1.0).abs() < 0.2),
        "{views:?}"
    );
}

#[tokio::test]
async fn a_scene_is_read_and_found_again() {
    let folder = tempfile::tempdir().unwrap();
    let room = Room::new(48, 200);
    for name in ["a", "b"] {
        let scene = folder.path().join(name);
        describe(&scene, &write(&room, &scene));
    }
    let source = open(folder.path()).unwrap();
    assert_eq!((source.format(), source.scenes()), (Format::Npy, 2));
    let (store, _) = in_memory(&spec(Profile::LOSSLESS)).await;
    let dataset = Dataset::create_or_open(store, "sets/b".into(), &source.spec(Profile::LOSSLESS))
        .await
        .unwrap();
    for index in 0..2 {
        assert_eq!(
            source
                .finished(&dataset, index, index, false)
                .await
                .unwrap(),
            None
        );
        let scene = import_scene(&source, index).unwrap();
        let encoded = source.encode(&dataset, index, &scene).unwrap();
        let manifest = dataset.publish_encoded(encoded).await.unwrap();
        assert_eq!(
            source.finished(&dataset, index, index, true).await.unwrap(),
            Some(manifest)
        );
    }
    let spots: Vec<u32> = (0..15).map(|s| s * 7).collect();
    assert_eq!(
        dataset.read_transient(1).await.unwrap(),
        room.transient(&spots)
    );
    assert_eq!(
        dataset.read::<f32>(1, Quantity::Depth).await.unwrap(),
        room.depth
    );
    let plan = &dataset.manifest(1).await.unwrap().provenance.plan;
    assert_eq!(plan["files"].as_array().unwrap().len(), 6);
    assert_eq!(plan["files"][0]["name"], "b/depth.npy");
    assert!(
        plan["missing"]
            .as_array()
            .unwrap()
            .contains(&json!("normal")),
        "{plan}"
    );
    assert_eq!(plan["check"]["peak_shift_m"], 0.0, "{plan}");
    println!("{plan:#}");

    // Another file of the same size is detected only by its contents; one of another size, at once.
    let file = folder.path().join("b/depth.npy");
    let whole = std::fs::read(&file).unwrap();
    let mut other = whole.clone();
    *other.last_mut().unwrap() ^= 1;
    std::fs::write(&file, &other).unwrap();
    assert!(
        source
            .finished(&dataset, 1, 1, false)
            .await
            .unwrap()
            .is_some()
    );
    let error = source
        .finished(&dataset, 1, 1, true)
        .await
        .unwrap_err()
        .to_string();
    assert!(error.contains("SHA-256 of b/depth.npy"), "{error}");
    std::fs::write(&file, &other[1..]).unwrap();
    let error = source
        .finished(&dataset, 1, 1, false)
        .await
        .unwrap_err()
        .to_string();
    assert!(error.contains("size of b/depth.npy"), "{error}");
}

#[test]
fn other_units_axes_and_orders_give_the_same_scene() {
    let folder = tempfile::tempdir().unwrap();
    let room = Room::new(48, 200);
    let plain = write(&room, folder.path());
    describe(folder.path(), &plain);
    let expected = import_scene(&open(folder.path()).unwrap(), 0).unwrap();

    let mut other = plain.clone();
    let (w, h, bins) = (room.width, room.height, room.bins);
    let spots: Vec<u32> = (0..15).map(|s| s * 7).collect();
    let transient = room.transient(&spots);
    let moved: Vec<f32> = (0..bins * w * h)
        .map(|at| {
            let (b, c, r) = (at / (w * h), at / h % w, at % h);
            transient[(r * w + c) * bins + b]
        })
        .collect();
    std::fs::write(
        folder.path().join("h.npy"),
        npy("<f4", &[bins, w, h], &moved),
    )
    .unwrap();
    other["histogram"]["axes"] = json!(["bin", "column", "row"]);
    let picoseconds = 1e12 / 299_792_458.0;
    other["histogram"]["gate_start"] = json!(room.gate[0] * picoseconds);
    other["histogram"]["bin_width"] = json!(room.gate[1] * picoseconds);
    other["histogram"]["gate_unit"] = json!("ps");
    other["length_unit"] = json!("mm");
    let depth: Vec<f64> = room.depth.iter().map(|d| f64::from(*d) * 1000.0).collect();
    std::fs::write(folder.path().join("depth.npy"), npy("<f8", &[h, w], &depth)).unwrap();
    let lights: Vec<f64> = spots
        .iter()
        .flat_map(|s| {
            let [x, y, z] = room.lights[*s as usize].map(f64::from);
            [x * 1000.0, -y * 1000.0, -z * 1000.0]
        })
        .collect();
    std::fs::write(
        folder.path().join("spots.npy"),
        npy("<f8", &[15, 3], &lights),
    )
    .unwrap();
    other["camera"]["axes"] = json!(["right", "up", "backward"]);
    other["camera"]["pixel_centre"] = json!(0.0);
    other["camera"]["cx"] = json!(w as f64 / 2.0 - 0.5);
    other["camera"]["cy"] = json!(h as f64 / 2.0 - 0.5);
    describe(folder.path(), &other);
    let found = import_scene(&open(folder.path()).unwrap(), 0).unwrap();
    assert_eq!(
        found.check["energy_at_prediction"],
        expected.check["energy_at_prediction"]
    );
    assert_eq!(found.conversions.len(), 4, "{:?}", found.conversions);
}

#[test]
fn what_does_not_fit_is_refused_by_file_and_field() {
    let folder = tempfile::tempdir().unwrap();
    let room = Room::new(48, 200);
    let plain = write(&room, folder.path());
    let folder = folder.path();
    let changed = |change: &dyn Fn(&mut Value)| {
        let mut other = plain.clone();
        change(&mut other);
        refusal(folder, &other)
    };
    type Case<'a> = (&'a str, &'a dyn Fn(&mut Value), &'a [&'a str]);
    let cases: [Case<'_>; 8] = [
        (
            "gate",
            &|d| d["histogram"]["gate_start"] = json!(1.6),
            &["h.npy: gate", "after the prediction"],
        ),
        (
            "bin width",
            &|d| d["histogram"]["bin_width"] = json!(0.06),
            &["h.npy"],
        ),
        (
            "polarity",
            &|d| d["visibility"]["one_means"] = json!("shadow"),
            &["lit.npy: polarity"],
        ),
        (
            "depth kind",
            &|d| d["depth"]["kind"] = json!("range"),
            &["spots.npy: positions"],
        ),
        (
            "units",
            &|d| {
                // The gate stays the same: only lengths shrink.
                d["length_unit"] = json!("cm");
                d["histogram"]["gate_start"] = json!(room.gate[0] * 100.0);
                d["histogram"]["bin_width"] = json!(room.gate[1] * 100.0);
            },
            &["h.npy: light"],
        ),
        (
            "axes",
            &|d| d["camera"]["axes"] = json!(["right", "up", "forward"]),
            &["spots.npy"],
        ),
        (
            "twice",
            &|d| d["camera"]["axes"] = json!(["right", "left", "up"]),
            &["scene.json: camera.axes", "each once"],
        ),
        (
            "unknown",
            &|d| d["histogramm"] = json!(1),
            &["scene.json", "histogramm"],
        ),
    ];
    for (name, change, parts) in cases {
        let error = changed(change);
        println!("{name}: {error}");
        for part in parts {
            assert!(error.contains(part), "{name}: {error}");
        }
    }
    // With depth along the rays and correct spots, only the histograms reveal the error.
    let half = room.width as f32 / 2.0;
    let range: Vec<f32> = room
        .depth
        .iter()
        .enumerate()
        .map(|(p, d)| {
            let (x, y) = (
                (p % room.width) as f32 + 0.5 - half,
                (p / room.width) as f32 + 0.5 - half,
            );
            d * (1.0 + (x * x + y * y) / (half * half)).sqrt()
        })
        .collect();
    std::fs::write(
        folder.join("depth.npy"),
        npy("<f4", &[room.height, room.width], &range),
    )
    .unwrap();
    let error = refusal(folder, &plain);
    assert!(error.contains("depth.npy"), "{error}");
    describe(folder, &plain);
    let unchecked = ImportOptions {
        unchecked: true,
        ..ImportOptions::default()
    };
    let source = Source::open(folder, None, unchecked, None).unwrap();
    assert!(import_scene(&source, 0).unwrap().check.is_null());
}

#[test]
fn lengths_of_beams_are_read_or_stated_or_listed_as_missing_where_a_mirror_is_seen() {
    let folder = tempfile::tempdir().unwrap();
    let room = Room::new(48, 200);
    assert!(room.specular.contains(&1));
    let mut description = write(&room, folder.path());
    let import = |description: &Value, options: ImportOptions| {
        describe(folder.path(), description);
        import_scene(
            &Source::open(folder.path(), None, options, None).unwrap(),
            0,
        )
    };
    let unknown = |scene: &ImportedScene| scene.missing.contains(&"spots.path");
    let scene = import(&description, ImportOptions::default()).unwrap();
    assert!(unknown(&scene), "{:?}", scene.missing);
    let straight = ImportOptions {
        straight_beams: true,
        ..ImportOptions::default()
    };
    let scene = import(&description, straight).unwrap();
    let said = |scene: &ImportedScene| {
        scene
            .conversions
            .iter()
            .any(|c| c.contains("straight lines"))
    };
    assert!(!unknown(&scene) && said(&scene), "{:?}", scene.conversions);
    // Without a mirror, no beam is reflected.
    let none = vec![0u8; room.width * room.height];
    let mirrors = folder.path().join("mirror.npy");
    std::fs::write(&mirrors, npy("|u1", &[room.height, room.width], &none)).unwrap();
    let scene = import(&description, ImportOptions::default()).unwrap();
    assert!(!unknown(&scene) && said(&scene), "{:?}", scene.missing);
    // If the mirrors are not given, they are unknown.
    description.as_object_mut().unwrap().remove("specular");
    let scene = import(&description, ImportOptions::default()).unwrap();
    assert!(unknown(&scene), "{:?}", scene.missing);

    let length = |spot: usize| {
        let l = room.lights[spot * 7];
        (l[0] * l[0] + l[1] * l[1] + l[2] * l[2]).sqrt()
    };
    let mut lengths: Vec<f32> = (0..15).map(length).collect();
    description["spots"]["paths"] = "paths.npy".into();
    let put = |lengths: &[f32]| {
        let bytes = npy("<f4", &[lengths.len()], lengths);
        std::fs::write(folder.path().join("paths.npy"), bytes).unwrap();
    };
    lengths[3] += 0.5;
    put(&lengths);
    let unchecked = || ImportOptions {
        unchecked: true,
        ..ImportOptions::default()
    };
    let scene = import(&description, unchecked()).unwrap();
    assert!(!unknown(&scene) && !said(&scene), "{:?}", scene.missing);
    lengths[3] -= 1.0;
    put(&lengths);
    let refused = import(&description, unchecked()).unwrap_err().to_string();
    assert!(
        refused.contains("length of beam 3") && refused.contains("straight line"),
        "{refused}"
    );
}
