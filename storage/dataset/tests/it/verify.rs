//! Tests that verification reports broken, missing and foreign objects, and that the summary is
//! correct.

use crate::common;

use common::*;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use picofarm_dataset::*;
use picofarm_store::*;

async fn put(store: &dyn ObjectStore, key: &str, bytes: Vec<u8>) {
    store.put(&Path::from(key), bytes.into()).await.unwrap();
}

async fn get(store: &dyn ObjectStore, key: &str) -> Vec<u8> {
    store
        .get(&Path::from(key))
        .await
        .unwrap()
        .bytes()
        .await
        .unwrap()
        .to_vec()
}

fn found(report: &Verification) -> Vec<(&str, &Fault)> {
    report
        .problems
        .iter()
        .map(|p| (p.object.as_str(), &p.fault))
        .collect()
}

#[tokio::test]
async fn broken_missing_and_foreign_objects_are_named() {
    let spec = spec(Profile::default());
    let (store, dataset) = in_memory(&spec).await;
    let scene = Scene::new(&spec, 1);
    for i in 0..3 {
        dataset
            .publish(i, &scene.record(), &provenance())
            .await
            .unwrap();
    }
    for mode in [VerifyMode::Fast, VerifyMode::Full] {
        let report = dataset.verify(mode).await.unwrap();
        assert!(report.is_sound(), "{report:?}");
        assert_eq!((report.scenes, report.objects), (3, 45));
    }
    // Torn, flipped, missing, foreign.
    let torn = "sets/a/transient/c/0/0/0/0";
    let mut bytes = get(&*store, torn).await;
    bytes.truncate(1000);
    put(&*store, torn, bytes).await;
    let flipped = "sets/a/transient/c/1/0/0/0";
    let mut bytes = get(&*store, flipped).await;
    bytes[500] ^= 1;
    put(&*store, flipped, bytes).await;
    store
        .delete(&Path::from("sets/a/spots/c/2/0/0"))
        .await
        .unwrap();
    put(&*store, "sets/a/notes.txt", b"hello".to_vec()).await;
    put(&*store, "sets/a/depth/c/2/0/1", b"hello".to_vec()).await;

    let fast = dataset.verify(VerifyMode::Fast).await.unwrap();
    let names: Vec<&str> = found(&fast).into_iter().map(|(object, _)| object).collect();
    let expected = [
        "sets/a/depth/c/2/0/1",
        "sets/a/notes.txt",
        "sets/a/spots/c/2/0/0",
        torn,
    ];
    assert_eq!(names, expected);
    let full = dataset.verify(VerifyMode::Full).await.unwrap();
    assert_eq!(full.problems.len(), 5);
    let texts: Vec<String> = full.problems.iter().map(ToString::to_string).collect();
    assert_eq!(
        texts[1],
        "sets/a/notes.txt: does not belong to this data set"
    );
    assert_eq!(texts[2], "sets/a/spots/c/2/0/0: missing");
    assert!(texts[3].ends_with("bytes, found 1000"), "{}", texts[3]);
    assert!(
        texts[4].starts_with("sets/a/transient/c/1/0/0/0: expected SHA-256"),
        "{}",
        texts[4]
    );

    // The flipped bit is detected when reading, by the inner chunk's crc32c or the decoder; the
    // rest can still be read.
    assert!(matches!(
        dataset.read_transient(1).await,
        Err(StorageError::Damaged { object, .. }) if object == "sets/a/transient/c/1/0/0/0"
    ));
    dataset
        .read_transient_crop(1, 32..36, 32..40)
        .await
        .unwrap();
    assert!(dataset.read_transient(0).await.is_err());
    let missing = dataset.read_spots(2).await.unwrap_err();
    assert!(
        missing
            .to_string()
            .starts_with("sets/a/spots/c/2/0/0: the object is missing"),
        "{missing}"
    );
}

#[tokio::test]
async fn objects_that_match_a_wrong_manifest_are_decoded_and_found() {
    let spec = spec(Profile::default());
    let (store, dataset) = in_memory(&spec).await;
    let mut scene = Scene::new(&spec, 1);
    scene.transient[7] = 1e9 / scene.scale;
    let manifest = dataset
        .publish(0, &scene.record(), &provenance())
        .await
        .unwrap();
    // The overflow list lost its entry.
    let changed = Manifest {
        overflow: vec![],
        ..manifest.clone()
    };
    let bytes = changed.sealed().to_bytes();
    put(&*store, "sets/a/manifests/0.json", bytes).await;
    let report = dataset.verify(VerifyMode::Full).await.unwrap();
    let [(object, Fault::Undecodable(why))] = found(&report)[..] else {
        panic!("{report:?}")
    };
    assert!(
        object.ends_with("transient/c/0/0/0/0") && why.contains("no exact value"),
        "{why}"
    );
    // Garbage, a wrong number, another format.
    let wrong = [
        (b"{}".to_vec(), "not a manifest"),
        (
            Manifest {
                scene: 1,
                ..manifest.clone()
            }
            .sealed()
            .to_bytes(),
            "holds scene 1",
        ),
        (
            Manifest {
                format: 9,
                ..manifest.clone()
            }
            .sealed()
            .to_bytes(),
            "format 9",
        ),
        (
            Manifest {
                objects: vec![],
                ..manifest.clone()
            }
            .sealed()
            .to_bytes(),
            "exactly",
        ),
    ];
    for (bytes, words) in wrong {
        put(&*store, "sets/a/manifests/0.json", bytes).await;
        let report = dataset.verify(VerifyMode::Fast).await.unwrap();
        let [("sets/a/manifests/0.json", Fault::BadManifest(why))] = found(&report)[..] else {
            panic!("{report:?}")
        };
        assert!(why.contains(words), "{why}");
        assert_eq!(report.unpublished.len(), 15);
    }
}

#[tokio::test]
async fn changed_metadata_are_found() {
    let spec = spec(Profile::default());
    let (store, dataset) = in_memory(&spec).await;
    let key = "sets/a/visibility/zarr.json";
    let text = String::from_utf8(get(&*store, key).await).unwrap();
    put(
        &*store,
        key,
        text.replace("1 = lit", "0 = lit").into_bytes(),
    )
    .await;
    store
        .delete(&Path::from("sets/a/depth/zarr.json"))
        .await
        .unwrap();
    let report = dataset.verify(VerifyMode::Fast).await.unwrap();
    let texts: Vec<String> = report.problems.iter().map(ToString::to_string).collect();
    assert_eq!(texts[0], "sets/a/depth/zarr.json: missing");
    assert!(
        texts[1].starts_with("sets/a/visibility/zarr.json: unusable metadata")
            && texts[1].ends_with("attributes")
    );
}

#[tokio::test]
async fn the_summary_adds_up() {
    let spec = spec(Profile::default());
    let (_, dataset) = in_memory(&spec).await;
    let empty = dataset.info().await.unwrap();
    assert_eq!((empty.scenes, empty.bytes, empty.rms_sigma), (0, 0, None));
    let mut bytes = 0;
    for seed in 0..2 {
        let scene = Scene::new(&spec, seed);
        bytes += dataset
            .publish(seed, &scene.record(), &provenance())
            .await
            .unwrap()
            .total_bytes();
    }
    let summary = dataset.info().await.unwrap();
    assert_eq!(
        (summary.spec, summary.scenes, summary.bytes),
        (spec, 2, bytes)
    );
    let (low, high) = summary.rms_sigma.unwrap();
    assert!(0.0 < low && low <= high && high < summary.max_sigma && summary.max_sigma <= 0.13);
}
