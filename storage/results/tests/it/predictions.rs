//! Tests that predictions are published once, read back, grown, and kept apart from data sets, and
//! that zarr-python can read them. The last test runs if `PICOFARM_PYTHON` names a Python with
//! numpy, zarr and xarray.

use crate::common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::spec as dataset_spec;
use picofarm_dataset::*;
use picofarm_results::*;
use picofarm_store::*;
use serde_json::json;

const SIDE: usize = 8;

fn spec(scenes: u64) -> PredictionSpec {
    PredictionSpec {
        scenes,
        height: SIDE as u32,
        width: SIDE as u32,
        depth: true,
        spots: vec![3, 5],
        specular: true,
        confidence: true,
        evidence: Some(picofarm_settings::EvidenceForm {
            version: "apart-1".into(),
            planes: vec!["near".into(), "far".into(), "log odds".into()],
        }),
    }
}

fn predicted(scene: u64) -> Predicted {
    let n = SIDE * SIDE;
    let byte = |i: usize| ((i as u64 * 37 + scene * 11) % 256) as u8;
    Predicted {
        depth_m: (0..n)
            .map(|i| 0.5 + (i as f32 + scene as f32) * 0.03)
            .collect(),
        lit: (0..2 * n).map(byte).collect(),
        specular: (0..n).map(|i| byte(i * 3)).collect(),
        confidence: (0..n).map(|i| byte(i * 5)).collect(),
        evidence: (0..6 * n).map(|i| byte(i * 7)).collect(),
    }
}

fn manifest(scene: u64, key: &str) -> PredictionManifest {
    let used = |name: &str| ModelUsed {
        name: name.into(),
        manifest_sha256: "00".repeat(32),
        histogram: "transient".into(),
        spots: Vec::new(),
    };
    PredictionManifest {
        scene,
        task_key: key.into(),
        code: "model-1".into(),
        source: SceneUsed {
            dataset: "rooms".into(),
            task_key: "11".repeat(32),
            manifest_sha256: "22".repeat(32),
        },
        models: BTreeMap::from([("tof".to_owned(), used("t")), ("shadow".into(), used("s"))]),
        two_bounce_times: Some(TimesUsed::Model(used("t"))),
        ..PredictionManifest::default()
    }
}

async fn open(folder: &Path, spec: &PredictionSpec) -> Result<Predictions, StorageError> {
    let (store, prefix) = open_store(folder.to_str().unwrap()).unwrap();
    Predictions::create_or_open(store, prefix, spec).await
}

async fn publish(there: &Predictions, scene: u64, key: &str) -> PredictionManifest {
    let encoded = there
        .encode(manifest(scene, key), &predicted(scene))
        .unwrap();
    there.publish(&encoded).await.unwrap();
    encoded.manifest
}

fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut found, mut folders) = (BTreeMap::new(), vec![folder.to_path_buf()]);
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => drop(found.insert(path.clone(), std::fs::read(path).unwrap())),
            }
        }
    }
    found
}

#[tokio::test]
async fn what_was_published_reads_back_and_is_known_again_by_its_task() {
    let folder = tempfile::tempdir().unwrap();
    let there = open(folder.path(), &spec(4)).await.unwrap();
    assert_eq!(there.finished(2, "k").await.unwrap(), None);
    let made = publish(&there, 2, "k").await;
    let mut read = there.read(2).await.unwrap();
    read.evidence = there.read_evidence(2).await.unwrap();
    assert_eq!(read, predicted(2));
    assert_eq!(there.scenes_present().await.unwrap(), [2]);
    assert_eq!(there.finished(2, "k").await.unwrap().unwrap(), made);
    let keys: Vec<&str> = made.objects.iter().map(|o| &*o.key).collect();
    assert_eq!(
        keys,
        [
            "depth/c/2/0/0",
            "lit/c/2/0/0/0",
            "specular/c/2/0/0",
            "confidence/c/2/0/0",
            "evidence/c/2/0/0/0/0"
        ]
    );
    // A second publication, by any process, changes nothing.
    let before = files(folder.path());
    let again = open(folder.path(), &spec(4)).await.unwrap();
    publish(&again, 2, "k").await;
    assert_eq!(files(folder.path()), before);
    let said = there.finished(2, "other").await.unwrap_err().to_string();
    assert!(said.contains("choose another folder"), "{said}");
    let said = there.read(1).await.unwrap_err();
    assert!(
        matches!(said, StorageError::NotPublished { scene: 1, .. }),
        "{said}"
    );
}

