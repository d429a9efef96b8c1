//! Publishing: create-only, repeatable, safe under races and kills; creation, growth and wrong places.

mod common;

use std::sync::Arc;

use common::*;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use picofarm_dataset::*;

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
    let DatasetError::Conflict {
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
    // Equal objects, other provenance: the manifest itself.
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
        Err(DatasetError::NotPublished { scene: 1, .. })
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
    spawnable(|d| d.published(0));
    spawnable(|d| d.manifest(0));
    spawnable(|d| d.scenes_present());
    spawnable(|d| d.read_transient(0));
    spawnable(|d| d.read_transient_crop(0, 0..1, 0..1));
    spawnable(|d| d.read::<f32>(0, Quantity::Depth));
    spawnable(|d| Dataset::open(d_store(d), Path::from("x")));
    spawnable(|d| Dataset::create_or_open(d_store(d), Path::from("x"), d.spec()));
    spawnable(|d| async { probe(&*d_store(d), d.prefix()).await });
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
        assert!(matches!(error, DatasetError::Conflict { .. }), "{error}");
    }
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
    assert!(
        local_leftovers(folder.path().to_str().unwrap(), std::time::Duration::ZERO)
            .unwrap()
            .is_empty()
    );
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
    let leftovers = local_leftovers(location, std::time::Duration::ZERO).unwrap();
    assert_eq!(leftovers, [torn]);
    assert!(
        local_leftovers(location, std::time::Duration::from_secs(3600))
            .unwrap()
            .is_empty()
    );
}

#[tokio::test]
async fn another_specification_is_refused_with_the_field_and_both_values() {
    let spec = spec(Profile::default());
    let (store, _) = in_memory(&spec).await;
    let prefix = Path::from("sets/a");
    let changes: [(&str, DatasetSpec); 4] = [
        (
            "gate.bins = 24, but 25",
            DatasetSpec {
                gate: Gate {
                    bins: 25,
                    ..spec.gate
                },
                ..spec
            },
        ),
        ("width = 40, but 41", DatasetSpec { width: 41, ..spec }),
        (
            "gate.start_m = 1, but 0.9",
            DatasetSpec {
                gate: Gate {
                    start_m: 0.9,
                    ..spec.gate
                },
                ..spec
            },
        ),
        (
            "profile = sqrt-u16 with delta 0.25, but plain-f32",
            DatasetSpec {
                profile: Profile::PlainF32,
                ..spec
            },
        ),
    ];
    for (words, other) in changes {
        let error = Dataset::create_or_open(store.clone(), prefix.clone(), &other)
            .await
            .unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
    }
    let bad = DatasetSpec { spots: 0, ..spec };
    let error = Dataset::create_or_open(store.clone(), prefix, &bad)
        .await
        .unwrap_err();
    assert!(
        error.to_string().starts_with("spec.spots: expected 1 to"),
        "{error}"
    );
    let error = Dataset::open(store, Path::from("elsewhere"))
        .await
        .unwrap_err();
    assert!(matches!(error, DatasetError::NoDataset { .. }));
}

#[tokio::test]
async fn a_data_set_grows_but_never_shrinks() {
    let small = spec(Profile::default());
    let (store, dataset) = in_memory(&small).await;
    let scene = Scene::new(&small, 1);
    dataset
        .publish(3, &scene.record(), &provenance())
        .await
        .unwrap();
    let prefix = Path::from("sets/a");
    let large = DatasetSpec { scenes: 9, ..small };
    let grown = Dataset::create_or_open(store.clone(), prefix.clone(), &large)
        .await
        .unwrap();
    grown
        .publish(8, &scene.record(), &provenance())
        .await
        .unwrap();
    let opened = Dataset::create_or_open(store.clone(), prefix.clone(), &small)
        .await
        .unwrap();
    assert_eq!(opened.spec().scenes, 9);
    assert_eq!(opened.scenes_present().await.unwrap(), [3, 8]);
    assert!(opened.verify(VerifyMode::Full).await.unwrap().is_sound());
}

#[tokio::test]
async fn an_interrupted_creation_is_completed_but_foreign_remains_are_not() {
    let spec = spec(Profile::default());
    let (store, _) = in_memory(&spec).await;
    let prefix = Path::from("sets/a");
    store.delete(&Path::from("sets/a/zarr.json")).await.unwrap();
    store
        .delete(&Path::from("sets/a/scale/zarr.json"))
        .await
        .unwrap();
    let other = DatasetSpec { height: 20, ..spec };
    let error = Dataset::create_or_open(store.clone(), prefix.clone(), &other)
        .await
        .unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("sets/a/transient/zarr.json: left by the interrupted creation"),
        "{error}"
    );
    let larger = DatasetSpec { scenes: 6, ..spec };
    let dataset = Dataset::create_or_open(store, prefix, &larger)
        .await
        .unwrap();
    assert!(dataset.verify(VerifyMode::Fast).await.unwrap().is_sound());
}

