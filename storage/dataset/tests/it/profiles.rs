//! Tests of each profile's guarantee: the maximum error of the values read, and that the manifest
//! states it.

use crate::common;

use std::ops::Range;
use std::sync::Arc;

use common::tricky::Tricky;
use common::*;
use object_store::ObjectStoreExt;
use object_store::memory::InMemory;
use object_store::path::Path;
use picofarm_dataset::*;
use picofarm_store::*;

/// 300 bins: three inner chunks along the bins, the last one cut off.
fn long(profile: Profile) -> DatasetSpec {
    let small = spec(profile);
    DatasetSpec {
        gate: Gate {
            bins: 300,
            ..small.gate
        },
        ..small
    }
}

#[tokio::test]
async fn errors_stay_within_the_promise_and_the_manifest_states_them() {
    // The square root's bound is Δ/2 + Δ²/16.
    let promised = [
        ("sqrt-u16", 0.1 + 0.0025),
        ("balanced", 0.25 + 0.0156),
        ("coarse", 0.5 + 0.0625),
        ("plain-f32", 0.25),
        ("lossless", 0.0),
    ];
    for (name, bound) in promised {
        let profile = Profile::parse(name).unwrap();
        let spec = long(profile);
        let (_, dataset) = in_memory(&spec).await;
        let mut scene = Scene::new(&spec, 5);
        let bright = 7_777;
        scene.transient[bright] = 9.876_543e8 / scene.scale;
        let manifest = dataset
            .publish(0, &scene.record(), &provenance())
            .await
            .unwrap();
        let h = dataset.read_transient(0).await.unwrap();
        let overflows = matches!(profile, Profile::SqrtU16 { delta } if delta < 1.0);
        let (mut worst, mut squares) = (0f64, 0f64);
        for (at, (found, given)) in h.iter().zip(&scene.transient).enumerate() {
            let n = f64::from(*given) * f64::from(scene.scale);
            let error = f64::from(found - given) * f64::from(scene.scale) / n.max(1.0).sqrt();
            // Listed exactly, whatever the code's error is there.
            if at == bright && overflows {
                assert_eq!(found, given);
            }
            worst = worst.max(error.abs());
            squares += error * error;
        }
        let rms = (squares / h.len() as f64).sqrt();
        assert!(worst <= bound + 1e-4, "{name}: {worst}");
        let error = manifest.error;
        assert!(
            (error.max_sigma - worst).abs() < 1e-3,
            "{name}: {error:?}, found {worst}"
        );
        assert!(
            (error.rms_sigma - rms).abs() < 1e-3,
            "{name}: {error:?}, found {rms}"
        );
        assert_eq!(error.overflowed, Some(u64::from(overflows)), "{name}");
        assert_eq!(Some(manifest.overflow.len() as u64), error.overflowed);
        assert_eq!(worst == 0.0, name == "lossless");
        assert_eq!(dataset.manifest(0).await.unwrap().profile, profile);
    }
}

#[tokio::test]
async fn the_default_keeps_its_rms_whatever_the_scene() {
    // Uniform in √N, the worst case: every bin has light. 0.2/√12 = 0.0577.
    let spec = long(Profile::default());
    let (_, dataset) = in_memory(&spec).await;
    let mut scene = Scene::new(&spec, 6);
    let mut random = Lcg(9);
    scene.scale = 1.0;
    for h in &mut scene.transient {
        *h = (1.0 + 40.0 * random.next()).powi(2);
    }
    let encoded = dataset.encode(0, &scene.record(), &provenance());
    let error = encoded.unwrap().manifest.error;
    assert!((0.056..0.06).contains(&error.rms_sigma), "{error:?}");
}

#[tokio::test]
async fn any_part_equals_the_same_part_of_the_whole() {
    for profile in [Profile::default(), Profile::LOSSLESS, Profile::PLAIN] {
        let spec = long(profile);
        let (_, dataset) = in_memory(&spec).await;
        let mut scene = Scene::new(&spec, 3);
        let at = |row: u32, column: u32, bin: u32| ((row * 40 + column) * 300 + bin) as usize;
        scene.transient[at(33, 39, 128)] = 3e9 / scene.scale;
        dataset
            .publish(0, &scene.record(), &provenance())
            .await
            .unwrap();
        let whole = dataset.read_transient(0).await.unwrap();
        for (rows, columns, bins) in [
            (0..1, 0..1, 0..1),
            (31..34, 30..40, 127..129),
            (3..30, 5..20, 128..256),
            (0..36, 32..40, 290..300),
            (33..34, 39..40, 128..129),
            (0..36, 0..40, 0..300),
        ] {
            let part = dataset
                .read_transient_part(0, rows.clone(), columns.clone(), bins.clone())
                .await
                .unwrap();
            let mut expected = Vec::new();
            for row in rows {
                for column in columns.clone() {
                    let of = at(row, column, bins.start)..at(row, column, bins.end - 1) + 1;
                    expected.extend_from_slice(&whole[of]);
                }
            }
            assert_eq!(part, expected, "{profile}");
        }
        let mut again = vec![f32::NAN; whole.len()];
        dataset
            .read_histogram_into(0, Quantity::Transient, &mut again)
            .await
            .unwrap();
        assert_eq!(again, whole);
        let mut planes = vec![f32::NAN; 3];
        dataset
            .read_planes_into(0, Quantity::Transient, &mut planes)
            .await
            .unwrap();
        let pixels = 36 * 40;
        let of_pixel = |i: usize| planes[i % 300 * pixels + i / 300];
        assert!(
            (0..whole.len()).map(of_pixel).eq(whole.iter().copied()),
            "{profile}"
        );
        let mut codes = vec![7; 3];
        let read = dataset.read_codes_into(0, Quantity::Transient, &mut codes);
        match (spec.profile, read.await) {
            (Profile::SqrtU16 { delta }, Ok(())) => {
                let scale = dataset.manifest(0).await.unwrap().scale;
                let code = SquareRoot::new(delta, scale);
                let decoded = codes.iter().zip(&planes).all(|(q, h)| match *q {
                    SATURATED => *h > code.decode(SATURATED - 1),
                    q => code.decode(q) == *h,
                });
                assert!(decoded && codes.len() == planes.len(), "{profile}");
            }
            (_, read) => {
                let error = read.unwrap_err().to_string();
                assert!(error.starts_with("profile: "), "{profile}: {error}");
            }
        }
        let error = dataset.read_transient_part(0, 0..1, 0..1, 300..301).await;
        assert!(error.unwrap_err().to_string().starts_with("bins: expected"));
    }
}

