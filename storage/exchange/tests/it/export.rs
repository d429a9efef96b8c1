//! Tests that exports contain the same values in fewer files, and that zarr-python can read them.
//! The comparison runs if `PICOFARM_PYTHON` names a Python with numpy, zarr and xarray.

use crate::common;

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::path::Path;
use std::process::Command;

use common::*;
use picofarm_dataset::*;
use picofarm_exchange::*;
use picofarm_store::*;

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
    export_as(ExportFormat::Zarr, dataset, scenes, to).await
}

async fn export_as(format: ExportFormat, dataset: &Dataset, scenes: &[u64], to: &Path) -> Exported {
    let (store, prefix) = open_store(to.to_str().unwrap()).unwrap();
    let mut export = Exporter::new(format, dataset, scenes, &*store, prefix).unwrap();
    let each = match format {
        ExportFormat::Zarr => 16,
        ExportFormat::WebDataset => 8,
        ExportFormat::Sb3d | ExportFormat::Hdf5 => 1,
    };
    assert_eq!(export.steps(), scenes.len().div_ceil(each));
    for k in 0..export.steps() {
        export.step(k).await.unwrap();
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
        let list: Vec<String> = scenes.iter().map(u64::to_string).collect();
        let (source, packed) = (folder.path().join("source"), folder.path().join("packed"));
        let args = [
            source.as_os_str(),
            packed.as_os_str(),
            list.join(",").as_ref(),
        ]
        .map(Into::into);
        reads(&python, "read_export.py", &args);
    }
}

/// Runs a script of tests/interop.
fn reads(python: &OsStr, script: &str, args: &[OsString]) {
    let scripts =
        Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap()).join("../../tests/interop");
    let output = Command::new(python)
        .arg(scripts.join(script))
        .args(args)
        .output()
        .unwrap();
    let (out, err) = (
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    );
    println!("{args:?}\n{out}");
    assert!(output.status.success(), "{args:?}\n{out}\n{err}");
}

#[tokio::test]
async fn python_reads_of_tar_and_hdf5_files_what_the_data_set_holds() {
    let Some(python) = std::env::var_os("PICOFARM_PYTHON") else {
        println!(
            "skipped: set PICOFARM_PYTHON to a Python with numpy, zarr, xarray and h5py to run this test"
        );
        return;
    };
    for profile in PROFILES {
        let folder = tempfile::tempdir().unwrap();
        let (dataset, scenes) = source(folder.path(), profile).await;
        for format in [ExportFormat::WebDataset, ExportFormat::Hdf5] {
            let place = folder.path().join(format.name());
            let done = export_as(format, &dataset, &scenes, &place).await;
            let written = files(&place);
            assert_eq!((done.scenes, done.files), (21, written.len() as u64));
            let source = folder.path().join("source").into_os_string();
            reads(&python, "read_files.py", &[source, place.clone().into()]);
            // A repeated export writes the same bytes, so there is no conflict.
            assert_eq!(export_as(format, &dataset, &scenes, &place).await, done);
            assert!(files(&place) == written);
        }
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
    let mut begun = Exporter::new(
        ExportFormat::Zarr,
        &dataset,
        &scenes,
        &*store,
        prefix.clone(),
    )
    .unwrap();
    begun.step(0).await.unwrap();
    drop(begun);
    assert!(!place.join("zarr.json").exists());
    assert_eq!(export(&dataset, &scenes, &place).await, done);
    assert!(files(&place) == expected);

    let mut other =
        Exporter::new(ExportFormat::Zarr, &dataset, &scenes[1..], &*store, prefix).unwrap();
    let error = other.step(0).await.unwrap_err();
    assert!(matches!(error, StorageError::Conflict { .. }), "{error}");
    assert!(files(&place) == expected);
}

#[tokio::test]
async fn nothing_damaged_missing_or_oversized_is_exported() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, scenes) = source(folder.path(), Profile::default()).await;
    let (store, prefix) = open_store(folder.path().join("out").to_str().unwrap()).unwrap();
    assert!(Exporter::new(ExportFormat::Zarr, &dataset, &[], &*store, prefix.clone()).is_err());
    let mut absent =
        Exporter::new(ExportFormat::Zarr, &dataset, &[2], &*store, prefix.clone()).unwrap();
    let error = absent.step(0).await.unwrap_err();
    assert!(
        matches!(error, StorageError::NotPublished { scene: 2, .. }),
        "{error}"
    );
    let victim = folder.path().join("source/depth/c/4/0/0");
    let mut bytes = std::fs::read(&victim).unwrap();
    bytes[20] ^= 1;
    std::fs::write(&victim, bytes).unwrap();
    let mut damaged = Exporter::new(
        ExportFormat::Zarr,
        &dataset,
        &scenes,
        &*store,
        prefix.clone(),
    )
    .unwrap();
    let error = damaged.step(0).await.unwrap_err().to_string();
    assert!(error.contains("source/depth/c/4/0/0"), "{error}");
    let each = DatasetSpec {
        per_spot: true,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        ..spec(Profile::default())
    };
    let (_, dataset) = in_memory(&each).await;
    let error = Exporter::new(ExportFormat::Zarr, &dataset, &[0], &*store, prefix)
        .err()
        .unwrap();
    assert!(error.to_string().contains("per_spot"), "{error}");
}

#[tokio::test]
async fn the_table_of_scenes_names_a_place_for_each_that_is_there_and_no_number() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, scenes) = source(folder.path(), Profile::default()).await;
    for format in [
        ExportFormat::Zarr,
        ExportFormat::WebDataset,
        ExportFormat::Hdf5,
    ] {
        let place = folder.path().join(format.name());
        export_as(format, &dataset, &scenes, &place).await;
        let table = std::fs::read_to_string(place.join("scenes.csv")).unwrap();
        let mut lines = table
            .lines()
            .map(|line| line.split(',').collect::<Vec<_>>());
        let column = lines.next().unwrap().iter().position(|c| *c == "file");
        for line in lines {
            let file = line[column.unwrap()];
            assert!(!file.is_empty() && place.join(file).exists(), "{line:?}");
            assert!(file.parse::<f64>().is_err(), "{file} is taken for a number");
        }
    }
}

#[tokio::test]
async fn an_export_writes_into_no_folder_of_another_kind() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, scenes) = source(folder.path(), Profile::default()).await;
    let notes = folder.path().join("notes");
    std::fs::create_dir(&notes).unwrap();
    std::fs::write(notes.join("diary.txt"), "dear diary").unwrap();
    for (place, name) in [
        ("source", "zarr.json"),
        ("notes", "diary.txt"),
        ("", "source"),
    ] {
        let place = folder.path().join(place);
        let before = files(&place);
        for format in ExportFormat::ALL {
            let (store, prefix) = open_store(place.to_str().unwrap()).unwrap();
            let Ok(mut export) = Exporter::new(format, &dataset, &scenes, &*store, prefix) else {
                continue;
            };
            let error = export.step(0).await.unwrap_err().to_string();
            assert!(error.starts_with("export.dest: "), "{error}");
            assert!(error.contains("new or empty folder"), "{error}");
            let named = format == ExportFormat::Zarr || error.contains(name) || name == "zarr.json";
            assert!(named || place == folder.path(), "{error}");
        }
        assert!(files(&place) == before, "nothing was written");
    }
}
