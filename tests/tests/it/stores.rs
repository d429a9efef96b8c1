//! Tests the store operations that data sets depend on, for folders, S3, Google's and Azure's
//! stores. Each is opened by its URL, as the program does.
//!
//! Clients take credentials and endpoints from the environment, so each store's suite runs in a
//! process of its own: this test binary again, with one ignored test.

use std::{collections::BTreeSet, env, process::Command, sync::Arc, time::Duration};

use futures::{StreamExt, TryStreamExt, future::join_all};
use object_store::{
    Error, GetOptions, GetRange, ObjectStore, ObjectStoreExt, PutMode, PutOptions, path::Path,
};
use picofarm_dataset::{Dataset, DatasetSpec, Profile};
use picofarm_store::{Fault, PROBE_WITHIN, StorageError, VerifyMode, open_store, probe};
use picofarm_tests::{Scratch, cloud::Cloud, s3};

#[path = "../../../storage/dataset/tests/it/common/scene.rs"]
#[allow(dead_code, reason = "the tests of data sets use the rest")]
mod common;

/// URL at which the suite runs.
const PLACE: &str = "PICOFARM_TEST_STORE";

/// Runs the suite at `url` in a process with these variables.
fn holds(url: &str, variables: &[(&str, &str)]) {
    let mut command = Command::new(env::current_exe().expect("this is a program"));
    command
        .args([
            "stores::what_data_sets_rest_on_holds",
            "--exact",
            "--ignored",
            "--nocapture",
        ])
        .env(PLACE, url)
        .envs(variables.iter().copied());
    let ended = command.output().expect("it can be started");
    assert!(
        ended.status.success(),
        "{url}: {}{}",
        String::from_utf8_lossy(&ended.stdout),
        String::from_utf8_lossy(&ended.stderr)
    );
    assert!(String::from_utf8_lossy(&ended.stdout).contains("1 passed"));
}

#[test]
fn a_folder_keeps_what_data_sets_rest_on() {
    let scratch = Scratch::new("store-folder");
    holds(&scratch.join("some sets").display().to_string(), &[]);
}

#[test]
fn s3_keeps_what_data_sets_rest_on() {
    let Some(server) = s3::Server::start("store-s3") else {
        return;
    };
    let url = format!("s3://{}/some/sets", server.bucket());
    holds(
        &url,
        &[
            ("AWS_ENDPOINT_URL", &server.endpoint()),
            ("AWS_ALLOW_HTTP", "true"),
            ("AWS_REGION", "us-east-1"),
            ("AWS_ACCESS_KEY_ID", s3::KEY),
            ("AWS_SECRET_ACCESS_KEY", s3::SECRET),
        ],
    );
}

#[test]
fn googles_store_keeps_what_data_sets_rest_on() {
    let cloud = Cloud::start(&["Bearer good-token"]);
    holds(
        "gs://lab/some/sets",
        &[
            ("GOOGLE_BASE_URL", &cloud.url()),
            ("GOOGLE_ALLOW_HTTP", "true"),
            ("GOOGLE_BEARER_TOKEN", "good-token"),
        ],
    );
}

#[test]
fn azures_store_keeps_what_data_sets_rest_on() {
    let cloud = Cloud::start(&["SharedKey lidar:"]);
    holds(
        "az://lab/some/sets",
        &[
            ("AZURE_STORAGE_ENDPOINT", &cloud.url()),
            ("AZURE_ALLOW_HTTP", "true"),
            ("AZURE_STORAGE_ACCOUNT_NAME", "lidar"),
            ("AZURE_STORAGE_ACCOUNT_KEY", "c2VjcmV0LWtleQ=="),
        ],
    );
}

/// A store and the prefix used in it.
#[derive(Clone)]
struct At {
    store: Arc<dyn ObjectStore>,
    prefix: Path,
}

impl At {
    fn key(&self, name: &str) -> Path {
        name.split('/')
            .fold(self.prefix.clone(), |path, part| path.join(part))
    }

    async fn put(&self, name: &str, bytes: &[u8]) {
        let key = self.key(name);
        let put = self.store.put(&key, bytes.to_vec().into());
        put.await.unwrap_or_else(|e| panic!("{name}: {e}"));
    }

    async fn get(&self, name: &str) -> Result<Vec<u8>, Error> {
        Ok(self
            .store
            .get(&self.key(name))
            .await?
            .bytes()
            .await?
            .to_vec())
    }

    async fn list(&self, name: &str) -> Vec<Path> {
        let found = self.store.list(Some(&self.key(name)));
        let found = found.map_ok(|meta| meta.location).try_collect();
        found.await.unwrap_or_else(|e| panic!("{name}: {e}"))
    }
}

