//! The laws of published results, for numbered and for named ones.

use std::collections::BTreeMap;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};

use bytes::Bytes;
use futures::{FutureExt, TryStreamExt};
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use picofarm_store::published::{Examine, Manifest, Published, ResultId};
use picofarm_store::sealed::{read_sealed, seal};
use picofarm_store::{Fault, ObjectEntry, StorageError, VerifyMode, sha256_hex};
use serde::{Deserialize, Serialize};

use crate::tricky::{Fate, Moment, Tricky};

/// A manifest with nothing of its own.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Plain<Id> {
    format: u32,
    id: Id,
    task_key: String,
    objects: Vec<ObjectEntry>,
}

/// An identifier that the laws can make up.
trait AnyId: ResultId + Serialize + for<'a> Deserialize<'a> + std::fmt::Debug + 'static {
    fn any(number: u64) -> Self;
    fn key(&self, file: &str) -> String;
}

impl AnyId for u64 {
    fn any(number: u64) -> Self {
        number
    }
    fn key(&self, file: &str) -> String {
        format!("{file}/c/{self}")
    }
}

impl AnyId for String {
    fn any(number: u64) -> Self {
        format!("result-{number}")
    }
    fn key(&self, file: &str) -> String {
        file.to_owned()
    }
}

impl<Id: AnyId> Manifest for Plain<Id> {
    type Id = Id;

    fn parse(bytes: &[u8], id: &Id, object: &str) -> Result<Self, StorageError> {
        let manifest: Self = read_sealed(bytes, "a manifest", 1, object)?;
        match manifest.id == *id {
            true => Ok(manifest),
            false => Err(StorageError::Damaged {
                object: object.to_owned(),
                what: format!("is that of {:?}", manifest.id),
            }),
        }
    }

    fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self).unwrap();
        bytes.push(b'\n');
        seal(&bytes)
    }

    fn objects(&self) -> &[ObjectEntry] {
        &self.objects
    }

    fn task_key(&self) -> &str {
        &self.task_key
    }

    fn taken(&self, place: &str, task_key: &str) -> StorageError {
        let what = format!("{place} belongs to {}, not to {task_key}", self.task_key);
        StorageError::invalid("output", what)
    }
}

fn made<Id: AnyId>(id: &Id, task_key: &str, files: &[(&str, &str)]) -> (Plain<Id>, Vec<Bytes>) {
    let entry = |(file, text): &(&str, &str)| ObjectEntry {
        key: id.key(file),
        size: text.len() as u64,
        sha256: sha256_hex(text.as_bytes()),
    };
    let manifest = Plain {
        format: 1,
        id: id.clone(),
        task_key: task_key.to_owned(),
        objects: files.iter().map(entry).collect(),
    };
    let bytes = files.iter().map(|(_, text)| Bytes::from(text.to_string()));
    (manifest, bytes.collect())
}

/// Finds fault with the second object.
struct NoSecond;

impl<Id: AnyId> Examine<Plain<Id>> for NoSecond {
    fn manifest(&self, manifest: &Plain<Id>) -> Option<String> {
        (manifest.objects.len() > 1).then(|| "has a second".into())
    }

    fn object(&self, _: &Plain<Id>, _: &ObjectEntry, bytes: Option<&Bytes>) -> Option<Fault> {
        let wrong = bytes.is_some_and(|bytes| &bytes[..] == b"second");
        wrong.then(|| Fault::Undecodable("second".into()))
    }
}

const FILES: [(&str, &str); 3] = [("a", "first"), ("b", "second"), ("c", "third")];

type Results<Id> = Published<Plain<Id>>;
type Contents = BTreeMap<String, Bytes>;

fn results<Id: AnyId>(store: Arc<dyn ObjectStore>) -> Results<Id> {
    Published::new(store, Path::from("a store/results"))
}

async fn contents(store: &InMemory) -> Contents {
    let listed: Vec<_> = store.list(None).try_collect().await.unwrap();
    let mut all = Contents::new();
    for object in listed {
        let bytes = store.get(&object.location).await.unwrap().bytes().await;
        all.insert(object.location.to_string(), bytes.unwrap());
    }
    all
}

