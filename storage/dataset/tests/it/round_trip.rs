//! Tests that published values are read back exactly, or within the code's error.

use crate::common;

use common::*;
use picofarm_dataset::*;
use picofarm_store::*;
use proptest::prelude::*;

fn sigma(h: f32, scale: f32) -> f64 {
    (f64::from(h) * f64::from(scale)).max(1.0).sqrt()
}

#[tokio::test]
async fn a_published_scene_reads_back_in_both_profiles() {
    for profile in PROFILES {
        let spec = spec(profile);
        let (_, dataset) = in_memory(&spec).await;
        let scene = Scene::new(&spec, 1);
        let manifest = dataset
            .publish(2, &scene.record(), &provenance())
            .await
            .unwrap();
        let h = dataset.read_transient(2).await.unwrap();
        let mut worst = 0f64;
        for (a, b) in h.iter().zip(&scene.transient) {
            let photons = f64::from(a - b).abs() * f64::from(scene.scale);
            worst = worst.max(photons / sigma(*b, scene.scale));
        }
        match profile {
            Profile::PlainF32 { .. } | Profile::CountsU16 => assert_eq!(h, scene.transient),
            Profile::SqrtU16 { .. } => {
                assert!(worst <= 0.13, "{worst}");
                assert!(
                    (manifest.error.max_sigma - worst).abs() < 1e-3,
                    "{worst} {manifest:?}"
                );
                assert!(manifest.error.rms_sigma < 0.08);
            }
        }
        assert_eq!(
            dataset.read::<f32>(2, Quantity::Depth).await.unwrap(),
            scene.depth
        );
        assert_eq!(
            dataset.read::<f32>(2, Quantity::Range).await.unwrap(),
            scene.range
        );
        assert_eq!(
            dataset.read::<u32>(2, Quantity::Instance).await.unwrap(),
            scene.instance
        );
        assert_eq!(
            dataset.read::<u16>(2, Quantity::Label).await.unwrap(),
            scene.label
        );
        assert_eq!(
            dataset.read::<u8>(2, Quantity::Specular).await.unwrap(),
            scene.specular
        );
        assert_eq!(dataset.read_visibility(2).await.unwrap(), scene.visibility);
        assert_eq!(dataset.read_spots(2).await.unwrap(), scene.spots);
        assert_eq!(
            dataset.read_intrinsics(2).await.unwrap(),
            scene.record().intrinsics
        );
        assert_eq!(
            dataset.read::<f32>(2, Quantity::Scale).await.unwrap(),
            [scene.scale]
        );
        let camera = dataset.read::<f32>(2, Quantity::Camera).await.unwrap();
        assert_eq!(camera, scene.record().camera.as_flattened());
        assert_eq!(
            dataset.read::<f32>(2, Quantity::Laser).await.unwrap(),
            scene.record().laser
        );
        for (a, b) in dataset
            .read_normal(2)
            .await
            .unwrap()
            .iter()
            .zip(&scene.normal)
        {
            assert!((a - b).abs() <= 0.6 / 32767.0);
        }
        let intensity = dataset.read::<f32>(2, Quantity::Intensity).await.unwrap();
        let sum: f32 = scene.transient[..24].iter().sum();
        assert!((intensity[0] / sum - 1.0).abs() < 1e-5);
        assert_eq!(dataset.scenes_present().await.unwrap(), [2]);
    }
}

#[tokio::test]
async fn a_crop_equals_the_same_window_of_the_whole() {
    for profile in PROFILES {
        let spec = spec(profile);
        let (_, dataset) = in_memory(&spec).await;
        let mut scene = Scene::new(&spec, 3);
        scene.transient[(33 * 40 + 39) * 24 + 5] = 3e9 / scene.scale;
        dataset
            .publish(0, &scene.record(), &provenance())
            .await
            .unwrap();
        let whole = dataset.read_transient(0).await.unwrap();
        for (rows, columns) in [
            (0..1, 0..1),
            (31..34, 30..40),
            (3..30, 5..20),
            (0..36, 32..40),
            (32..36, 0..40),
        ] {
            let crop = dataset
                .read_transient_crop(0, rows.clone(), columns.clone())
                .await
                .unwrap();
            let mut images = vec![f32::NAN; crop.len()];
            let ranges = [rows.clone(), columns.clone(), 0..24];
            dataset
                .read_planes_part(0, Quantity::Transient, ranges, &mut images)
                .await
                .unwrap();
            let of_crop = |i: usize| images[i % 24 * (crop.len() / 24) + i / 24];
            assert!((0..crop.len()).map(of_crop).eq(crop.iter().copied()));
            let mut expected = Vec::new();
            for row in rows {
                let at = |c: u32| (row * 40 + c) as usize * 24;
                expected.extend_from_slice(&whole[at(columns.start)..at(columns.end)]);
            }
            assert_eq!(crop, expected);
        }
        let error = dataset
            .read_transient_crop(0, 30..37, 0..2)
            .await
            .unwrap_err();
        assert!(error.to_string().contains("rows"), "{error}");
    }
}

