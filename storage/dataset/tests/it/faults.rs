//! Tests of publishing with lost and repeated answers, and with a collector running at every
//! moment.

use crate::common;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use common::tricky::{Fate, Moment, Tricky};
use common::*;
use futures::TryStreamExt;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::throttle::{ThrottleConfig, ThrottledStore};
use object_store::{ObjectStore, ObjectStoreExt};
use picofarm_dataset::*;
use picofarm_store::*;
use proptest::prelude::*;

type Objects = BTreeMap<String, Vec<u8>>;

async fn objects(store: &dyn ObjectStore) -> Objects {
    let mut all = Objects::new();
    for meta in store.list(None).try_collect::<Vec<_>>().await.unwrap() {
        let bytes = store
            .get(&meta.location)
            .await
            .unwrap()
            .bytes()
            .await
            .unwrap();
        all.insert(meta.location.to_string(), bytes.to_vec());
    }
    all
}

/// Returns a data set with these scenes published, its memory and its objects.
async fn whole(scenes: &[u64]) -> (Arc<InMemory>, Dataset, Objects) {
    let spec = spec(Profile::default());
    let memory = Arc::new(InMemory::new());
    let dataset = Dataset::create_or_open(memory.clone(), Path::from("sets/a"), &spec)
        .await
        .unwrap();
    for scene in scenes {
        dataset
            .publish_encoded(encoded(&dataset, *scene))
            .await
            .unwrap();
    }
    let all = objects(&*memory).await;
    (memory, dataset, all)
}

fn encoded(dataset: &Dataset, scene: u64) -> EncodedScene {
    let made = Scene::new(dataset.spec(), scene);
    dataset
        .encode(scene, &made.record(), &provenance())
        .unwrap()
}

async fn opened(store: Tricky) -> Dataset {
    Dataset::open(Arc::new(store), Path::from("sets/a"))
        .await
        .unwrap()
}

fn runtime() -> tokio::runtime::Runtime {
    let mut builder = tokio::runtime::Builder::new_current_thread();
    builder.enable_all().build().unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn publishing_again_after_lost_repeated_and_dropped_puts_ends_with_the_same_objects(seed in any::<u64>()) {
        runtime().block_on(async {
            let (_, _, undisturbed) = whole(&[0]).await;
            let (memory, plain, _) = whole(&[]).await;
            let mut random = Lcg(seed);
            let fates = [Fate::Good, Fate::Good, Fate::Lost, Fate::Dropped, Fate::Repeated];
            let decide = move |_: &Path| fates[(random.next() * 5.0) as usize];
            let dataset = opened(Tricky::new(memory.clone()).deciding(decide)).await;
            let scene = encoded(&dataset, 0);
            let mut tries = 0;
            let manifest = loop {
                match dataset.publish_encoded(scene.clone()).await {
                    Ok(manifest) => break manifest,
                    Err(error) => assert!(matches!(error, StorageError::Store { .. }), "{error}"),
                }
                tries += 1;
                assert!(tries < 1000);
            };
            assert_eq!(plain.published(0).await.unwrap(), Some(manifest));
            assert_eq!(objects(&*memory).await, undisturbed);
        });
    }

    #[test]
    fn a_probe_whose_answers_are_lost_never_calls_a_safe_store_unsafe_and_leaves_nothing(seed in any::<u64>()) {
        runtime().block_on(async {
            let memory = Arc::new(InMemory::new());
            let mut random = Lcg(seed);
            let decide = move |_: &Path| if random.next() < 0.1 { Fate::Repeated } else { Fate::Good };
            let store = Tricky::new(memory.clone()).deciding(decide);
            match probe(&store, &Path::from("sets"), PROBE_WITHIN).await {
                Ok(()) | Err(StorageError::Store { .. }) => {}
                Err(error) => panic!("{error}"),
            }
            assert!(objects(&*memory).await.is_empty());
        });
    }

    #[test]
    fn whatever_is_missing_or_left_over_collecting_keeps_what_manifests_name(seed in any::<u64>()) {
        runtime().block_on(async {
            let (memory, dataset, all) = whole(&[0, 1, 2, 3]).await;
            let mut random = Lcg(seed);
            for key in all.keys().filter(|key| !key.ends_with("zarr.json")) {
                let manifest = key.contains("manifests/");
                if random.next() < if manifest { 0.5 } else { 0.1 } {
                    memory.delete(&Path::from(key.as_str())).await.unwrap();
                }
            }
            // Foreign objects are never deleted, whether inside or outside of the data set, or of a
            // scene beyond its capacity.
            for key in ["sets/a/notes.txt", "sets/a/depth/c/0/0/1", "sets/a/depth/c/9/0/0", "sets/b/x", "sets/y"] {
                memory.put(&Path::from(key), key.into()).await.unwrap();
            }
            memory.put(&Path::from("sets/.probe-1-race"), "old".into()).await.unwrap();
            let before = dataset.verify(VerifyMode::Full).await.unwrap();
            let held = objects(&*memory).await;

            let young = dataset.collect(MIN_GRACE, true).await.unwrap();
            assert_eq!((young.orphans.len(), young.young), (0, before.unpublished.len() as u64));
            let dry = dataset.collect(Duration::ZERO, false).await.unwrap();
            assert_eq!(objects(&*memory).await, held);
            let done = dataset.collect(Duration::ZERO, true).await.unwrap();
            assert_eq!(done, dry);

            let mut expected = before.unpublished.clone();
            expected.push("sets/.probe-1-race".into());
            expected.sort();
            let names: Vec<_> = done.orphans.iter().map(|o| o.object.clone()).collect();
            assert_eq!(names, expected);
            let mut left = held;
            left.retain(|key, _| !expected.contains(key));
            assert_eq!(objects(&*memory).await, left);
            let after = dataset.verify(VerifyMode::Full).await.unwrap();
            assert_eq!(after, Verification { unpublished: vec![], unfinished: vec![], ..before });
        });
    }
}