async fn sound<Id: AnyId>(results: &Results<Id>) -> bool {
    let report = results.verify(VerifyMode::Full, &(), &|_, _| {});
    report.await.unwrap().is_sound()
}

/// Runs a law for both kinds of identifiers.
macro_rules! laws {
    ($($name:ident),* $(,)?) => {$(
        mod $name {
            #[tokio::test]
            async fn of_numbered_results() {
                super::$name::<u64>().await;
            }
            #[tokio::test]
            async fn of_named_results() {
                super::$name::<String>().await;
            }
        }
    )*};
}
laws!(
    a_result_killed_after_any_put_is_invisible_or_whole_and_the_next_run_completes_it,
    exactly_the_published_results_are_listed,
    other_bytes_are_a_conflict_and_change_nothing,
    every_damaged_object_is_named_and_restored_alone,
    a_result_that_came_out_otherwise_restores_nothing,
    without_a_manifest_only_equal_objects_prove_a_result,
    a_result_of_another_task_is_refused,
    a_removal_killed_at_any_moment_is_continued_and_leaves_the_others,
    a_result_published_while_it_is_removed_keeps_its_objects,
);

async fn a_result_killed_after_any_put_is_invisible_or_whole_and_the_next_run_completes_it<
    Id: AnyId,
>() {
    let id = Id::any(7);
    let (manifest, bytes) = made(&id, "k", &FILES);
    for puts in 0..=FILES.len() + 1 {
        let memory = Arc::new(InMemory::new());
        let mut left = puts;
        let dying = Tricky::new(memory.clone()).deciding(move |_| match left.checked_sub(1) {
            Some(fewer) => {
                left = fewer;
                Fate::Good
            }
            None => Fate::Dropped,
        });
        let dying = results::<Id>(Arc::new(dying));
        let published = dying.publish(&id, &manifest, &bytes).await;
        assert_eq!(published.is_ok(), puts > FILES.len());
        let results = results::<Id>(memory);
        let found = results.manifest(&id).await.unwrap();
        assert_eq!(found.is_some(), puts > FILES.len(), "after {puts} puts");
        assert!(sound(&results).await);
        results.publish(&id, &manifest, &bytes).await.unwrap();
        let finished = results.finished(&id, "k", VerifyMode::Full).await.unwrap();
        assert_eq!(finished.as_ref(), Some(&manifest));
        for (entry, bytes) in manifest.objects.iter().zip(&bytes) {
            assert_eq!(results.read(&id, entry).await.unwrap(), *bytes);
        }
    }
}

async fn exactly_the_published_results_are_listed<Id: AnyId>() {
    let memory = Arc::new(InMemory::new());
    let results = results::<Id>(memory.clone());
    assert_eq!(results.list().await.unwrap(), Vec::<Id>::new());
    for number in [11, 2, 30] {
        let id = Id::any(number);
        let (manifest, bytes) = made(&id, "k", &FILES);
        results.publish(&id, &manifest, &bytes).await.unwrap();
    }
    let unfinished = results.object_path(&Id::any(4), &Id::any(4).key("a"));
    memory.put(&unfinished, "begun".into()).await.unwrap();
    let mut expected = [11, 2, 30].map(Id::any);
    expected.sort();
    assert_eq!(results.list().await.unwrap(), expected);
    let report = results.verify(VerifyMode::Fast, &(), &|_, _| {});
    let report = report.await.unwrap();
    assert_eq!((report.scenes, report.objects, report.bytes), (3, 9, 48));
}

async fn other_bytes_are_a_conflict_and_change_nothing<Id: AnyId>() {
    let memory = Arc::new(InMemory::new());
    let (results, id) = (results::<Id>(memory.clone()), Id::any(1));
    let (manifest, bytes) = made(&id, "k", &FILES);
    results.publish(&id, &manifest, &bytes).await.unwrap();
    let before = contents(&memory).await;
    results.publish(&id, &manifest, &bytes).await.unwrap();
    assert_eq!(contents(&memory).await, before, "equal bytes");
    let (other, others) = made(&id, "k", &[("a", "first"), ("b", "SECOND")]);
    let error = results.publish(&id, &other, &others).await.unwrap_err();
    assert!(matches!(error, StorageError::Conflict { .. }), "{error}");
    assert_eq!(contents(&memory).await, before);
}

