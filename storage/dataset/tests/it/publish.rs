//! Tests of publishing: create-only, repeatable, safe under races and kills.

use crate::common;

use std::sync::Arc;
use std::time::Duration;

use common::*;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use picofarm_dataset::*;
use picofarm_store::*;

#[test]
fn the_bytes_do_not_depend_on_the_number_of_threads() {
    for profile in PROFILES {
        let spec = spec(profile);
        let scene = Scene::new(&spec, 5);
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let (_, dataset) = runtime.block_on(in_memory(&spec));
        let manifest = |threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            let encode = || dataset.encode(1, &scene.record(), &provenance()).unwrap();
            pool.install(encode).manifest
        };
        assert_eq!(manifest(1), manifest(4));
    }
}

#[tokio::test]
async fn publishing_twice_succeeds_and_changes_nothing() {
    let spec = spec(Profile::default());
    let (_, dataset) = in_memory(&spec).await;
    let scene = Scene::new(&spec, 1);
    assert_eq!(dataset.published(1).await.unwrap(), None);
    let first = dataset
        .publish(1, &scene.record(), &provenance())
        .await
        .unwrap();
    let second = dataset
        .publish(1, &scene.record(), &provenance())
        .await
        .unwrap();
    assert_eq!(first, second);
    assert_eq!(dataset.published(1).await.unwrap(), Some(first));
}

#[tokio::test]
async fn publishing_something_else_is_a_conflict_that_names_the_object() {
    let spec = spec(Profile::default());
    let (_, dataset) = in_memory(&spec).await;
    let mut scene = Scene::new(&spec, 1);
    let manifest = dataset
        .publish(1, &scene.record(), &provenance())
        .await
        .unwrap();
    scene.depth[3] += 1.0;
    let error = dataset
        .publish(1, &scene.record(), &provenance())
        .await
        .unwrap_err();
    let StorageError::Conflict {
        object,
        stored,
        ours,
    } = &error
    else {
        panic!("{error}")
    };
    assert_eq!(object, "sets/a/depth/c/1/0/0");
    assert_eq!(*stored, manifest.objects[2].sha256);
    assert_ne!(stored, ours);
    // Equal objects with another provenance: the manifest itself conflicts.
    scene.depth[3] -= 1.0;
    let mut other = provenance();
    other.seed += 1;
    let scene = Scene::new(&spec, 1);
    let error = dataset
        .publish(1, &scene.record(), &other)
        .await
        .unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("conflict at sets/a/manifests/1.json"),
        "{error}"
    );
    assert_eq!(dataset.published(1).await.unwrap(), Some(manifest));
}

#[tokio::test]
async fn a_scene_half_written_by_a_killed_worker_is_completed() {
    let spec = spec(Profile::default());
    let (store, dataset) = in_memory(&spec).await;
    let scene = Scene::new(&spec, 1);
    let manifest = dataset
        .publish(1, &scene.record(), &provenance())
        .await
        .unwrap();
    store
        .delete(&Path::from("sets/a/manifests/1.json"))
        .await
        .unwrap();
    for gone in &manifest.objects[4..9] {
        store
            .delete(&Path::from(format!("sets/a/{}", gone.key)))
            .await
            .unwrap();
    }
    assert_eq!(dataset.published(1).await.unwrap(), None);
    assert!(matches!(
        dataset.manifest(1).await,
        Err(StorageError::NotPublished { scene: 1, .. })
    ));
    let report = dataset.verify(VerifyMode::Full).await.unwrap();
    assert!(
        report.is_sound() && report.unpublished.len() == 10,
        "{report:?}"
    );
    let again = dataset
        .publish(1, &scene.record(), &provenance())
        .await
        .unwrap();
    assert_eq!(again, manifest);
    assert_eq!(dataset.published(1).await.unwrap(), Some(manifest.clone()));
    // An object lost after publication is reported, and restored by publishing again.
    store
        .delete(&Path::from("sets/a/rgb/c/1/0/0/0"))
        .await
        .unwrap();
    let error = dataset.published(1).await.unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("sets/a/rgb/c/1/0/0/0: the object is missing"),
        "{error}"
    );
    dataset
        .publish(1, &scene.record(), &provenance())
        .await
        .unwrap();
    assert_eq!(dataset.published(1).await.unwrap(), Some(manifest));
}

