//! Tests of histograms at additional wavelengths: they use the same codec and scale as the main
//! one, are listed in the manifest, and are as safe.

mod common;

use common::*;
use object_store::ObjectStoreExt;
use object_store::path::Path;
use picofarm_dataset::*;

/// 36×40 pixels, 8 bins, three wavelengths.
fn coloured(profile: Profile) -> DatasetSpec {
    let plain = spec(profile);
    DatasetSpec {
        wavelengths_nm: Wavelengths::of(&[905.0, 632.8, 450.0]).unwrap(),
        gate: Gate {
            bins: 8,
            ..plain.gate
        },
        ..plain
    }
}

/// Returns histograms at the wavelengths after the main one.
fn planes(spec: &DatasetSpec) -> Vec<Vec<f32>> {
    let mut random = Lcg(5);
    let plane = |_| {
        (0..spec.transient_len())
            .map(|_| random.next() * 0.01)
            .collect()
    };
    (0..2).map(plane).collect()
}

#[tokio::test]
async fn other_wavelengths_come_back_as_they_were_and_their_array_names_them() {
    for profile in PROFILES {
        let spec = coloured(profile);
        let (store, dataset) = in_memory(&spec).await;
        let scene = Scene::new(&spec, 3);
        let mut others = planes(&spec);
        // A saturated bin in the last pixel of the second one.
        let last = others[1].len() - 1;
        others[1][last] = 2.5e9 / scene.scale;
        let subsets = [SubsetRecord {
            quantity: Quantity::TransientWavelengths,
            planes: others.iter().map(Vec::as_slice).collect(),
        }];
        let record = SceneRecord {
            subsets: &subsets,
            ..scene.record()
        };
        let manifest = dataset.publish(2, &record, &provenance()).await.unwrap();
        let stored = dataset
            .read_histogram(2, Quantity::TransientWavelengths)
            .await
            .unwrap();
        for (s, v) in stored.iter().zip(others.concat()) {
            let (n, m) = (v * scene.scale, s * scene.scale);
            let limit = match profile {
                Profile::SqrtU16 { .. } if n < 1e9 => 0.13 * n.max(1.0).sqrt(),
                _ => 0.0,
            };
            assert!(
                (n - m).abs() <= limit,
                "{profile:?}: {n} photons became {m}"
            );
        }
        assert_eq!(stored.len(), 2 * spec.transient_len());
        let exact = manifest.overflow_of(Quantity::TransientWavelengths);
        match profile {
            Profile::SqrtU16 { .. } => {
                assert_eq!(exact, [((2 * last + 1) as u64, others[1][last])]);
            }
            Profile::PlainF32 { .. } | Profile::CountsU16 => assert!(exact.is_empty()),
        }
        assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());

        let of_array = Path::from("sets/a/transient_wavelengths/zarr.json");
        let bytes = store.get(&of_array).await.unwrap().bytes().await.unwrap();
        let array: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
        assert_eq!(
            array["attributes"]["wavelengths_nm"],
            serde_json::json!([632.8, 450.0])
        );
        assert_eq!(
            array["dimension_names"],
            serde_json::json!(["scene", "wavelength", "row", "column", "bin"])
        );

        // Opened again, it is the same data set, and damage is detected.
        let again = Dataset::open(store.clone(), dataset.prefix().clone())
            .await
            .unwrap();
        assert_eq!(*again.spec(), spec);
        let object = "sets/a/transient_wavelengths/c/2/0/0/0/0";
        store.put(&Path::from(object), "x".into()).await.unwrap();
        let report = again.verify(VerifyMode::Full).await.unwrap();
        let named: Vec<_> = report.problems.iter().map(|p| p.object.clone()).collect();
        assert_eq!(named, [object]);
    }
}

#[tokio::test]
async fn a_data_set_of_other_wavelengths_is_another_data_set_and_the_field_is_named() {
    let spec = coloured(Profile::default());
    let (store, dataset) = in_memory(&spec).await;
    let prefix = dataset.prefix().clone();
    for (nm, said) in [
        (&[905.0, 632.8][..], "[905.0, 632.8]"),
        (&[905.0, 632.8, 451.0], "[905.0, 632.8, 451.0]"),
        (&[], "[]"),
    ] {
        let other = DatasetSpec {
            wavelengths_nm: Wavelengths::of(nm).unwrap(),
            ..spec
        };
        let refused = Dataset::create_or_open(store.clone(), prefix.clone(), &other).await;
        let text = refused.unwrap_err().to_string();
        let expected = format!("wavelengths_nm = [905.0, 632.8, 450.0], but {said}");
        assert!(text.contains(&expected), "{text}");
    }
}

#[tokio::test]
async fn one_wavelength_alone_is_noted_and_needs_no_further_array() {
    let spec = DatasetSpec {
        wavelengths_nm: Wavelengths::of(&[905.0]).unwrap(),
        ..spec(Profile::default())
    };
    assert!(!spec.quantities().contains(&Quantity::TransientWavelengths));
    let (store, dataset) = in_memory(&spec).await;
    let again = Dataset::open(store, dataset.prefix().clone())
        .await
        .unwrap();
    assert_eq!(again.spec().wavelengths_nm.nm(), [905.0]);
}