async fn every_damaged_object_is_named_and_restored_alone<Id: AnyId>() {
    let memory = Arc::new(InMemory::new());
    let (results, id) = (results::<Id>(memory.clone()), Id::any(5));
    let (manifest, bytes) = made(&id, "k", &FILES);
    results.publish(&id, &manifest, &bytes).await.unwrap();
    let before = contents(&memory).await;
    for (at, content) in &before {
        let path = Path::from(at.as_str());
        for damage in ["flipped", "cut short", "deleted"] {
            let mut changed = content.to_vec();
            match damage {
                "flipped" => changed[2] ^= 1,
                _ => changed.truncate(2),
            }
            match damage {
                "deleted" => memory.delete(&path).await.unwrap(),
                _ => drop(memory.put(&path, changed.into()).await.unwrap()),
            }
            let is_manifest = path == results.manifest_path(&id);
            let report = results
                .verify(VerifyMode::Full, &(), &|_, _| {})
                .await
                .unwrap();
            let named: Vec<&str> = report.problems.iter().map(|p| &*p.object).collect();
            match is_manifest && damage == "deleted" {
                true => assert!(named.is_empty() && results.list().await.unwrap().is_empty()),
                false => assert_eq!(named, [at.as_str()], "{damage}"),
            }
            let whole = results.finished(&id, "k", VerifyMode::Full).await;
            assert!(!matches!(whole, Ok(Some(_))), "{damage} {at}");
            let written = results.restore(&id, &manifest, &bytes).await.unwrap();
            match is_manifest && damage == "deleted" {
                true => assert!(written.is_empty(), "published anew"),
                false => assert_eq!(written, [at.as_str()], "{damage}"),
            }
            assert_eq!(contents(&memory).await, before, "{damage} {at}");
        }
    }
    assert!(
        results
            .restore(&id, &manifest, &bytes)
            .await
            .unwrap()
            .is_empty()
    );
    let examined = results.verify(VerifyMode::Full, &NoSecond, &|_, _| {});
    let problems = examined.await.unwrap().problems;
    let [object, manifest] = &problems[..] else {
        panic!("{problems:?}")
    };
    assert_eq!(manifest.fault, Fault::BadManifest("has a second".into()));
    assert_eq!(object.fault, Fault::Undecodable("second".into()));
}

async fn a_result_that_came_out_otherwise_restores_nothing<Id: AnyId>() {
    let memory = Arc::new(InMemory::new());
    let (results, id) = (results::<Id>(memory.clone()), Id::any(0));
    let (manifest, bytes) = made(&id, "k", &FILES);
    results.publish(&id, &manifest, &bytes).await.unwrap();
    let damaged = results.object_path(&id, &manifest.objects[0].key);
    memory.delete(&damaged).await.unwrap();
    let before = contents(&memory).await;
    let (other, others) = made(&id, "k", &[("a", "FIRST"), ("b", "second"), ("c", "third")]);
    let error = results.restore(&id, &other, &others).await.unwrap_err();
    assert!(matches!(error, StorageError::Diverged { .. }), "{error}");
    assert_eq!(contents(&memory).await, before);
}

async fn without_a_manifest_only_equal_objects_prove_a_result<Id: AnyId>() {
    let memory = Arc::new(InMemory::new());
    let (results, id) = (results::<Id>(memory.clone()), Id::any(0));
    let (manifest, bytes) = made(&id, "k", &FILES);
    results.publish(&id, &manifest, &bytes).await.unwrap();
    let torn = results.manifest_path(&id);
    memory.put(&torn, "{\"format\": 1".into()).await.unwrap();
    let changed = results.object_path(&id, &manifest.objects[1].key);
    memory.put(&changed, "other".into()).await.unwrap();
    let before = contents(&memory).await;
    let error = results.restore(&id, &manifest, &bytes).await.unwrap_err();
    assert!(matches!(error, StorageError::Damaged { .. }), "{error}");
    assert_eq!(contents(&memory).await, before);
    memory.delete(&changed).await.unwrap();
    let written = results.restore(&id, &manifest, &bytes).await.unwrap();
    assert_eq!(written, [changed.to_string(), torn.to_string()]);
    assert!(sound(&results).await);
}