#[tokio::test]
async fn saturated_bins_come_back_exactly() {
    let spec = spec(Profile::default());
    let (_, dataset) = in_memory(&spec).await;
    let mut scene = Scene::new(&spec, 4);
    scene.scale = 1.5;
    let bright = [(17usize, 4.32e7f32), (5000, 1.234_567_8e9), (34_000, 3e38)];
    for (at, photons) in bright {
        scene.transient[at] = photons / scene.scale;
    }
    scene.transient[100] = 4.28e7 / scene.scale;
    let manifest = dataset
        .publish(0, &scene.record(), &provenance())
        .await
        .unwrap();
    // Indices of the array, which has bins before rows and columns.
    let stored = |at: usize| (at % 24 * 36 * 40 + at / 24) as u64;
    let mut expected = bright.map(|(at, _)| (stored(at), scene.transient[at]));
    expected.sort_by_key(|(at, _)| *at);
    assert_eq!(manifest.overflow, expected);
    let h = dataset.read_transient(0).await.unwrap();
    for (at, _) in bright {
        assert_eq!(h[at], scene.transient[at]);
    }
    assert!((h[100] * 1.5 - 4.28e7).abs() < 0.13 * 4.28e7f32.sqrt());
    assert!(manifest.error.max_sigma <= 0.131);
    assert_eq!(dataset.manifest(0).await.unwrap(), manifest);
}

#[tokio::test]
async fn unusable_values_are_named() {
    let spec = spec(Profile::default());
    let (_, dataset) = in_memory(&spec).await;
    for profile in PROFILES {
        let spec = common::spec(profile);
        let (_, dataset) = in_memory(&spec).await;
        for bad in [f32::NAN, -1.0, f32::INFINITY] {
            let mut scene = Scene::new(&spec, 1);
            scene.transient[12_345] = bad;
            let error = dataset
                .encode(0, &scene.record(), &provenance())
                .unwrap_err();
            assert!(
                error
                    .to_string()
                    .starts_with("record.transient[12345]: expected"),
                "{error}"
            );
        }
    }
    let mut scene = Scene::new(&spec, 1);
    scene.depth.pop();
    let error = dataset
        .encode(0, &scene.record(), &provenance())
        .unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("record.depth: expected 1440 values"),
        "{error}"
    );
    let mut scene = Scene::new(&spec, 1);
    scene.visibility[7] = 255;
    let error = dataset
        .encode(0, &scene.record(), &provenance())
        .unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("record.visibility[7]: expected 0 or 1, found 255"),
        "{error}"
    );
    let scene = Scene::new(&spec, 1);
    let error = dataset
        .encode(4, &scene.record(), &provenance())
        .unwrap_err();
    assert!(matches!(
        error,
        StorageError::SceneOutOfRange {
            scene: 4,
            scenes: 4
        }
    ));
    // Saturation everywhere indicates a wrong scale, and is not listed.
    let large = DatasetSpec {
        height: 64,
        width: 64,
        ..spec
    };
    let (_, dataset) = in_memory(&large).await;
    let mut scene = Scene::new(&large, 1);
    scene.transient.fill(1.0);
    scene.scale = 1e9;
    let error = dataset
        .encode(0, &scene.record(), &provenance())
        .unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("record.scale: 98304 bins exceed"),
        "{error}"
    );
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn the_square_root_code_errs_by_at_most_0_13_sigma(photons in prop_oneof![
        0.0f32..2.0, 0.0f32..1e4, 0.0f32..6.7e7, Just(0.0), Just(f32::MIN_POSITIVE), Just(1e-40), Just(6.7e7),
    ], scale in prop_oneof![Just(1.0f32), 1e-3f32..1e6]) {
        let code = SquareRoot::new(0.25, scale);
        let h = photons / scale;
        let q = code.encode(h);
        prop_assert_ne!(q, SATURATED);
        let n = f64::from(h) * f64::from(scale);
        let error = (f64::from(code.decode(q)) * f64::from(scale) - n).abs() / n.max(1.0).sqrt();
        prop_assert!(error <= 0.13, "{} at {} photons", error, n);
        prop_assert_eq!(code.encode(code.decode(q)), q);
    }

    #[test]
    fn the_square_root_code_is_monotonic(a in 0.0f32..7e7, b in 0.0f32..7e7) {
        let code = SquareRoot::new(0.25, 1.0);
        prop_assert!((a <= b) == (code.encode(a) <= code.encode(b)) || code.encode(a) == code.encode(b));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_histogram_round_trips(
        height in 1u32..70, width in 1u32..70, bins in 1u32..5, spots in 1u32..18, seed: u64, exponent in -30i32..30,
        plain: bool,
    ) {
        let profile = PROFILES[usize::from(plain)];
        let spec = DatasetSpec { height, width, spots, gate: Gate { bins, ..spec(profile).gate }, ..spec(profile) };
        let mut scene = Scene::new(&spec, seed);
        for h in &mut scene.transient {
            *h = libm::ldexpf(*h, exponent);
        }
        scene.scale = photon_scale(&scene.transient, bins as usize, 400.0);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let (_, dataset) = in_memory(&spec).await;
            dataset.publish(0, &scene.record(), &provenance()).await.unwrap();
            let h = dataset.read_transient(0).await.unwrap();
            for (a, b) in h.iter().zip(&scene.transient) {
                let n = f64::from(*b) * f64::from(scene.scale);
                let error = (f64::from(*a) * f64::from(scene.scale) - n).abs() / n.max(1.0).sqrt();
                assert!(error <= if plain { 0.0 } else { 0.13 }, "{error} at {n} photons");
            }
            assert_eq!(dataset.read_visibility(0).await.unwrap(), scene.visibility);
            assert_eq!(dataset.read::<u32>(0, Quantity::Instance).await.unwrap(), scene.instance);
        });
    }
}

#[test]
fn the_photon_scale_puts_the_median_peak_at_400() {
    let mut h = vec![0f32; 5 * 3];
    for (pixel, peak) in [1.0, 2.0, 4.0, 1e9].into_iter().enumerate() {
        h[pixel * 3 + 1] = peak;
    }
    assert_eq!(photon_scale(&h, 3, 400.0), 200.0);
    assert_eq!(photon_scale(&[0.0; 6], 3, 400.0), 1.0);
}