#[tokio::test(start_paused = true)]
async fn a_probe_ends_in_time_where_a_store_stalls_and_leaves_nothing() {
    let slow = Duration::from_secs(60);
    for stalls in ["put", "get", "delete"] {
        let memory = InMemory::new();
        let config = ThrottleConfig {
            wait_put_per_call: if stalls == "put" {
                slow
            } else {
                Duration::ZERO
            },
            wait_get_per_call: if stalls == "get" {
                slow
            } else {
                Duration::ZERO
            },
            wait_delete_per_call: if stalls == "delete" {
                slow
            } else {
                Duration::ZERO
            },
            ..ThrottleConfig::default()
        };
        let store = ThrottledStore::new(memory, config);
        let begun = tokio::time::Instant::now();
        let answer = probe(&store, &Path::from("sets"), Duration::from_secs(8)).await;
        assert!(begun.elapsed() < Duration::from_secs(20), "{stalls}");
        let error = answer.unwrap_err().to_string();
        let expected = match stalls {
            "delete" => "it did not delete within 5 s",
            _ => "it did not answer within 8 s",
        };
        assert!(error.contains(expected), "{stalls}: {error}");
        store.config_mut(|config| *config = ThrottleConfig::default());
        let left = objects(&store).await;
        assert_eq!(left.is_empty(), stalls != "delete", "{stalls}: {left:?}");
    }
}

/// A worker was killed before it wrote the manifest of scene 0; another one publishes the scene at
/// `moment` of a collection.
async fn published_while_collecting(moment: Moment) {
    let (memory, dataset, all) = whole(&[0, 1]).await;
    memory
        .delete(&Path::from("sets/a/manifests/0.json"))
        .await
        .unwrap();
    let scene = encoded(&dataset, 0);
    let happened = Arc::new(AtomicBool::new(false));
    let done = happened.clone();
    let publisher = dataset.clone();
    let act = move |now, path: Path| -> futures::future::BoxFuture<'static, ()> {
        let (publisher, scene) = (publisher.clone(), scene.clone());
        let first =
            now == moment && path.as_ref().contains("/c/0/") && !done.swap(true, Ordering::Relaxed);
        Box::pin(async move {
            if first {
                publisher.publish_encoded(scene).await.unwrap();
            }
        })
    };
    let collector = opened(Tricky::new(memory.clone()).acting(act)).await;
    let report = collector.collect(Duration::ZERO, true).await.unwrap();
    assert!(happened.load(Ordering::Relaxed), "{report:?}");
    assert_eq!((report.orphans.len(), report.published), (0, 15));
    assert_eq!(objects(&*memory).await, all);
}

#[tokio::test]
async fn a_scene_published_while_it_is_collected_keeps_its_objects() {
    published_while_collecting(Moment::BeforeDelete).await;
    published_while_collecting(Moment::AfterDelete).await;
}

#[tokio::test]
async fn a_publisher_whose_objects_are_collected_before_its_manifest_puts_them_again() {
    let (memory, dataset, all) = whole(&[0, 1]).await;
    memory
        .delete(&Path::from("sets/a/manifests/0.json"))
        .await
        .unwrap();
    let scene = encoded(&dataset, 0);
    let act = move |now, path: Path| -> futures::future::BoxFuture<'static, ()> {
        let dataset = dataset.clone();
        Box::pin(async move {
            if now == Moment::BeforePut && path.as_ref().ends_with("manifests/0.json") {
                let report = dataset.collect(Duration::ZERO, true).await.unwrap();
                assert_eq!(report.orphans.len(), 15);
            }
        })
    };
    let publisher = opened(Tricky::new(memory.clone()).acting(act)).await;
    publisher.publish_encoded(scene).await.unwrap();
    assert_eq!(objects(&*memory).await, all);
}