async fn a_result_of_another_task_is_refused<Id: AnyId>() {
    let (results, id) = (results::<Id>(Arc::new(InMemory::new())), Id::any(3));
    let finished = results.finished(&id, "k", VerifyMode::Fast).await;
    assert_eq!(finished.unwrap(), None);
    let (manifest, bytes) = made(&id, "k", &FILES);
    results.publish(&id, &manifest, &bytes).await.unwrap();
    let error = results
        .finished(&id, "l", VerifyMode::Fast)
        .await
        .unwrap_err();
    assert!(
        error.to_string().contains("belongs to k, not to l"),
        "{error}"
    );
    let (other, others) = made(&id, "l", &FILES);
    let error = results.restore(&id, &other, &others).await.unwrap_err();
    assert!(
        error.to_string().contains("belongs to k, not to l"),
        "{error}"
    );
}

async fn a_removal_killed_at_any_moment_is_continued_and_leaves_the_others<Id: AnyId>() {
    let (id, other) = (Id::any(7), Id::any(8));
    let mut cut = 0;
    loop {
        let memory = Arc::new(InMemory::new());
        let results = results::<Id>(memory.clone());
        let (kept, bytes) = made(&other, "k", &FILES);
        results.publish(&other, &kept, &bytes).await.unwrap();
        let only_other = contents(&memory).await;
        let (manifest, bytes) = made(&id, "k", &FILES);
        results.publish(&id, &manifest, &bytes).await.unwrap();
        let seen = Arc::new(AtomicUsize::new(0));
        let counted = seen.clone();
        let dying = Tricky::new(memory.clone()).acting(move |_, _| {
            let dies = counted.fetch_add(1, SeqCst) == cut;
            Box::pin(async move { assert!(!dies, "killed") })
        });
        let dying = super::published::results::<Id>(Arc::new(dying));
        let killed = AssertUnwindSafe(dying.remove(&id)).catch_unwind().await;
        // It exists and is whole, or it does not exist.
        match results.manifest(&id).await.unwrap() {
            Some(_) => assert!(sound(&results).await, "cut {cut}"),
            None => assert!(results.list().await.unwrap() == [other.clone()]),
        }
        results.remove(&id).await.unwrap();
        assert_eq!(contents(&memory).await, only_other, "cut {cut}");
        if killed.is_ok() {
            assert_eq!(seen.load(SeqCst), cut);
            break;
        }
        cut += 1;
    }
    assert!(cut > 8, "{cut} moments");
}

async fn a_result_published_while_it_is_removed_keeps_its_objects<Id: AnyId>() {
    let memory = Arc::new(InMemory::new());
    let (results, id) = (results::<Id>(memory.clone()), Id::any(7));
    let (manifest, bytes) = made(&id, "k", &FILES);
    results.publish(&id, &manifest, &bytes).await.unwrap();
    let (once, publisher) = (AtomicUsize::new(0), results.clone());
    let (at, again) = (results.manifest_path(&id), (id.clone(), manifest, bytes));
    let racing = Tricky::new(memory.clone()).acting(move |moment, path| {
        let publisher = publisher.clone();
        let now = moment == Moment::AfterDelete && path == at && once.fetch_add(1, SeqCst) == 0;
        let (id, manifest, bytes) = again.clone();
        Box::pin(async move {
            if now {
                publisher.publish(&id, &manifest, &bytes).await.unwrap();
            }
        })
    });
    let racing = super::published::results::<Id>(Arc::new(racing));
    racing.remove(&id).await.unwrap();
    assert!(
        results
            .finished(&id, "k", VerifyMode::Full)
            .await
            .unwrap()
            .is_some()
    );
}
