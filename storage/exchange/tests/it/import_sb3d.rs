//! Tests of the paper's layout: an export is imported again within half precision, and the paper's
//! own files can be read.

use crate::common;

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use crate::files::npy::npy;
use crate::files::room::Room;
use common::*;
use object_store::ObjectStore;
use picofarm_dataset::*;
use picofarm_exchange::import::*;
use picofarm_exchange::*;
use picofarm_store::*;

const SIDE: usize = 40;
const BINS: usize = 180;

/// Returns a data set of one scene, a room lit by 100 spots, with both subsets.
async fn source(room: &Room) -> Dataset {
    let spec = DatasetSpec {
        scenes: 1,
        height: SIDE as u32,
        width: SIDE as u32,
        spots: 100,
        subsets: Subsets::of(&[4, 25]).unwrap(),
        per_spot: false,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        gate: Gate {
            start_m: room.gate[0],
            bin_width_m: room.gate[1],
            bins: BINS as u32,
        },
        profile: Profile::LOSSLESS,
    };
    let made = Scene::new(&spec, 1);
    let all: Vec<u32> = (0..100).collect();
    let spots: Vec<Option<Spot>> = room
        .lights
        .iter()
        .map(|l| {
            Some(Spot {
                position: *l,
                normal: [0.0, 0.6, -0.8],
                path_m: l.iter().map(|x| x * x).sum::<f32>().sqrt(),
            })
        })
        .collect();
    let (few, some) = (
        room.transient(Quantity::Transient4.spots_of_100()),
        room.transient(Quantity::Transient25.spots_of_100()),
    );
    let transient = room.transient(&all);
    let subsets = [(Quantity::Transient4, &few), (Quantity::Transient25, &some)];
    let subsets = subsets.map(|(quantity, h)| SubsetRecord {
        quantity,
        planes: vec![h],
    });
    let record = SceneRecord {
        transient: &transient,
        subsets: &subsets,
        depth: &room.depth,
        specular: &room.specular,
        visibility: &room.lit,
        two_bounce: &[],
        spots: &spots,
        intrinsics: Intrinsics {
            fx: SIDE as f32 / 2.0,
            fy: SIDE as f32 / 2.0,
            cx: SIDE as f32 / 2.0,
            cy: SIDE as f32 / 2.0,
        },
        laser: [0.0; 3],
        ..made.record()
    };
    let store: Arc<dyn ObjectStore> = Arc::new(object_store::memory::InMemory::new());
    let dataset = Dataset::create_or_open(store, "a".into(), &spec)
        .await
        .unwrap();
    dataset.publish(0, &record, &provenance()).await.unwrap();
    dataset
}

async fn export(dataset: &Dataset, to: &Path) -> Exported {
    let (store, prefix) = open_store(to.to_str().unwrap()).unwrap();
    let mut done = None;
    // In a repeated export, equal files count as written.
    for _ in 0..2 {
        let mut export =
            Exporter::new(ExportFormat::Sb3d, dataset, &[0], &*store, prefix.clone()).unwrap();
        assert_eq!(export.steps(), 1);
        export.step(0).await.unwrap();
        let written = export.finish().await.unwrap();
        assert_eq!(*done.get_or_insert(written), written);
    }
    done.unwrap()
}

async fn import(
    folder: &Path,
    options: ImportOptions,
) -> Result<(Dataset, ImportedScene), ImportError> {
    let source = Source::open(folder, None, options, None)?;
    let scene = import_scene(&source, 0)?;
    let store: Arc<dyn ObjectStore> = Arc::new(object_store::memory::InMemory::new());
    let spec = source.spec(Profile::LOSSLESS);
    let dataset = Dataset::create_or_open(store, "b".into(), &spec).await?;
    let encoded = source.encode(&dataset, 0, &scene)?;
    dataset.publish_encoded(encoded).await?;
    Ok((dataset, scene))
}