#[test]
#[ignore = "the tests above run it, each at its store"]
fn what_data_sets_rest_on_holds() {
    let url = env::var(PLACE).expect("the tests above name a store");
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let (store, prefix) = open_store(&url).unwrap();
        let at = At { store, prefix };
        of_many_creators_one_succeeds_and_its_bytes_stay(&at).await;
        a_put_replaces_and_a_range_is_a_part(&at).await;
        what_is_missing_is_not_found(&at).await;
        names_mean_themselves(&at).await;
        a_list_is_whole_and_keeps_to_its_folder(&at).await;
        the_probe_passes_and_leaves_nothing(&at).await;
        scenes_come_back_and_damage_is_found(&at).await;
    });
}

async fn of_many_creators_one_succeeds_and_its_bytes_stay(at: &At) {
    let key = at.key("race/one");
    let creators = (0..16u8).map(|i| {
        let (store, key) = (at.store.clone(), key.clone());
        async move {
            let options = PutOptions::from(PutMode::Create);
            (i, store.put_opts(&key, vec![i; 2000].into(), options).await)
        }
    });
    let mut won = Vec::new();
    for (i, result) in join_all(creators).await {
        match result {
            Ok(_) => won.push(i),
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => {}
            Err(e) => panic!("creator {i}: {e}"),
        }
    }
    assert_eq!(won.len(), 1, "{won:?}");
    assert_eq!(at.get("race/one").await.unwrap(), vec![won[0]; 2000]);
}

async fn a_put_replaces_and_a_range_is_a_part(at: &At) {
    at.put("part/a", b"before").await;
    let bytes: Vec<u8> = (0..300_000u32).map(|i| (i % 251) as u8).collect();
    at.put("part/a", &bytes).await;
    assert_eq!(at.get("part/a").await.unwrap(), bytes);
    let key = at.key("part/a");
    assert_eq!(at.store.head(&key).await.unwrap().size, 300_000);
    for range in [0..1u64, 17..18, 250..100_000, 299_999..300_000] {
        let part = at.store.get_range(&key, range.clone()).await.unwrap();
        assert_eq!(part, bytes[range.start as usize..range.end as usize]);
    }
    let parts = at
        .store
        .get_ranges(&key, &[5..9, 200_000..200_007])
        .await
        .unwrap();
    assert_eq!(parts[0], bytes[5..9]);
    assert_eq!(parts[1], bytes[200_000..200_007]);
    let last = GetOptions {
        range: Some(GetRange::Suffix(10)),
        ..GetOptions::default()
    };
    // Azure does not support suffix ranges and returns an error.
    match at.store.get_opts(&key, last).await {
        Ok(found) => assert_eq!(found.bytes().await.unwrap(), bytes[299_990..]),
        Err(Error::NotSupported { .. }) => {}
        Err(e) => panic!("{e}"),
    }
    assert!(at.store.get_range(&key, 300_000..300_001).await.is_err());
}

async fn what_is_missing_is_not_found(at: &At) {
    at.put("gone/a", b"x").await;
    at.store.delete(&at.key("gone/a")).await.unwrap();
    for name in ["gone/a", "gone/b", "nowhere/at/all"] {
        let key = at.key(name);
        let missing = |e: Error| assert!(matches!(e, Error::NotFound { .. }), "{name}: {e}");
        missing(at.get(name).await.unwrap_err());
        missing(at.store.head(&key).await.unwrap_err());
        // A second deletion may succeed or report that there is no object.
        if let Err(e) = at.store.delete(&key).await {
            missing(e);
        }
    }
    assert!(at.list("nowhere").await.is_empty());
    assert!(at.list("gone").await.is_empty());
}

async fn names_mean_themselves(at: &At) {
    let names = ["a b", "50%", "x+y", "ümlaut", "a&b", "c/d/e", "%20", "a=b"];
    for name in names {
        at.put(&format!("names/{name}"), name.as_bytes()).await;
    }
    for name in names {
        assert_eq!(
            at.get(&format!("names/{name}")).await.unwrap(),
            name.as_bytes(),
            "{name}"
        );
    }
    let expected: BTreeSet<Path> = names
        .iter()
        .map(|n| at.key(&format!("names/{n}")))
        .collect();
    assert_eq!(BTreeSet::from_iter(at.list("names").await), expected);
}

