//! The laser's wavelength is part of a data set.

use crate::common;

use common::*;
use object_store::ObjectStoreExt;
use object_store::path::Path;
use picofarm_dataset::*;

fn at(nm: &[f64]) -> DatasetSpec {
    DatasetSpec {
        wavelengths_nm: Wavelength::of(nm).unwrap(),
        ..spec(Profile::default())
    }
}

#[tokio::test]
async fn a_wavelength_is_noted_and_comes_back() {
    let (store, dataset) = in_memory(&at(&[905.0])).await;
    let again = Dataset::open(store, dataset.prefix().clone())
        .await
        .unwrap();
    assert_eq!(again.spec().wavelengths_nm.nm(), Some(905.0));
}

#[tokio::test]
async fn a_data_set_of_another_wavelength_is_another_data_set_and_the_field_is_named() {
    let (store, dataset) = in_memory(&at(&[905.0])).await;
    let prefix = dataset.prefix().clone();
    for (nm, said) in [(&[532.0][..], "[532.0]"), (&[], "[]")] {
        let refused = Dataset::create_or_open(store.clone(), prefix.clone(), &at(nm)).await;
        let text = refused.unwrap_err().to_string();
        let expected = format!("wavelengths_nm = [905.0], but {said}");
        assert!(text.contains(&expected), "{text}");
    }
}

#[tokio::test]
async fn a_data_set_of_several_wavelengths_is_refused_by_the_field() {
    let (store, dataset) = in_memory(&at(&[905.0])).await;
    let root = Path::from("sets/a/zarr.json");
    let bytes = store.get(&root).await.unwrap().bytes().await.unwrap();
    let text = String::from_utf8(bytes.to_vec()).unwrap();
    let mut value: serde_json::Value = serde_json::from_str(&text).unwrap();
    let nm = &mut value["attributes"]["picofarm"]["spec"]["wavelengths_nm"];
    assert_eq!(*nm, serde_json::json!([905.0]));
    *nm = serde_json::json!([905.0, 532.0]);
    let bytes = serde_json::to_vec(&value).unwrap();
    store.put(&root, bytes.into()).await.unwrap();
    let refused = Dataset::open(store, dataset.prefix().clone()).await;
    let text = refused.unwrap_err().to_string();
    assert!(
        text.contains("wavelengths_nm has 2, expected one"),
        "{text}"
    );
}