#[tokio::test]
async fn what_is_exported_comes_back_within_half_precision() {
    let folder = tempfile::tempdir().unwrap();
    let room = Room::new(SIDE, BINS);
    let before = source(&room).await;
    let done = export(&before, folder.path()).await;
    // Its own files, and the card, the table and the Croissant metadata.
    assert_eq!(done.files, 8 + 3);
    let (after, scene) = import(folder.path(), ImportOptions::default())
        .await
        .unwrap();
    println!("{:#?}\n{:#}", scene.conversions, scene.check);
    assert_eq!(scene.name, "000000");
    assert_eq!(after.spec(), before.spec());
    for quantity in [
        Quantity::Transient,
        Quantity::Transient4,
        Quantity::Transient25,
    ] {
        let ours = before.read_histogram(0, quantity).await.unwrap();
        let theirs = after.read_histogram(0, quantity).await.unwrap();
        let brightest = ours.iter().fold(0.0f32, |m, x| m.max(*x));
        for (a, b) in ours.iter().zip(&theirs) {
            let bound = (a * 2f32.powi(-11)).max(brightest * 2f32.powi(-39));
            assert!((a - b).abs() <= bound, "{a} came back as {b}");
        }
    }
    for quantity in [
        Quantity::Depth,
        Quantity::Spots,
        Quantity::Intrinsics,
        Quantity::Laser,
        Quantity::Camera,
        Quantity::Scale,
    ] {
        let (a, b) = (
            before.read::<f32>(0, quantity).await.unwrap(),
            after.read::<f32>(0, quantity).await.unwrap(),
        );
        assert_eq!(a, b, "{quantity:?}");
    }
    for quantity in [Quantity::Visibility, Quantity::Specular] {
        let (a, b) = (
            before.read::<u8>(0, quantity).await.unwrap(),
            after.read::<u8>(0, quantity).await.unwrap(),
        );
        assert_eq!(a, b, "{quantity:?}");
    }
}

#[tokio::test]
async fn the_papers_own_files_are_checked_against_one_another() {
    let folder = tempfile::tempdir().unwrap();
    let room = Room::new(SIDE, BINS);
    export(&source(&room).await, folder.path()).await;
    let scene = folder.path().join("000000");
    std::fs::remove_file(scene.join("picofarm.json")).unwrap();
    let gate = ImportOptions {
        bin_width_m: Some(room.gate[1]),
        ..ImportOptions::default()
    };
    // Without our own file, the values are those of the halves.
    let (after, read) = import(folder.path(), gate.clone()).await.unwrap();
    assert!(read.missing.contains(&"camera"));
    let brightest = after
        .read_transient(0)
        .await
        .unwrap()
        .iter()
        .fold(0.0f32, |m, x| m.max(*x));
    assert!((16_384.0..=32_768.0).contains(&brightest));
    let spots = after.read_spots(0).await.unwrap();
    assert_eq!(spots[7].unwrap().position, room.lights[7]);
    // Only 25 spots.
    let few = ImportOptions {
        spots: Some(25),
        ..gate.clone()
    };
    let (after, _) = import(folder.path(), few).await.unwrap();
    assert_eq!(after.spec().spots, 25);
    assert_eq!(
        after.read_spots(0).await.unwrap()[3].unwrap().position,
        room.lights[7]
    );

    let refused = async |options: ImportOptions, parts: &[&str]| {
        let error = import(folder.path(), options)
            .await
            .unwrap_err()
            .to_string();
        println!("{error}");
        for part in parts {
            assert!(error.contains(part), "{error}");
        }
    };
    // The default is the paper's bins, which these are not.
    refused(ImportOptions::default(), &["lidar_100.exr"]).await;
    let shadow = ImportOptions {
        visibility: Some(Polarity::Shadow),
        ..gate.clone()
    };
    refused(shadow, &["shadows_v1.npz: polarity", "--visibility"]).await;
    let millimetres = ImportOptions {
        length_unit_m: Some(0.001),
        ..gate.clone()
    };
    refused(millimetres, &["lidar_100.exr"]).await;
    let useless = ImportOptions {
        t0_s: Some(0.0),
        ..gate.clone()
    };
    refused(useless, &["--t0-s: sb3d"]).await;

    let lights: Vec<f32> = room
        .lights
        .iter()
        .flat_map(|l| [l[0] * 1000.0, l[1] * 1000.0, l[2] * 1000.0])
        .collect();
    let whole = std::fs::read(scene.join("lights_camera_frame.npy")).unwrap();
    std::fs::write(
        scene.join("lights_camera_frame.npy"),
        npy("<f4", &[100, 3], &lights),
    )
    .unwrap();
    refused(
        gate.clone(),
        &["lights_camera_frame.npy: positions", "1000."],
    )
    .await;
    std::fs::write(
        scene.join("lights_camera_frame.npy"),
        npy("<f4", &[20, 15], &lights),
    )
    .unwrap();
    refused(
        gate.clone(),
        &["lights_camera_frame.npy: shape", "[20, 15]"],
    )
    .await;
    std::fs::write(scene.join("lights_camera_frame.npy"), whole).unwrap();
    let whole = std::fs::read(scene.join("lidar_100.exr")).unwrap();
    std::fs::write(scene.join("lidar_100.exr"), &whole[..whole.len() / 2]).unwrap();
    refused(gate.clone(), &["lidar_100.exr: "]).await;
    // More light from 25 spots than from 100.
    std::fs::copy(scene.join("lidar_4.exr"), scene.join("lidar_100.exr")).unwrap();
    refused(gate, &["energy"]).await;
}

