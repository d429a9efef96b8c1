//! Tests of transients of subsets of the spots and of each single spot: they use the same codec and
//! scale as the main transient, are listed in the manifest, and are as safe.

use crate::common;

use common::*;
use object_store::ObjectStoreExt;
use object_store::path::Path;
use picofarm_dataset::*;
use picofarm_store::*;

/// 36×40 pixels, 100 spots, 8 bins.
fn rich(profile: Profile) -> DatasetSpec {
    let plain = spec(profile);
    DatasetSpec {
        spots: 100,
        subsets: Subsets::of(&[25, 4]).unwrap(),
        per_spot: true,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        gate: Gate {
            bins: 8,
            ..plain.gate
        },
        ..plain
    }
}

/// Returns histograms of each single spot.
fn planes(spec: &DatasetSpec) -> Vec<Vec<f32>> {
    let mut random = Lcg(5);
    let plane = |_| {
        (0..spec.transient_len())
            .map(|_| random.next() * 0.01)
            .collect()
    };
    (0..spec.spots).map(plane).collect()
}

fn sum(planes: &[Vec<f32>], spots: &[u32]) -> Vec<f32> {
    let mut all = vec![0.0; planes[0].len()];
    for &spot in spots {
        let plane = &planes[spot as usize];
        all.iter_mut().zip(plane).for_each(|(a, h)| *a += h);
    }
    all
}

#[tokio::test]
async fn subsets_come_back_as_they_were_and_the_data_set_is_sound() {
    for profile in PROFILES {
        let spec = rich(profile);
        let (store, dataset) = in_memory(&spec).await;
        let scene = Scene::new(&spec, 3);
        let mut alone = planes(&spec);
        let (four, many) = (
            sum(&alone, Quantity::Transient4.spots_of_100()),
            sum(&alone, Quantity::Transient25.spots_of_100()),
        );
        // A saturated bin in the last pixel of the second plane.
        let last = alone[1].len() - 1;
        alone[1][last] = 2.5e9 / scene.scale;
        let subset = |quantity, planes| SubsetRecord { quantity, planes };
        let subsets = [
            subset(Quantity::Transient4, vec![&four[..]]),
            subset(Quantity::Transient25, vec![&many[..]]),
            subset(
                Quantity::TransientSpots,
                alone.iter().map(Vec::as_slice).collect(),
            ),
        ];
        let record = SceneRecord {
            subsets: &subsets,
            ..scene.record()
        };
        let manifest = dataset.publish(2, &record, &provenance()).await.unwrap();
        assert_eq!(manifest.objects.len(), 18);
        let close = |stored: Vec<f32>, values: &[f32]| {
            assert_eq!(stored.len(), values.len());
            for (s, v) in stored.iter().zip(values) {
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
        };
        close(
            dataset
                .read_histogram(2, Quantity::Transient4)
                .await
                .unwrap(),
            &four,
        );
        close(
            dataset
                .read_histogram(2, Quantity::Transient25)
                .await
                .unwrap(),
            &many,
        );
        let spots = dataset.read_histogram(2, Quantity::TransientSpots).await;
        close(spots.unwrap(), &alone.concat());
        for spot in [0, 1, alone.len() - 1] {
            let one = dataset.read_spot(2, spot as u32).await.unwrap();
            close(one, &alone[spot]);
        }
        close(dataset.read_transient(2).await.unwrap(), &scene.transient);
        assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
        let exact = manifest.overflow_of(Quantity::TransientSpots);
        match profile {
            Profile::SqrtU16 { .. } => {
                assert_eq!(exact, [((2 * last + 1) as u64, alone[1][last])]);
            }
            Profile::PlainF32 { .. } | Profile::CountsU16 => assert!(exact.is_empty()),
        }

        // Opened again, it is the same data set, and damage to a subset is detected.
        let again = Dataset::open(store.clone(), dataset.prefix().clone())
            .await
            .unwrap();
        assert_eq!(*again.spec(), spec);
        let object = "sets/a/transient_25/c/2/0/0/0";
        store.put(&Path::from(object), "x".into()).await.unwrap();
        let report = again.verify(VerifyMode::Full).await.unwrap();
        let named: Vec<_> = report.problems.iter().map(|p| p.object.clone()).collect();
        assert_eq!(named, [object]);
    }
}

#[tokio::test]
async fn a_data_set_with_other_subsets_is_another_data_set_and_the_field_is_named() {
    let spec = rich(Profile::default());
    let (store, dataset) = in_memory(&spec).await;
    let prefix = dataset.prefix().clone();
    let fewer = DatasetSpec {
        subsets: Subsets::of(&[4]).unwrap(),
        ..spec
    };
    let other = Dataset::create_or_open(store.clone(), prefix.clone(), &fewer).await;
    let text = other.unwrap_err().to_string();
    assert!(text.contains("subsets = [4, 25], but [4]"), "{text}");
    let without = DatasetSpec {
        per_spot: false,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        ..spec
    };
    let other = Dataset::create_or_open(store, prefix, &without).await;
    let text = other.unwrap_err().to_string();
    assert!(text.contains("per_spot = true, but false"), "{text}");
}

#[tokio::test]
async fn subsets_that_do_not_fit_are_refused_by_name() {
    let spec = rich(Profile::default());
    let text = DatasetSpec { spots: 25, ..spec }
        .check()
        .unwrap_err()
        .to_string();
    assert!(text.contains("spec.subsets"), "{text}");
    assert!(Subsets::of(&[16]).unwrap_err().contains("16"));
    let (_, dataset) = in_memory(&spec).await;
    let scene = Scene::new(&spec, 3);
    let refused = dataset.encode(0, &scene.record(), &provenance());
    let text = refused.unwrap_err().to_string();
    assert!(
        text.contains("record.subsets") && text.contains("transient_25"),
        "{text}"
    );
    let plain = in_memory(&common::spec(Profile::default())).await.1;
    let missing = plain.read_histogram(0, Quantity::Transient25).await;
    assert!(
        missing
            .unwrap_err()
            .to_string()
            .contains("no array transient_25")
    );
}
