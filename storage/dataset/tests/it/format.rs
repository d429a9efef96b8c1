//! Tests that the bytes on disk do not change: metadata, manifest and the hashes of a fixed scene's
//! objects. Data sets outlive programs, so a change here requires a new format or encoder version.

use crate::common;

use common::*;
use object_store::ObjectStoreExt;
use object_store::path::Path;
use picofarm_dataset::*;
use picofarm_store::*;
use zarrs::array::{Array, ArraySubset};

async fn text(store: &dyn object_store::ObjectStore, key: &str) -> String {
    let bytes = store
        .get(&Path::from(key))
        .await
        .unwrap()
        .bytes()
        .await
        .unwrap();
    String::from_utf8(bytes.to_vec()).unwrap()
}

#[tokio::test]
async fn metadata_manifest_and_object_hashes_are_stable() {
    for (name, profile) in ["sqrt", "plain"].into_iter().zip(PROFILES) {
        let spec = spec(profile);
        let (store, dataset) = in_memory(&spec).await;
        let mut scene = Scene::new(&spec, 42);
        scene.transient[30] = 2.5e9 / scene.scale;
        dataset
            .publish(1, &scene.record(), &provenance())
            .await
            .unwrap();
        let manifest = text(&*store, "sets/a/manifests/1.json").await;
        insta::assert_snapshot!(
            format!("{name}_root"),
            text(&*store, "sets/a/zarr.json").await
        );
        insta::assert_snapshot!(
            format!("{name}_transient"),
            text(&*store, "sets/a/transient/zarr.json").await
        );
        insta::assert_snapshot!(format!("{name}_manifest"), manifest);
    }
}

#[tokio::test]
async fn zarrs_reads_every_array_with_the_same_values() {
    let folder = tempfile::tempdir().unwrap();
    let (store, prefix) = open_store(folder.path().to_str().unwrap()).unwrap();
    let spec = spec(Profile::default());
    let dataset = Dataset::create_or_open(store, prefix, &spec).await.unwrap();
    let scene = Scene::new(&spec, 42);
    dataset
        .publish(1, &scene.record(), &provenance())
        .await
        .unwrap();
    let files =
        std::sync::Arc::new(zarrs::filesystem::FilesystemStore::new(folder.path()).unwrap());
    for quantity in spec.quantities() {
        let array = Array::open(files.clone(), &format!("/{}", quantity.name())).unwrap();
        assert_eq!(array.shape()[0], 4);
        assert_eq!(
            array.dimension_names().as_ref().unwrap()[0].as_deref(),
            Some("scene")
        );
    }
    let array = Array::open(files, "/transient").unwrap();
    let code = SquareRoot::new(0.2, scene.scale);
    let one = |i: u64| ArraySubset::new_with_ranges(&[i..i + 1, 0..24, 0..36, 0..40]);
    let q: Vec<u16> = array.retrieve_array_subset(&one(1)).unwrap();
    for (i, q) in q.iter().enumerate() {
        let (bin, pixel) = (i / (36 * 40), i % (36 * 40));
        assert_eq!(*q, code.encode(scene.transient[pixel * 24 + bin]));
    }
    let missing: Vec<u16> = array.retrieve_array_subset(&one(3)).unwrap();
    assert!(missing.iter().all(|q| *q == 0));
}