#[test]
fn every_operation_can_be_spawned() {
    fn spawnable<F: Future + Send>(_: impl Fn(&'static Dataset) -> F) {}
    spawnable(|d| d.verify(VerifyMode::Fast));
    spawnable(|d| d.info());
    spawnable(|d| d.collect(Duration::ZERO, true));
    spawnable(|d| d.published(0));
    spawnable(|d| d.manifest(0));
    spawnable(|d| d.scenes_present());
    spawnable(|d| d.read_transient(0));
    spawnable(|d| d.read_transient_crop(0, 0..1, 0..1));
    spawnable(|d| d.read::<f32>(0, Quantity::Depth));
    spawnable(|d| Dataset::open(d_store(d), Path::from("x")));
    spawnable(|d| Dataset::create_or_open(d_store(d), Path::from("x"), d.spec()));
    spawnable(|d| async { probe(&*d_store(d), d.prefix(), PROBE_WITHIN).await });
    fn d_store(_: &Dataset) -> Arc<dyn ObjectStore> {
        Arc::new(object_store::memory::InMemory::new())
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn racing_publishers_of_the_same_task_all_succeed_and_of_different_ones_conflict() {
    let folder = tempfile::tempdir().unwrap();
    let (store, prefix) = open_store(folder.path().join("set one").to_str().unwrap()).unwrap();
    let spec = spec(Profile::default());
    let dataset = Dataset::create_or_open(store.clone(), prefix, &spec)
        .await
        .unwrap();
    let same = dataset
        .encode(0, &Scene::new(&spec, 1).record(), &provenance())
        .unwrap();
    let race = (0..8).map(|_| {
        let (dataset, scene) = (dataset.clone(), same.clone());
        tokio::spawn(async move { dataset.publish_encoded(scene).await })
    });
    for result in futures::future::join_all(race).await {
        assert_eq!(result.unwrap().unwrap(), same.manifest);
    }
    let different = (1..5).map(|seed| {
        let scene = dataset
            .encode(1, &Scene::new(&spec, seed).record(), &provenance())
            .unwrap();
        let dataset = dataset.clone();
        tokio::spawn(async move { dataset.publish_encoded(scene).await })
    });
    let results: Vec<_> = futures::future::join_all(different)
        .await
        .into_iter()
        .map(Result::unwrap)
        .collect();
    let winners = results.iter().filter(|r| r.is_ok()).count();
    assert!(winners <= 1);
    for error in results.iter().filter_map(|r| r.as_ref().err()) {
        assert!(matches!(error, StorageError::Conflict { .. }), "{error}");
    }
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
    // If each encountered an object of the other, none succeeded, and their objects are orphans.
    let left = dataset.collect(Duration::ZERO, false).await.unwrap();
    assert_eq!(left.orphans.is_empty(), winners == 1, "{left:?}");
}

#[tokio::test]
async fn what_broken_puts_have_left_is_replaced_when_the_scene_is_published_again() {
    let spec = spec(Profile::default());
    let (store, dataset) = in_memory(&spec).await;
    let scene = Scene::new(&spec, 1);
    let publish = async || dataset.publish(1, &scene.record(), &provenance()).await;
    let manifest = publish().await.unwrap();
    let at = |key: &str| Path::from(format!("{}/{key}", dataset.prefix()));
    let file = at("manifests/1.json");
    for object in &manifest.objects {
        let path = at(&object.key);
        let whole = store.get(&path).await.unwrap().bytes().await.unwrap();
        let mut flipped = whole.to_vec();
        flipped[whole.len() / 2] ^= 0x10;
        for broken in [flipped, whole[..whole.len() / 2].to_vec(), Vec::new()] {
            // With the manifest that proves the original content, and before it exists.
            for published in [true, false] {
                if !published {
                    store.delete(&file).await.unwrap();
                }
                store.put(&path, broken.clone().into()).await.unwrap();
                assert_eq!(publish().await.unwrap(), manifest, "{}", object.key);
                let now = store.get(&path).await.unwrap().bytes().await.unwrap();
                assert_eq!(now, whole, "{}", object.key);
            }
        }
    }
    store.put(&file, "{".into()).await.unwrap();
    assert_eq!(publish().await.unwrap(), manifest);
    // If the data set's folder itself is used as a store, it has an identity.
    identify_store(&*store, dataset.prefix()).await.unwrap();
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
}

#[tokio::test]
async fn files_left_by_a_killed_local_put_disturb_nobody_and_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let location = folder.path().to_str().unwrap();
    let (store, prefix) = open_store(location).unwrap();
    let spec = spec(Profile::default());
    let dataset = Dataset::create_or_open(store, prefix, &spec).await.unwrap();
    let torn = folder.path().join("depth/c/0/0/0#1");
    std::fs::create_dir_all(torn.parent().unwrap()).unwrap();
    std::fs::write(&torn, b"half a wri").unwrap();
    dataset
        .publish(0, &Scene::new(&spec, 1).record(), &provenance())
        .await
        .unwrap();
    let report = dataset.verify(VerifyMode::Full).await.unwrap();
    assert!(
        report.is_sound() && report.unpublished.is_empty(),
        "{report:?}"
    );
    let found = |grace| dataset.collect(grace, false);
    let leftovers = found(Duration::ZERO).await.unwrap().orphans;
    let [
        Orphan {
            object,
            bytes,
            scene: None,
            cause: OrphanCause::Write,
        },
    ] = &leftovers[..]
    else {
        panic!("{leftovers:?}")
    };
    assert_eq!((object.as_str(), *bytes), (torn.to_str().unwrap(), 10));
    assert!(found(MIN_GRACE).await.unwrap().orphans.is_empty());
    dataset.collect(Duration::ZERO, true).await.unwrap();
    assert!(!torn.exists());
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
}

/// Returns a made-up manifest of scene 0, with its checksum.
fn made_up(true_manifest: &Manifest) -> Manifest {
    let mut made_up = true_manifest.clone();
    for object in &mut made_up.objects {
        object.sha256 = "ab".repeat(32);
    }
    made_up.sealed()
}

#[tokio::test]
async fn a_made_up_manifest_gives_way_to_the_scene_and_a_true_one_does_not() {
    for with_objects in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let (store, prefix) = open_store(folder.path().to_str().unwrap()).unwrap();
        let spec = spec(Profile::default());
        let dataset = Dataset::create_or_open(store, prefix, &spec).await.unwrap();
        let encode = |seed| {
            let scene = Scene::new(&spec, seed);
            dataset.encode(0, &scene.record(), &provenance()).unwrap()
        };
        let honest = dataset.publish_encoded(encode(1)).await.unwrap();
        let manifest = folder.path().join("manifests/0.json");
        std::fs::write(&manifest, made_up(&honest).to_bytes()).unwrap();
        for object in honest.objects.iter().filter(|_| !with_objects) {
            std::fs::remove_file(folder.path().join(&object.key)).unwrap();
        }
        let conflict = dataset.publish_encoded(encode(1)).await.unwrap_err();
        assert!(
            matches!(conflict, StorageError::Conflict { .. }),
            "{conflict}"
        );
        let replaced = dataset.replace_unfounded(encode(1)).await.unwrap().unwrap();
        assert_eq!(replaced, honest);
        assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
        // Another result of the same scene does not replace an intact one.
        assert_eq!(dataset.replace_unfounded(encode(2)).await.unwrap(), None);
        assert_eq!(dataset.published(0).await.unwrap(), Some(honest));
    }
}