#[tokio::test]
async fn openexr_reads_what_we_export_and_we_read_what_it_writes() {
    let python = std::env::var_os("PICOFARM_PYTHON");
    let has_openexr = python.as_ref().is_some_and(|python| {
        let probe = Command::new(python)
            .args(["-c", "import OpenEXR, numpy"])
            .output();
        probe.is_ok_and(|o| o.status.success())
    });
    let Some(python) = python.filter(|_| has_openexr) else {
        println!(
            "skipped: set PICOFARM_PYTHON to a Python with numpy and OpenEXR to run this test"
        );
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let room = Room::new(SIDE, BINS);
    let before = source(&room).await;
    export(&before, folder.path()).await;
    let h = before.read_transient(0).await.unwrap();
    std::fs::write(folder.path().join("h.bin"), bytemuck::cast_slice(&h)).unwrap();
    // The script compares the scene, and writes it again like the paper's code, with DWAA, into a
    // separate folder.
    let script = Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap())
        .join("../../tests/interop/sb3d.py");
    let anew = folder.path().join("anew");
    let output = Command::new(&python)
        .arg(script)
        .arg(folder.path().join("000000"))
        .arg(folder.path().join("h.bin"))
        .arg(anew.join("scene"))
        .output()
        .unwrap();
    let (out, err) = (
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    );
    println!("{out}");
    assert!(output.status.success(), "{out}\n{err}");
    let gate = ImportOptions {
        bin_width_m: Some(room.gate[1]),
        ..ImportOptions::default()
    };
    let (after, scene) = import(&anew, gate).await.unwrap();
    println!("{:#?}\n{:#}", scene.conversions, scene.check);
    assert!(
        scene.conversions.iter().any(|c| c.contains("DWAA")),
        "{:?}",
        scene.conversions
    );
    // The values that OpenEXR itself decodes from its file.
    let raw = std::fs::read(anew.join("decoded.bin")).unwrap();
    let decoded: Vec<f32> = bytemuck::pod_collect_to_vec(&raw);
    let found = after.read_transient(0).await.unwrap();
    let brightest = decoded.iter().fold(0.0f32, |m, x| m.max(*x));
    for (a, b) in decoded.iter().zip(&found) {
        // Both decoders use 32-bit cosines, but in a different order.
        let bound = (a.abs() * 2f32.powi(-9)).max(brightest * 2f32.powi(-20));
        assert!((a.max(0.0) - b).abs() <= bound, "{a} was read as {b}");
    }
}