/// Returns the byte ranges of a shard's inner chunks, from its index.
fn chunks_of(shard: &[u8], chunks: usize) -> Vec<Range<u64>> {
    let index = &shard[shard.len() - 4 - chunks * 16..shard.len() - 4];
    let number = |b: &[u8]| u64::from_le_bytes(b.try_into().unwrap());
    let pairs = index.chunks_exact(16);
    pairs
        .map(|pair| (number(&pair[..8]), number(&pair[8..])))
        .map(|(start, len)| start..start + len)
        .collect()
}

#[tokio::test]
async fn a_part_fetches_and_decodes_the_inner_chunks_it_touches_and_no_other() {
    let spec = DatasetSpec {
        height: 64,
        width: 96,
        ..long(Profile::default())
    };
    let memory = Arc::new(InMemory::new());
    let store = Arc::new(Tricky::new(memory.clone()));
    let dataset = Dataset::create_or_open(store.clone(), Path::from("sets/a"), &spec)
        .await
        .unwrap();
    let scene = Scene::new(&spec, 3);
    dataset
        .publish(0, &scene.record(), &provenance())
        .await
        .unwrap();
    let at = Path::from("sets/a/transient/c/0/0/0/0");
    let shard = memory.get(&at).await.unwrap().bytes().await.unwrap();
    // 2 by 3 tiles of 3 slabs.
    let chunks = chunks_of(&shard, 18);
    let whole = dataset.read_transient(0).await.unwrap();

    // Rows of the lower tiles, columns of the second and third, bins of the second slab.
    let needed = [(3 + 1) * 3 + 1, (3 + 2) * 3 + 1];
    let mut damaged = vec![0xa5; shard.len()];
    let index = shard.len() - 4 - 18 * 16;
    damaged[index..].copy_from_slice(&shard[index..]);
    for chunk in needed {
        let at = chunks[chunk].start as usize..chunks[chunk].end as usize;
        damaged[at.clone()].copy_from_slice(&shard[at]);
    }
    memory.put(&at, damaged.into()).await.unwrap();
    store.got.lock().unwrap().clear();
    let part = dataset.read_transient_part(0, 40..50, 60..70, 130..250);
    let part = part.await.unwrap();
    let first = (40 * 96 + 60) * 300 + 130;
    assert_eq!(part[..120], whole[first..first + 120]);

    let got = std::mem::take(&mut *store.got.lock().unwrap());
    let mut got: Vec<Range<u64>> = got
        .into_iter()
        .filter(|(object, ..)| *object == at)
        .map(|(_, start, end)| start..end)
        .collect();
    got.sort_by_key(|range| range.start);
    let mut expected: Vec<_> = needed.iter().map(|c| chunks[*c].clone()).collect();
    expected.push(index as u64..shard.len() as u64);
    assert_eq!(got, expected);
    let outside = dataset.read_transient_part(0, 40..50, 60..70, 127..250);
    outside.await.unwrap_err();
}

#[tokio::test]
async fn a_stream_of_scenes_keeps_their_order_and_outlives_a_missing_one() {
    use futures::StreamExt;
    let spec = spec(Profile::default());
    let (_, dataset) = in_memory(&spec).await;
    for i in [0, 1, 3] {
        let scene = Scene::new(&spec, i);
        dataset
            .publish(i, &scene.record(), &provenance())
            .await
            .unwrap();
    }
    let read: Vec<_> = dataset
        .read_transients(vec![3, 2, 0, 1, 3], 2)
        .collect()
        .await;
    let order: Vec<u64> = read.iter().map(|(scene, _)| *scene).collect();
    assert_eq!(order, [3, 2, 0, 1, 3]);
    for (scene, h) in read {
        match scene {
            2 => assert!(matches!(
                h,
                Err(StorageError::NotPublished { scene: 2, .. })
            )),
            _ => assert_eq!(h.unwrap(), dataset.read_transient(scene).await.unwrap()),
        }
    }
}

#[test]
fn the_names_that_jobs_use_are_all_there_are() {
    for name in Profile::NAMES {
        Profile::parse(name).unwrap();
    }
    let error = Profile::parse("gzip").unwrap_err();
    assert!(
        error.contains("\"coarse\"") && error.contains("\"lossless\""),
        "{error}"
    );
    let old: Profile = serde_json::from_str(r#"{"name": "plain-f32"}"#).unwrap();
    assert_eq!(old, Profile::LOSSLESS);
    let written = serde_json::to_string(&Profile::default()).unwrap();
    assert_eq!(written, r#"{"name":"sqrt-u16","delta":0.2}"#);
}
