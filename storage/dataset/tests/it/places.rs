//! Tests of locations of data sets: creation, growth, wrong locations, and untrustworthy stores.

use crate::common;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use common::tricky::{Moment, Tricky};
use common::*;
use object_store::local::LocalFileSystem;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use picofarm_dataset::*;
use picofarm_store::*;

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
            "profile = sqrt-u16 with delta 0.2, but lossless",
            DatasetSpec {
                profile: Profile::LOSSLESS,
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
    assert!(matches!(error, StorageError::NoDataset { .. }));
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
async fn of_two_that_grow_a_data_set_at_a_time_the_larger_number_stays_in_any_order() {
    let small = spec(Profile::default());
    let prefix = Path::from("sets/a");
    // How often has the first one looked at an object before the second one grows all of them?
    for moment in 0..20 {
        let memory = Arc::new(InMemory::new());
        Dataset::create_or_open(memory.clone(), prefix.clone(), &small)
            .await
            .unwrap();
        let puts = Arc::new(AtomicUsize::new(0));
        let (below, at, seen) = (memory.clone(), prefix.clone(), puts.clone());
        let tricky = Tricky::new(memory.clone()).acting(move |when, _| {
            let (below, at, seen) = (below.clone(), at.clone(), seen.clone());
            Box::pin(async move {
                if when != Moment::BeforePut || seen.fetch_add(1, Ordering::Relaxed) != moment {
                    return;
                }
                let larger = DatasetSpec {
                    scenes: 20,
                    ..small
                };
                Dataset::create_or_open(below, at, &larger).await.unwrap();
            })
        });
        let some = DatasetSpec { scenes: 9, ..small };
        Dataset::create_or_open(Arc::new(tricky), prefix.clone(), &some)
            .await
            .unwrap();
        let opened = Dataset::create_or_open(memory.clone(), prefix.clone(), &small)
            .await
            .unwrap();
        // Where the first was done by then, the second never began.
        let expected = match puts.load(Ordering::Relaxed) > moment {
            true => 20,
            false => 9,
        };
        assert_eq!(opened.spec().scenes, expected, "{moment}");
        assert!(moment > 0 || expected == 20);
        assert!(
            opened.verify(VerifyMode::Full).await.unwrap().is_sound(),
            "{moment}"
        );
    }
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
async fn local_stores_are_opened_from_paths_and_file_urls() {
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
        (
            "s3://Bucket/a",
            "a bucket name of 3 to 63 lower-case letters",
        ),
        ("ftp://host/a", "the scheme ftp is not supported"),
        ("file://host/a", "expected file:///absolute/path"),
        ("", "expected a path, found nothing"),
    ] {
        let error = open_store(url).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
        assert_eq!(check_location(url).unwrap_err().to_string(), error);
    }
}

#[tokio::test]
async fn a_safe_store_passes_the_probe_and_nothing_is_left() {
    let folder = tempfile::tempdir().unwrap();
    let (store, prefix) = open_store(folder.path().to_str().unwrap()).unwrap();
    probe(&*store, &prefix, PROBE_WITHIN).await.unwrap();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    let memory = object_store::memory::InMemory::new();
    probe(&memory, &Path::from("x"), PROBE_WITHIN)
        .await
        .unwrap();
}

/// A store that treats every put as an overwrite, as some S3 servers do.
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
    let error = probe(&*store, &Path::from("x"), PROBE_WITHIN)
        .await
        .unwrap_err();
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
    // Even root may not create files there.
    let (store, prefix) = open_store("/sys/picofarm-dataset").unwrap();
    let error = Dataset::create_or_open(store.clone(), prefix.clone(), &spec(Profile::default()))
        .await
        .unwrap_err();
    let text = error.to_string();
    assert!(
        text.starts_with("cannot write /sys/picofarm-dataset/transient/zarr.json (no permission"),
        "{text}"
    );
    assert!(matches!(
        probe(&*store, &prefix, PROBE_WITHIN).await,
        Err(StorageError::Store { .. })
    ));
    // A path below a file.
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
