//! Tests that data sets of format 1, written by an earlier version, can still be read, verified and
//! extended.

use crate::common;

use std::io::Read;
use std::path::Path;

use common::*;
use picofarm_dataset::*;
use picofarm_store::*;

/// Unpacks `format-1.zip`: the data sets `sqrt` (with `transient_spots`), `plain` and `counts`,
/// each with scene 1.
fn unpack(to: &Path) {
    let bytes = include_bytes!("fixtures/format-1.zip");
    let mut archive = zip::ZipArchive::new(std::io::Cursor::new(bytes)).unwrap();
    for i in 0..archive.len() {
        let mut file = archive.by_index(i).unwrap();
        let path = to.join(file.name());
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let mut content = Vec::new();
        file.read_to_end(&mut content).unwrap();
        std::fs::write(path, content).unwrap();
    }
}

fn old_spec(profile: Profile) -> DatasetSpec {
    DatasetSpec {
        height: 9,
        width: 10,
        per_spot: matches!(profile, Profile::SqrtU16 { .. }),
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        ..spec(profile)
    }
}

#[tokio::test]
async fn data_sets_of_format_1_are_read_verified_and_grow() {
    let folder = tempfile::tempdir().unwrap();
    unpack(folder.path());
    let all = [
        ("sqrt", Profile::SqrtU16 { delta: 0.25 }),
        ("plain", Profile::LOSSLESS),
        ("counts", Profile::CountsU16),
    ];
    for (name, profile) in all {
        let spec = old_spec(profile);
        let (store, prefix) = open_store(folder.path().join(name).to_str().unwrap()).unwrap();
        let dataset = Dataset::open(store.clone(), prefix.clone()).await.unwrap();
        assert_eq!(*dataset.spec(), spec);
        let mut scene = Scene::new(&spec, 8);
        scene.transient[123] = 5e8 / scene.scale;
        if profile == Profile::CountsU16 {
            let whole = |h: &mut f32| *h = (*h * scene.scale).round() / scene.scale;
            scene.transient.iter_mut().for_each(whole);
        }
        let read = dataset.read_transient(1).await.unwrap();
        let code = SquareRoot::new(0.25, scene.scale);
        for (at, (found, given)) in read.iter().zip(&scene.transient).enumerate() {
            let expected = match profile {
                Profile::SqrtU16 { .. } if at != 123 => code.decode(code.encode(*given)),
                _ => *given,
            };
            assert_eq!(*found, expected, "{name}[{at}]");
        }
        let crop = dataset.read_transient_part(1, 3..5, 2..9, 4..6).await;
        assert_eq!(crop.unwrap()[0], read[(3 * 10 + 2) * 24 + 4]);
        if spec.per_spot {
            let third = Scene::new(&spec, 12).transient;
            let found = dataset.read_spot(1, 3).await.unwrap();
            let expected = third.iter().map(|h| code.decode(code.encode(*h)));
            assert!(found.into_iter().eq(expected));
        }
        let found = dataset.verify(VerifyMode::Full).await.unwrap();
        assert!(found.problems.is_empty(), "{name}: {:?}", found.problems);

        // A scene is added in the old format, and old programs can still read the data set.
        let more = DatasetSpec { scenes: 6, ..spec };
        let grown = Dataset::create_or_open(store, prefix, &more).await.unwrap();
        let alone: Vec<Vec<f32>> = (0..9).map(|i| Scene::new(&spec, i).transient).collect();
        let subsets = [SubsetRecord {
            quantity: Quantity::TransientSpots,
            planes: alone.iter().map(Vec::as_slice).collect(),
        }];
        let record = SceneRecord {
            subsets: if spec.per_spot { &subsets } else { &[] },
            ..scene.record()
        };
        let manifest = grown.publish(5, &record, &provenance()).await.unwrap();
        assert_eq!(manifest.format, 1);
        assert_eq!(grown.read_transient(5).await.unwrap(), read, "{name}");
        let found = grown.verify(VerifyMode::Full).await.unwrap();
        assert!(found.problems.is_empty(), "{name}: {:?}", found.problems);
    }
}
