//! Tests that every changed byte outside of histograms is detected: in splits, recipes, snapshots,
//! manifests and metadata.

use crate::common;

use std::collections::BTreeMap;
use std::sync::Arc;

use common::*;
use futures::TryStreamExt;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use picofarm_dataset::*;
use picofarm_store::*;
use serde_json::{Value, json};

type Objects = BTreeMap<String, Vec<u8>>;

async fn objects(store: &InMemory) -> Objects {
    let listed: Vec<_> = store.list(None).try_collect().await.unwrap();
    let mut all = Objects::new();
    for object in listed {
        let bytes = store.get(&object.location).await.unwrap().bytes().await;
        all.insert(object.location.to_string(), bytes.unwrap().to_vec());
    }
    all
}

fn pretty(value: &Value) -> Vec<u8> {
    let mut bytes = serde_json::to_vec_pretty(value).unwrap();
    bytes.push(b'\n');
    bytes
}

fn split() -> Vec<u8> {
    pretty(&json!({
        "format": 1, "settings": {"name": "default", "seed": 3, "counts": [2, 1, 1]}, "version": 1,
        "made_of": 4, "counts": [2, 1, 1], "sides": "0102",
    }))
}

/// Returns a data set with one scene, a split, a recipe and a snapshot.
async fn whole() -> (Arc<InMemory>, Dataset) {
    let memory = Arc::new(InMemory::new());
    let spec = spec(Profile::default());
    let dataset = Dataset::create_or_open(memory.clone(), Path::from("sets/a"), &spec)
        .await
        .unwrap();
    let made = Scene::new(&spec, 0);
    dataset
        .publish(0, &made.record(), &provenance())
        .await
        .unwrap();
    let recipe = json!({"stage": {"kind": "render"}});
    let key = "a".repeat(64);
    assert!(dataset.create_recipe(&key, None, &recipe).await.unwrap());
    assert!(dataset.create_split("default", 1, split()).await.unwrap());
    let present = dataset.present(&|_, _| {}).await.unwrap();
    let snapshot = present.named("v1", "2026-01-01T00:00:00Z");
    dataset.create_snapshot(&snapshot).await.unwrap().unwrap();
    (memory, dataset)
}

#[tokio::test]
async fn a_flipped_byte_of_any_small_object_is_named_or_means_nothing() {
    let (memory, dataset) = whole().await;
    let all = objects(&memory).await;
    let snapshot = dataset.snapshot("v1").await.unwrap();
    let json = |bytes: &[u8]| serde_json::from_slice::<Value>(bytes).ok();
    let mut harmless = BTreeMap::<&str, usize>::new();
    for (key, bytes) in &all {
        let metadata = key.ends_with("zarr.json");
        let record = ["/manifests/", "/splits/", "/recipes/", "/snapshots/"];
        if !metadata && !record.iter().any(|folder| key.contains(folder)) {
            continue;
        }
        let path = Path::from(key.as_str());
        // Metadata is large, and compared as a whole.
        let step = if metadata { 7 } else { 1 };
        for at in (0..bytes.len()).step_by(step) {
            let mut changed = bytes.clone();
            changed[at] ^= if at % 5 == 0 { 0x20 } else { 0x01 };
            memory.put(&path, changed.clone().into()).await.unwrap();
            let Ok(opened) = Dataset::open(memory.clone(), Path::from("sets/a")).await else {
                assert_eq!(key, "sets/a/zarr.json");
                continue;
            };
            let report = opened.verify(VerifyMode::Fast).await.unwrap();
            if report.problems.iter().any(|p| p.object == *key) {
                continue;
            }
            // Exceptions: spaces between the words of metadata, and the date in gzip's header.
            let same = match key.contains("/snapshots/") {
                true => opened.snapshot("v1").await.unwrap() == snapshot,
                false => metadata && json(&changed) == json(bytes),
            };
            let was =
                String::from_utf8_lossy(&bytes[at.saturating_sub(20)..bytes.len().min(at + 20)]);
            assert!(
                same,
                "byte {at} of {key} changed unseen, in {was:?}; told: {:?}",
                report.problems
            );
            *harmless
                .entry(if metadata { "metadata" } else { "snapshot" })
                .or_default() += 1;
        }
        memory.put(&path, bytes.clone().into()).await.unwrap();
    }
    assert!(
        harmless.get("snapshot").is_none_or(|n| *n <= 8),
        "{harmless:?}"
    );
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
}

#[tokio::test]
async fn bytes_at_the_end_of_a_record_are_noticed() {
    let (memory, dataset) = whole().await;
    for (key, bytes) in objects(&memory).await {
        let record = ["/manifests/", "/splits/", "/recipes/", "/snapshots/"];
        if !record.iter().any(|folder| key.contains(folder)) {
            continue;
        }
        let path = Path::from(key.as_str());
        for tail in [&b"\n"[..], b" ", b"\0", &bytes] {
            let longer = [&bytes[..], tail].concat();
            memory.put(&path, longer.into()).await.unwrap();
            let report = dataset.verify(VerifyMode::Fast).await.unwrap();
            assert!(
                report.problems.iter().any(|p| p.object == key),
                "{tail:?} behind {key}"
            );
        }
        memory.put(&path, bytes.into()).await.unwrap();
    }
}

#[tokio::test]
async fn a_changed_split_is_not_read_and_says_how_to_make_it_again() {
    let (memory, dataset) = whole().await;
    assert_eq!(dataset.read_split("default", 1).await.unwrap(), split());
    let path = Path::from("sets/a/splits/default/v1.json");
    let bytes = objects(&memory).await[path.as_ref()].clone();
    let moved = String::from_utf8(bytes.clone()).unwrap();
    let moved = moved.replace("\"0102\"", "\"0201\"");
    assert_ne!(moved.as_bytes(), bytes);
    // Another version under its name, or another split, is also detected.
    let other = dataset.create_split("other", 1, split()).await.unwrap();
    assert!(other);
    for (name, bytes) in [("default", moved.into_bytes()), ("other", bytes)] {
        let path = Path::from(format!("sets/a/splits/{name}/v1.json"));
        memory.put(&path, bytes.into()).await.unwrap();
        let said = dataset.read_split(name, 1).await.unwrap_err().to_string();
        assert!(
            said.contains(path.as_ref()) && said.contains("picofarm dataset split"),
            "{said}"
        );
        let report = dataset.verify(VerifyMode::Fast).await.unwrap();
        assert!(report.problems.iter().any(|p| p.object == path.to_string()));
    }
}
