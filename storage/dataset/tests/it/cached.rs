//! Tests that a local cache saves requests, and is never trusted more than the store.

use std::{fs, path::Path};

use crate::common;

use common::*;
use object_store::{ObjectStoreExt, path};
use picofarm_dataset::*;
use picofarm_store::Cache;

async fn read_all(data: &Dataset) -> (Vec<f32>, Vec<f32>, Vec<f32>, Vec<f32>) {
    let mut planes = Vec::new();
    let into = data.read_planes_into(1, Quantity::Transient, &mut planes);
    into.await.unwrap();
    let mut part = vec![0.0; 8 * 8 * 5];
    let ranges = [0..8, 8..16, 3..8];
    let read = data.read_planes_part(1, Quantity::Transient, ranges, &mut part);
    read.await.unwrap();
    (
        planes,
        part,
        data.read_transient(1).await.unwrap(),
        data.read::<f32>(1, Quantity::Depth).await.unwrap(),
    )
}

/// Files of a cache.
fn entries(folder: &Path) -> Vec<std::path::PathBuf> {
    let objects = fs::read_dir(folder).unwrap().map(|o| o.unwrap().path());
    let files = objects.flat_map(|o| fs::read_dir(o).unwrap());
    files.map(|f| f.unwrap().path()).collect()
}

#[tokio::test]
async fn what_was_read_once_needs_only_the_manifest_again() {
    for profile in PROFILES {
        let folder = tempfile::tempdir().unwrap();
        let spec = spec(profile);
        let (store, data) = in_memory(&spec).await;
        let record = Scene::new(&spec, 1);
        let (scene, made) = (record.record(), provenance());
        let manifest = data.publish(1, &scene, &made).await.unwrap();
        let data = data.with_cache(Cache::open(folder.path(), 1 << 30).unwrap());
        let first = read_all(&data).await;
        for object in &manifest.objects {
            let path = path::Path::from(format!("sets/a/{}", object.key));
            store.delete(&path).await.unwrap();
        }
        assert_eq!(read_all(&data).await, first);
        // Another process with the same folder.
        let again = Dataset::open(store, path::Path::from("sets/a")).await;
        let again = again.unwrap();
        let again = again.with_cache(Cache::open(folder.path(), 1 << 30).unwrap());
        assert_eq!(read_all(&again).await, first);
    }
}

#[tokio::test]
async fn damaged_entries_are_read_from_the_store() {
    let folder = tempfile::tempdir().unwrap();
    let spec = spec(PROFILES[0]);
    let (_, data) = in_memory(&spec).await;
    let record = Scene::new(&spec, 1);
    let (scene, made) = (record.record(), provenance());
    data.publish(1, &scene, &made).await.unwrap();
    let data = data.with_cache(Cache::open(folder.path(), 1 << 30).unwrap());
    let first = read_all(&data).await;
    for (k, file) in entries(folder.path()).into_iter().enumerate() {
        let mut bytes = fs::read(&file).unwrap();
        let middle = bytes.len() / 2;
        match k % 2 {
            0 => bytes[middle] ^= 1,
            _ => bytes.truncate(middle),
        }
        fs::write(&file, bytes).unwrap();
    }
    assert_eq!(read_all(&data).await, first);
}

#[tokio::test]
async fn a_scene_that_was_replaced_is_read_from_the_store() {
    let folder = tempfile::tempdir().unwrap();
    let spec = spec(PROFILES[0]);
    let mut found = Vec::new();
    // Two stores stand for one whose data set was deleted and made again.
    for seed in [1, 2] {
        let (_, data) = in_memory(&spec).await;
        let record = Scene::new(&spec, seed);
        let (scene, made) = (record.record(), provenance());
        data.publish(1, &scene, &made).await.unwrap();
        let plain = read_all(&data).await;
        let data = data.with_cache(Cache::open(folder.path(), 1 << 30).unwrap());
        assert_eq!(read_all(&data).await, plain);
        found.push(plain);
    }
    assert_ne!(found[0], found[1]);
}

#[tokio::test]
async fn damage_of_the_store_does_not_stay_in_the_cache() {
    let folder = tempfile::tempdir().unwrap();
    let spec = spec(PROFILES[0]);
    let (store, data) = in_memory(&spec).await;
    let record = Scene::new(&spec, 1);
    let (scene, made) = (record.record(), provenance());
    let manifest = data.publish(1, &scene, &made).await.unwrap();
    let first = read_all(&data).await;
    let data = data.with_cache(Cache::open(folder.path(), 1 << 30).unwrap());
    let shard = manifest
        .objects
        .iter()
        .find(|o| o.key.starts_with("transient/"));
    let path = path::Path::from(format!("sets/a/{}", shard.unwrap().key));
    let bytes = store.get(&path).await.unwrap().bytes().await.unwrap();
    let mut flipped = bytes.to_vec();
    flipped[bytes.len() / 3] ^= 1;
    store.put(&path, flipped.into()).await.unwrap();
    data.read_transient(1).await.unwrap_err();
    store.put(&path, bytes.into()).await.unwrap();
    assert_eq!(read_all(&data).await, first);
}
