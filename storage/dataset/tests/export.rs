//! Exports hold the same values in fewer files, and zarr-python reads them.
//! The comparison runs where `PICOFARM_PYTHON` names a Python with numpy, zarr and xarray.

mod common;

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use common::*;
use picofarm_dataset::*;

/// Every fourth scene of 80 and scene 1: 21 scenes, two packs.
async fn source(folder: &Path, profile: Profile) -> (Dataset, Vec<u64>) {
    let spec = DatasetSpec {
        scenes: 80,
        ..spec(profile)
    };
    let (store, prefix) = open_store(folder.join("source").to_str().unwrap()).unwrap();
    let dataset = Dataset::create_or_open(store, prefix, &spec).await.unwrap();
    for scene in (0..80).step_by(4).chain([1]) {
        let mut made = Scene::new(&spec, scene);
        // Tiles without light, and a saturated bin.
        let dark = made.transient.len() / 2;
        made.transient[dark..].fill(0.0);
        made.transient[5] = 5e8 / made.scale;
        let record = made.record();
        dataset
            .publish(scene, &record, &provenance())
            .await
            .unwrap();
    }
    let scenes = dataset.scenes_present().await.unwrap();
    (dataset, scenes)
}

async fn export(dataset: &Dataset, scenes: &[u64], to: &Path) -> Exported {
    let (store, prefix) = open_store(to.to_str().unwrap()).unwrap();
    let mut export = Export::new(dataset, scenes, &*store, prefix).unwrap();
    assert_eq!(export.packs(), scenes.len().div_ceil(16));
    for k in 0..export.packs() {
        export.pack(k).await.unwrap();
    }
    export.finish().await.unwrap()
}

fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().display().to_string();
                all.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    all
}

#[tokio::test]
async fn zarr_python_reads_of_an_export_what_it_reads_of_its_source() {
    let Some(python) = std::env::var_os("PICOFARM_PYTHON") else {
        println!(
            "skipped: set PICOFARM_PYTHON to a Python with numpy, zarr and xarray to run this test"
        );
        return;
    };
    for profile in PROFILES {
        let folder = tempfile::tempdir().unwrap();
        let (dataset, scenes) = source(folder.path(), profile).await;
        export(&dataset, &scenes, &folder.path().join("packed")).await;
        let script =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/interop/read_export.py");
        let list: Vec<String> = scenes.iter().map(u64::to_string).collect();
        let output = Command::new(&python)
            .arg(script)
            .arg(folder.path().join("source"))
            .arg(folder.path().join("packed"))
            .arg(list.join(","))
            .output()
            .unwrap();
        let (out, err) = (
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr),
        );
        println!("{profile:?}\n{out}");
        assert!(output.status.success(), "{profile:?}\n{out}\n{err}");
    }
}

#[tokio::test]
async fn an_interrupted_export_goes_on_and_another_one_in_its_place_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, scenes) = source(folder.path(), Profile::default()).await;
    let whole = folder.path().join("whole");
    let done = export(&dataset, &scenes, &whole).await;
    let expected = files(&whole);
    assert_eq!((done.scenes, done.files), (21, expected.len() as u64));
    assert_eq!(
        done.bytes,
        expected.values().map(|f| f.len() as u64).sum::<u64>()
    );

    let place = folder.path().join("halting");
    let (store, prefix) = open_store(place.to_str().unwrap()).unwrap();
    let mut begun = Export::new(&dataset, &scenes, &*store, prefix.clone()).unwrap();
    begun.pack(0).await.unwrap();
    drop(begun);
    assert!(!place.join("zarr.json").exists());
    assert_eq!(export(&dataset, &scenes, &place).await, done);
    assert!(files(&place) == expected);

    let mut other = Export::new(&dataset, &scenes[1..], &*store, prefix).unwrap();
    let error = other.pack(0).await.unwrap_err();
    assert!(matches!(error, DatasetError::Conflict { .. }), "{error}");
    assert!(files(&place) == expected);
}

#[tokio::test]
async fn nothing_damaged_missing_or_oversized_is_exported() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, scenes) = source(folder.path(), Profile::default()).await;
    let (store, prefix) = open_store(folder.path().join("out").to_str().unwrap()).unwrap();
    assert!(Export::new(&dataset, &[], &*store, prefix.clone()).is_err());
    let mut absent = Export::new(&dataset, &[2], &*store, prefix.clone()).unwrap();
    let error = absent.pack(0).await.unwrap_err();
    assert!(
        matches!(error, DatasetError::NotPublished { scene: 2, .. }),
        "{error}"
    );
    let victim = folder.path().join("source/depth/c/4/0/0");
    let mut bytes = std::fs::read(&victim).unwrap();
    bytes[20] ^= 1;
    std::fs::write(&victim, bytes).unwrap();
    let mut damaged = Export::new(&dataset, &scenes, &*store, prefix.clone()).unwrap();
    let error = damaged.pack(0).await.unwrap_err().to_string();
    assert!(error.contains("source/depth/c/4/0/0"), "{error}");
    let each = DatasetSpec {
        per_spot: true,
        ..spec(Profile::default())
    };
    let (_, dataset) = in_memory(&each).await;
    let error = Export::new(&dataset, &[0], &*store, prefix).err().unwrap();
    assert!(error.to_string().contains("per_spot"), "{error}");
}
