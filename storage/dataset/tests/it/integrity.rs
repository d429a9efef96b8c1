//! Tests that every damage to every object is reported and repaired, that nothing is overwritten
//! without proof, and that snapshots do not change.

use crate::common;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use common::*;
use futures::TryStreamExt;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use picofarm_dataset::*;
use picofarm_store::*;
use proptest::prelude::*;
use serde_json::json;

const SCENES: u64 = 3;

type Objects = BTreeMap<String, Vec<u8>>;

async fn objects(store: &dyn ObjectStore) -> Objects {
    let mut all = Objects::new();
    for meta in store.list(None).try_collect::<Vec<_>>().await.unwrap() {
        let bytes = store.get(&meta.location).await.unwrap().bytes().await;
        all.insert(meta.location.to_string(), bytes.unwrap().to_vec());
    }
    all
}

fn encoded(dataset: &Dataset, scene: u64) -> EncodedScene {
    let made = Scene::new(dataset.spec(), scene);
    dataset
        .encode(scene, &made.record(), &provenance())
        .unwrap()
}

/// Returns a data set with three scenes, a recipe, a split and a snapshot.
async fn whole() -> (Arc<InMemory>, Dataset, Objects) {
    let memory = Arc::new(InMemory::new());
    let prefix = Path::from("sets/a");
    let spec = spec(Profile::default());
    let dataset = Dataset::create_or_open(memory.clone(), prefix, &spec)
        .await
        .unwrap();
    for scene in 0..SCENES {
        dataset
            .publish_encoded(encoded(&dataset, scene))
            .await
            .unwrap();
    }
    let recipe = json!({"stage": {"kind": "render"}});
    assert!(
        dataset
            .create_recipe(&"a".repeat(64), None, &recipe)
            .await
            .unwrap()
    );
    let split = b"{\n  \"settings\": {\n    \"name\": \"s\"\n  },\n  \"version\": 1\n}\n".to_vec();
    assert!(dataset.create_split("s", 1, split).await.unwrap());
    let snapshot = named(&dataset, "v1").await;
    dataset.create_snapshot(&snapshot).await.unwrap().unwrap();
    let all = objects(&*memory).await;
    (memory, dataset, all)
}

async fn named(dataset: &Dataset, name: &str) -> Snapshot {
    let present = dataset.present(&|_, _| {}).await.unwrap();
    present.named(name, "2026-01-01T00:00:00Z")
}

fn runtime() -> tokio::runtime::Runtime {
    let mut builder = tokio::runtime::Builder::new_current_thread();
    builder.enable_all().build().unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn a_flipped_truncated_deleted_or_swapped_object_is_named_and_restored(
        at in any::<prop::sample::Index>(),
        with in any::<prop::sample::Index>(),
        bit in any::<prop::sample::Index>(),
        harm in 0..4,
    ) {
        runtime().block_on(async {
            let (memory, dataset, all) = whole().await;
            let keys: Vec<&String> = all.keys().collect();
            let key = keys[at.index(keys.len())];
            let path = Path::from(key.as_str());
            let mut bytes = all[key].clone();
            match harm {
                0 => {
                    let bit = bit.index(bytes.len() * 8);
                    bytes[bit / 8] ^= 1 << (bit % 8);
                }
                1 => bytes.truncate(bit.index(bytes.len())),
                2 => bytes.clear(),
                _ => bytes.clone_from(&all[keys[with.index(keys.len())]]),
            }
            if bytes == all[key] {
                return;
            }
            let cut = bytes.clone();
            match harm {
                2 => memory.delete(&path).await.unwrap(),
                _ => memory.put(&path, bytes.into()).await.map(drop).unwrap(),
            }
            let Ok(opened) = Dataset::open(memory.clone(), Path::from("sets/a")).await else {
                // Opening it needs only the root's metadata.
                assert_eq!(key, "sets/a/zarr.json");
                let restored = restore_root(memory.clone(), Path::from("sets/a"), dataset.spec()).await;
                restored.unwrap();
                assert_eq!(objects(&*memory).await, all);
                return;
            };
            // A missing record is only noticed by its owner.
            let record = ["/recipes/", "/snapshots/", "/splits/"].iter().any(|f| key.contains(f));
            let options = VerifyOptions { complete: true, ..VerifyOptions::new(VerifyMode::Full) };
            let report = opened.verify_with(&options).await.unwrap();
            let mut said = report.problems.iter().filter(|p| p.object == *key);
            if record && harm == 2 {
                assert_eq!(said.next(), None);
                return;
            }
            // gzip has bits without meaning: those of its date.
            if key.contains("/snapshots/") && harm == 0 && report.problems.iter().all(|p| p.object != *key) {
                let found = opened.snapshot("v1").await.unwrap();
                assert_eq!(found, named(&dataset, "v1").await, "a bit that means something was not named");
                return;
            }
            // Metadata without its final newline is equivalent.
            let says = |bytes: &[u8]| serde_json::from_slice::<serde_json::Value>(bytes).ok();
            if key.ends_with("/zarr.json") && harm == 1 && says(&cut) == says(&all[key]) {
                assert_eq!(said.next(), None);
                return;
            }
            let problem = said.next().unwrap_or_else(|| panic!("{key} in {report:?}"));
            match problem.scene {
                Some(scene) => {
                    let restored = opened.restore(encoded(&opened, scene), None).await.unwrap();
                    assert_eq!(&restored.written[..], std::slice::from_ref(key));
                }
                None if record => return,
                None if key == "sets/a/zarr.json" => {
                    opened.restore_metadata().await.unwrap_err();
                    let restored = restore_root(memory.clone(), Path::from("sets/a"), dataset.spec()).await;
                    restored.unwrap();
                }
                None => {
                    let written = opened.restore_metadata().await.unwrap();
                    assert_eq!(&written[..], std::slice::from_ref(key));
                }
            }
            assert_eq!(objects(&*memory).await, all);
        });
    }
}