async fn a_list_is_whole_and_keeps_to_its_folder(at: &At) {
    let many = (0..250).map(|i| (format!("list/rooms/c/{i}/0"), i));
    futures::stream::iter(many)
        .for_each_concurrent(
            8,
            |(name, i)| async move { at.put(&name, &vec![1; i]).await },
        )
        .await;
    at.put("list/rooms/zarr.json", b"{}").await;
    at.put("list/rooms2/zarr.json", b"{}").await;
    let found = at.list("list/rooms/c").await;
    assert_eq!(found.len(), 250);
    assert_eq!(BTreeSet::from_iter(found).len(), 250, "none twice");
    assert_eq!(
        at.list("list/rooms").await.len(),
        251,
        "rooms2 is another folder"
    );
    let listed = at
        .store
        .list_with_delimiter(Some(&at.key("list/rooms")))
        .await
        .unwrap();
    assert_eq!(listed.common_prefixes, [at.key("list/rooms/c")]);
    assert_eq!(listed.objects.len(), 1);
    assert_eq!(listed.objects[0].location, at.key("list/rooms/zarr.json"));
    let scenes = at
        .store
        .list_with_delimiter(Some(&at.key("list/rooms/c")))
        .await
        .unwrap();
    assert_eq!(scenes.common_prefixes.len(), 250);
    // Many at once, as when models and checkpoints are removed.
    let keys = at.list("list").await;
    let keys = futures::stream::iter(keys.into_iter().map(Ok)).boxed();
    let deleted: Vec<Path> = at.store.delete_stream(keys).try_collect().await.unwrap();
    assert_eq!(deleted.len(), 252);
    assert!(at.list("list").await.is_empty());
}

async fn the_probe_passes_and_leaves_nothing(at: &At) {
    probe(&*at.store, &at.key("probed"), PROBE_WITHIN)
        .await
        .unwrap();
    assert!(at.list("probed").await.is_empty());
}

async fn scenes_come_back_and_damage_is_found(at: &At) {
    let spec: DatasetSpec = common::spec(Profile::default());
    let open = || Dataset::create_or_open(at.store.clone(), at.key("rooms"), &spec);
    let missing = Dataset::open(at.store.clone(), at.key("rooms"))
        .await
        .unwrap_err();
    assert!(missing.to_string().contains("no data set"), "{missing}");
    // Several workers open it at once.
    let opened = join_all((0..4).map(|_| open())).await;
    let dataset = opened.into_iter().map(Result::unwrap).next_back().unwrap();
    let (_, memory) = common::in_memory(&spec).await;
    let provenance = common::provenance();
    for i in 0..3 {
        let scene = common::Scene::new(&spec, i);
        let ours = dataset
            .publish(i, &scene.record(), &provenance)
            .await
            .unwrap();
        let again = dataset
            .publish(i, &scene.record(), &provenance)
            .await
            .unwrap();
        let there = memory
            .publish(i, &scene.record(), &provenance)
            .await
            .unwrap();
        assert_eq!(
            (&ours, &ours),
            (&again, &there),
            "the same objects in every store"
        );
        let read = dataset.read_transient(i).await.unwrap();
        assert_eq!(read, memory.read_transient(i).await.unwrap());
        let crop = dataset.read_transient_crop(i, 3..9, 5..7).await.unwrap();
        assert_eq!(
            crop,
            memory.read_transient_crop(i, 3..9, 5..7).await.unwrap()
        );
    }
    assert_eq!(dataset.scenes_present().await.unwrap(), [0, 1, 2]);
    let other = common::Scene::new(&spec, 99);
    let conflict = dataset
        .publish(1, &other.record(), &provenance)
        .await
        .unwrap_err();
    assert!(
        matches!(conflict, StorageError::Conflict { .. }),
        "{conflict}"
    );
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
    let depth = at.list("rooms/depth/c/2").await.remove(0);
    at.store.delete(&depth).await.unwrap();
    at.put("rooms/range/c/1/0/0", b"torn").await;
    let report = dataset.verify(VerifyMode::Full).await.unwrap();
    let faults: Vec<_> = report
        .problems
        .iter()
        .map(|p| (p.scene, &p.fault))
        .collect();
    assert_eq!(faults.len(), 2, "{faults:?}");
    assert!(faults.contains(&(Some(2), &Fault::Missing)), "{faults:?}");
    // Publishing again restores missing objects; no other object is orphaned.
    let scene = common::Scene::new(&spec, 2);
    dataset
        .publish(2, &scene.record(), &provenance)
        .await
        .unwrap();
    let report = dataset.verify(VerifyMode::Fast).await.unwrap();
    assert_eq!(report.problems.len(), 1, "{report:?}");
    let collected = dataset
        .collect(Duration::from_secs(3600), false)
        .await
        .unwrap();
    assert_eq!(collected.bytes(), 0, "{collected:?}");
}