#[tokio::test]
async fn what_is_missing_or_changed_is_found_out_and_repaired() {
    let folder = tempfile::tempdir().unwrap();
    let there = open(folder.path(), &spec(4)).await.unwrap();
    publish(&there, 0, "k").await;
    let before = files(folder.path());
    let lit = folder.path().join("lit/c/0/0/0/0");
    let bytes = std::fs::read(&lit).unwrap();
    std::fs::remove_file(&lit).unwrap();
    let said = there.finished(0, "k").await.unwrap_err();
    assert!(matches!(said, StorageError::Damaged { .. }), "{said}");
    publish(&there, 0, "k").await;
    assert_eq!(files(folder.path()), before);
    let mut flipped = bytes.clone();
    flipped[20] ^= 1;
    std::fs::write(&lit, flipped).unwrap();
    let said = there.read(0).await.unwrap_err().to_string();
    assert!(said.contains("SHA-256") && said.contains("lit"), "{said}");
    // An object of the same size with a flipped bit is not adopted either.
    let said = there.finished(0, "k").await.unwrap_err().to_string();
    assert!(said.contains("SHA-256") && said.contains("lit"), "{said}");
    std::fs::write(&lit, bytes).unwrap();
    let path = folder.path().join("manifests/0.json");
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("rooms", "booms")).unwrap();
    let said = there.manifest(0).await.unwrap_err().to_string();
    assert!(said.contains("the object was changed"), "{said}");
}

#[tokio::test]
async fn a_check_names_what_is_broken_and_what_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let there = open(folder.path(), &spec(3)).await.unwrap();
    publish(&there, 0, "k").await;
    publish(&there, 1, "k").await;
    let check = async |mode, complete| there.verify(mode, complete, &|_, _| {}).await.unwrap();
    let whole = check(VerifyMode::Full, false).await;
    assert!(whole.is_sound(), "{:?}", whole.problems);
    assert_eq!((whole.scenes, whole.objects), (2, 10));
    let lit = folder.path().join("lit/c/0/0/0/0");
    let mut bytes = std::fs::read(&lit).unwrap();
    bytes[20] ^= 1;
    std::fs::write(&lit, bytes).unwrap();
    assert!(check(VerifyMode::Fast, false).await.is_sound());
    std::fs::remove_file(folder.path().join("depth/c/1/0/0")).unwrap();
    std::fs::write(folder.path().join("specular/zarr.json"), "{}").unwrap();
    std::fs::write(folder.path().join("manifests/2.json"), "{}").unwrap();
    let found = check(VerifyMode::Full, false).await;
    let said: Vec<(Option<u64>, &str)> = found
        .problems
        .iter()
        .map(|p| (p.scene, p.fault.kind()))
        .collect();
    assert_eq!(
        said,
        [
            (Some(1), "missing"),
            (Some(0), "wrong_hash"),
            (Some(2), "bad_manifest"),
            (None, "bad_metadata")
        ]
    );
    std::fs::remove_file(folder.path().join("manifests/2.json")).unwrap();
    let found = check(VerifyMode::Fast, true).await;
    let missing = found.problems.iter().filter(|p| p.scene == Some(2));
    assert_eq!(missing.count(), 1);
}

#[tokio::test]
async fn a_group_grows_with_its_source_and_its_form_stays() {
    let folder = tempfile::tempdir().unwrap();
    let small = open(folder.path(), &spec(2)).await.unwrap();
    publish(&small, 1, "k").await;
    let said = small.encode(manifest(2, "k"), &predicted(2)).unwrap_err();
    assert!(
        matches!(said, StorageError::SceneOutOfRange { .. }),
        "{said}"
    );
    let grown = open(folder.path(), &spec(5)).await.unwrap();
    publish(&grown, 4, "k").await;
    // A process with the smaller spec does not shrink it.
    let late = open(folder.path(), &spec(2)).await.unwrap();
    assert_eq!(late.spec().scenes, 5);
    let metadata = std::fs::read(folder.path().join("lit/zarr.json")).unwrap();
    let metadata: serde_json::Value = serde_json::from_slice(&metadata).unwrap();
    assert_eq!(metadata["shape"], json!([5, 2, 8, 8]));
    let other = PredictionSpec {
        spots: vec![3],
        ..spec(5)
    };
    let said = open(folder.path(), &other).await.unwrap_err().to_string();
    assert!(said.contains("spots = [3, 5], but [3]"), "{said}");
}