#[tokio::test]
async fn another_scene_is_an_alarm_and_overwrites_nothing() {
    let (memory, dataset, _) = whole().await;
    let key = Path::from("sets/a/depth/c/1/0/0");
    memory.put(&key, "broken".into()).await.unwrap();
    let before = objects(&*memory).await;
    let made = Scene::new(dataset.spec(), 77);
    let other = dataset.encode(1, &made.record(), &provenance()).unwrap();
    let alarm = dataset.restore(other.clone(), None).await.unwrap_err();
    assert!(matches!(alarm, StorageError::Diverged { .. }), "{alarm}");
    // Without the manifest, the other objects contradict it.
    memory
        .delete(&Path::from("sets/a/manifests/1.json"))
        .await
        .unwrap();
    let refused = dataset.restore(other.clone(), None).await.unwrap_err();
    assert!(refused.to_string().contains("nothing proves"), "{refused}");
    // The correct scene is not accepted either in that case: the snapshot must confirm it.
    let right = encoded(&dataset, 1);
    dataset.restore(right.clone(), None).await.unwrap_err();
    let snapshot = dataset.snapshot("v1").await.unwrap();
    let witness = snapshot.manifest_sha256(1).unwrap();
    let alarm = dataset.restore(other, Some(&witness)).await.unwrap_err();
    assert!(matches!(alarm, StorageError::Diverged { .. }), "{alarm}");
    let mut now = objects(&*memory).await;
    now.insert(
        "sets/a/manifests/1.json".into(),
        before["sets/a/manifests/1.json"].clone(),
    );
    assert_eq!(now, before);
    let restored = dataset.restore(right, Some(&witness)).await.unwrap();
    assert_eq!(restored.written.len(), 2);
    assert_eq!(restored.manifest_sha256, witness);
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
}

#[tokio::test]
async fn manifests_from_before_there_were_checksums_stay_as_they_are() {
    let (memory, dataset, _) = whole().await;
    let ours = dataset.manifest(0).await.unwrap();
    let older = Manifest {
        checksum: None,
        ..ours.clone()
    };
    let key = Path::from("sets/a/manifests/0.json");
    memory.put(&key, older.to_bytes().into()).await.unwrap();
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
    assert_eq!(
        dataset.publish_encoded(encoded(&dataset, 0)).await.unwrap(),
        older
    );
    // A broken object of the scene is repaired; the manifest is not changed.
    let object = Path::from("sets/a/rgb/c/0/0/0/0");
    memory.put(&object, "broken".into()).await.unwrap();
    let restored = dataset.restore(encoded(&dataset, 0), None).await.unwrap();
    assert_eq!(restored.written, ["sets/a/rgb/c/0/0/0/0"]);
    assert_eq!(dataset.manifest(0).await.unwrap(), older);
    // A changed manifest has no checksum to reveal it, but its scene does not exist.
    let mut changed = older;
    changed.objects[3].sha256 = "0".repeat(64);
    memory.put(&key, changed.to_bytes().into()).await.unwrap();
    assert!(!dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
    let restored = dataset.restore(encoded(&dataset, 0), None).await.unwrap();
    assert_eq!(restored.written, ["sets/a/manifests/0.json"]);
    assert_eq!(dataset.manifest(0).await.unwrap(), ours);
}

#[tokio::test]
async fn a_snapshot_pins_what_there_was_and_says_what_changed() {
    let (memory, dataset, all) = whole().await;
    let first = dataset.snapshot("v1").await.unwrap();
    assert_eq!(first.scenes().collect::<Vec<_>>(), [0, 1, 2]);
    dataset.publish_encoded(encoded(&dataset, 3)).await.unwrap();
    memory
        .delete(&Path::from("sets/a/manifests/1.json"))
        .await
        .unwrap();
    let now = named(&dataset, "v2").await;
    let expected = Difference {
        added: vec![3],
        removed: vec![1],
        changed: vec![],
        same: 2,
    };
    assert_eq!(first.difference(&now), expected);
    assert_ne!(first.id(), now.id());
    // Its scenes are neither collected nor forgotten.
    let found = dataset.collect(Duration::ZERO, true).await.unwrap();
    assert_eq!((found.orphans.len(), found.pinned), (0, 15));
    let options = VerifyOptions {
        snapshot: Some(&first),
        ..VerifyOptions::new(VerifyMode::Fast)
    };
    let report = dataset.verify_with(&options).await.unwrap();
    let [
        Problem {
            scene: Some(1),
            fault: Fault::Missing,
            ..
        },
    ] = &report.problems[..]
    else {
        panic!("{report:?}")
    };
    dataset.restore(encoded(&dataset, 1), None).await.unwrap();
    assert!(dataset.verify_with(&options).await.unwrap().is_sound());
    let kept = objects(&*memory).await;
    assert!(all.iter().all(|(key, bytes)| kept.get(key) == Some(bytes)));
    // A name is used only once; creating the same snapshot again changes nothing.
    assert_eq!(dataset.create_snapshot(&first).await.unwrap(), None);
    let error = dataset.create_snapshot(&now.named("v1", "later")).await;
    assert!(error.unwrap_err().to_string().contains("another snapshot"));
}