#[tokio::test]
async fn stores_are_opened_from_paths_and_file_urls_only() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a set");
    let (store, prefix) = open_store(path.to_str().unwrap()).unwrap();
    let spec = spec(Profile::default());
    Dataset::create_or_open(store, prefix, &spec).await.unwrap();
    assert!(path.join("zarr.json").is_file());
    let url = format!("file://{}", path.to_str().unwrap().replace(' ', "%20"));
    let (store, prefix) = open_store(&url).unwrap();
    assert_eq!(*Dataset::open(store, prefix).await.unwrap().spec(), spec);
    for (url, words) in [
        ("s3://bucket/a", "S3 is not supported by this version"),
        ("gs://bucket/a", "the scheme gs is not supported"),
        ("file://host/a", "expected file:///absolute/path"),
        ("", "expected a path, found nothing"),
    ] {
        let error = open_store(url).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    }
}

#[tokio::test]
async fn a_safe_store_passes_the_probe_and_nothing_is_left() {
    let folder = tempfile::tempdir().unwrap();
    let (store, prefix) = open_store(folder.path().to_str().unwrap()).unwrap();
    probe(&*store, &prefix).await.unwrap();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    let memory = object_store::memory::InMemory::new();
    probe(&memory, &Path::from("x")).await.unwrap();
}

/// A store that takes every put for an overwrite, as some S3 servers do.
#[derive(Debug)]
struct Forgetful(LocalFileSystem);

impl std::fmt::Display for Forgetful {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "forgetful")
    }
}

mod forgetful {
    use super::Forgetful;
    use futures::stream::BoxStream;
    use object_store::path::Path;
    use object_store::*;

    #[async_trait::async_trait]
    impl ObjectStore for Forgetful {
        async fn put_opts(
            &self,
            location: &Path,
            payload: PutPayload,
            _: PutOptions,
        ) -> Result<PutResult> {
            self.0
                .put_opts(location, payload, PutOptions::default())
                .await
        }
        async fn put_multipart_opts(
            &self,
            location: &Path,
            options: PutMultipartOptions,
        ) -> Result<Box<dyn MultipartUpload>> {
            self.0.put_multipart_opts(location, options).await
        }
        async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
            self.0.get_opts(location, options).await
        }
        fn delete_stream(
            &self,
            locations: BoxStream<'static, Result<Path>>,
        ) -> BoxStream<'static, Result<Path>> {
            self.0.delete_stream(locations)
        }
        fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
            self.0.list(prefix)
        }
        async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
            self.0.list_with_delimiter(prefix).await
        }
        async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
            self.0.copy_opts(from, to, options).await
        }
    }
}

#[tokio::test]
async fn a_store_without_conditional_puts_fails_the_probe() {
    let folder = tempfile::tempdir().unwrap();
    let store: Arc<dyn ObjectStore> = Arc::new(Forgetful(
        LocalFileSystem::new_with_prefix(folder.path()).unwrap(),
    ));
    let error = probe(&*store, &Path::from("x")).await.unwrap_err();
    assert!(
        error
            .to_string()
            .contains("a create-only put to an existing key succeeded"),
        "{error}"
    );
    assert_eq!(
        std::fs::read_dir(folder.path().join("x")).unwrap().count(),
        0
    );
}

#[cfg(target_os = "linux")]
#[tokio::test]
async fn a_place_that_cannot_be_written_is_named_with_a_hint() {
    // Not even root may create files there.
    let (store, prefix) = open_store("/sys/picofarm-dataset").unwrap();
    let error = Dataset::create_or_open(store.clone(), prefix.clone(), &spec(Profile::default()))
        .await
        .unwrap_err();
    let text = error.to_string();
    assert!(
        text.starts_with("cannot write sys/picofarm-dataset/transient/zarr.json (no permission"),
        "{text}"
    );
    assert!(matches!(
        probe(&*store, &prefix).await,
        Err(DatasetError::Store { .. })
    ));
    // Below a file.
    let file = tempfile::NamedTempFile::new().unwrap();
    let (store, prefix) = open_store(file.path().join("set").to_str().unwrap()).unwrap();
    let error = Dataset::create_or_open(store, prefix, &spec(Profile::default()))
        .await
        .unwrap_err();
    assert!(
        error.to_string().contains("a part of the path is a file"),
        "{error}"
    );
}