#[tokio::test]
async fn predictions_and_data_sets_do_not_take_each_other_for_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let (taken, free) = (folder.path().join("rooms"), folder.path().join("seen"));
    let (store, prefix) = open_store(taken.to_str().unwrap()).unwrap();
    let described = dataset_spec(Profile::LOSSLESS);
    Dataset::create_or_open(store, prefix, &described)
        .await
        .unwrap();
    let said = open(&taken, &spec(2)).await.unwrap_err().to_string();
    assert!(said.contains("is a data set or another"), "{said}");
    let there = open(&free, &spec(2)).await.unwrap();
    publish(&there, 0, "k").await;
    let (store, prefix) = open_store(free.to_str().unwrap()).unwrap();
    for opened in [
        Dataset::open(store.clone(), prefix.clone()).await,
        Dataset::create_or_open(store, prefix, &described).await,
    ] {
        let said = opened.unwrap_err().to_string();
        assert!(said.contains("what models predict"), "{said}");
    }
}

#[tokio::test]
async fn zarr_python_and_xarray_read_the_same_predictions() {
    let Some(python) = std::env::var_os("PICOFARM_PYTHON") else {
        println!(
            "skipped: set PICOFARM_PYTHON to a Python with numpy, zarr and xarray to run this test"
        );
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (group, expected) = (folder.path().join("seen"), folder.path().join("expected"));
    std::fs::create_dir(&expected).unwrap();
    let there = open(&group, &spec(3)).await.unwrap();
    publish(&there, 1, "k").await;
    let values = predicted(1);
    let depth: Vec<u8> = values
        .depth_m
        .iter()
        .flat_map(|z| z.to_le_bytes())
        .collect();
    for (name, bytes) in [
        ("depth", &depth),
        ("lit", &values.lit),
        ("specular", &values.specular),
        ("confidence", &values.confidence),
        ("evidence", &values.evidence),
    ] {
        std::fs::write(expected.join(format!("{name}.bin")), bytes).unwrap();
    }
    let shapes = json!({
        "depth": ["<f4", [8, 8]], "lit": ["|u1", [2, 8, 8]], "specular": ["|u1", [8, 8]],
        "confidence": ["|u1", [8, 8]], "evidence": ["|u1", [2, 3, 8, 8]],
    });
    std::fs::write(expected.join("shapes.json"), shapes.to_string()).unwrap();
    let script = Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap())
        .join("../../tests/interop/read_predictions.py");
    let output = Command::new(&python)
        .args([
            script.as_os_str(),
            group.as_os_str(),
            "1".as_ref(),
            expected.as_os_str(),
        ])
        .output()
        .unwrap();
    let (out, err) = (
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    );
    assert!(output.status.success(), "{out}\n{err}");
}

#[tokio::test]
async fn what_is_damaged_is_put_back_where_it_is_proved_to_be_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let there = open(folder.path(), &spec(4)).await.unwrap();
    publish(&there, 0, "k").await;
    let before = files(folder.path());
    let again = there.encode(manifest(0, "k"), &predicted(0)).unwrap();
    assert_eq!(there.restore(&again).await.unwrap(), Vec::<String>::new());
    for (path, bytes) in &before {
        // The group's metadata does not belong to a scene.
        if path.ends_with("zarr.json") {
            continue;
        }
        let mut flipped = bytes.clone();
        flipped[bytes.len() / 2] ^= 1;
        for damaged in [Some(flipped), Some(bytes[1..].to_vec()), None] {
            match damaged {
                Some(damaged) => std::fs::write(path, damaged).unwrap(),
                None => std::fs::remove_file(path).unwrap(),
            }
            there.restore(&again).await.unwrap();
            assert!(files(folder.path()) == before, "{}", path.display());
        }
    }
    // Other predictions are no proof, and change nothing.
    let other = there.encode(manifest(0, "k"), &predicted(1)).unwrap();
    let lit = folder.path().join("lit/c/0/0/0/0");
    std::fs::write(&lit, b"torn").unwrap();
    let torn = files(folder.path());
    let said = there.restore(&other).await.unwrap_err();
    assert!(matches!(said, StorageError::Diverged { .. }), "{said}");
    let strange = there.encode(manifest(0, "other"), &predicted(0)).unwrap();
    let said = there.restore(&strange).await.unwrap_err().to_string();
    assert!(said.contains("choose another folder"), "{said}");
    // Nothing is restored if the manifest is broken and an object differs from the new one.
    std::fs::write(folder.path().join("manifests/0.json"), b"{").unwrap();
    let said = there.restore(&again).await.unwrap_err();
    assert!(matches!(said, StorageError::Damaged { .. }), "{said}");
    assert_eq!(files(folder.path()).len(), torn.len());
    assert_eq!(std::fs::read(&lit).unwrap(), b"torn");
}
