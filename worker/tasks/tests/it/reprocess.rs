//! Reprocessing of stored scenes: the sensor's effects in closed form, equal bytes on any number of
//! threads, adoption, and refused inputs. The sources are synthetic: nothing is rendered.

use std::{collections::BTreeMap, fs, path::Path, sync::Arc};

use picofarm_dataset::*;
use picofarm_proto::{
    key::{TaskKey, derived_key},
    spec::{Histogram, OutputSettings, ReprocessSettings, ReprocessTask, Sensor, SourceSettings},
};
use picofarm_settings::{DeadTime, Jitter, PS_PER_M, Pulse, Scale, TimeGate, Zones};
use picofarm_store::*;
use picofarm_tasks::{
    Control, Output, TaskError,
    reprocess::{Reprocessor, sensor_version},
};
use serde_json::json;
use sha2::Digest;
use tempfile::TempDir;

const SIDE: u32 = 40;
const BINS: u32 = 48;
const PIXELS: usize = (SIDE * SIDE) as usize;

/// A sensor that changes only the unit: one photon per 1/1000 of h.
fn ideal() -> Sensor {
    Sensor {
        pulse: Pulse::None {},
        jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
        scale: Scale::Fixed {
            photons_per_unit: 1000.0,
        },
        poisson: false,
        ..Sensor::default()
    }
}

struct Place {
    dir: TempDir,
    settings: ReprocessSettings,
    target: OutputSettings,
}

impl Place {
    fn new(sensor: Sensor) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let store = dir.path().to_str().unwrap().to_owned();
        let profile = if sensor.poisson {
            "counts-u16"
        } else {
            "lossless"
        };
        Self {
            settings: ReprocessSettings {
                histogram: Histogram::Transient,
                spots: vec![],
                sensor,
                drop_left_over: false,
                // Some of these sources have whole numbers.
                on_counts: true,
                seed: 0,
                version: sensor_version(),
            },
            target: OutputSettings {
                store,
                dataset: "target".into(),
                profile: profile.into(),
            },
            dir,
        }
    }

    /// Publishes scene `index` of a source with capacity four and histogram `h(pixel, bin)`.
    async fn publish(&self, index: u64, h: impl Fn(usize, usize) -> f32) {
        self.publish_as(index, spec(9), h).await;
    }

    async fn publish_as(&self, index: u64, spec: DatasetSpec, h: impl Fn(usize, usize) -> f32) {
        let bins = BINS as usize;
        let transient: Vec<f32> = (0..PIXELS * bins).map(|i| h(i / bins, i % bins)).collect();
        // Spot s has (s + 1)/55 of the light of all ten.
        let share = |spots: &[u32]| -> Vec<f32> {
            let part: u32 = spots.iter().map(|s| s + 1).sum();
            transient.iter().map(|h| h * part as f32 / 5050.0).collect()
        };
        let each: Vec<Vec<f32>> = (0..spec.spots).map(|s| share(&[s])).collect();
        let four = share(Quantity::Transient4.spots_of_100());
        let mut subsets = vec![];
        for quantity in spec.quantities() {
            let planes = match quantity {
                Quantity::Transient4 => vec![&four[..]],
                Quantity::TransientSpots => each.iter().map(Vec::as_slice).collect(),
                _ => continue,
            };
            subsets.push(SubsetRecord { quantity, planes });
        }
        let lengths: Vec<f32> = (0..PIXELS).map(|p| 1.0 + p as f32 / 7.0).collect();
        let visibility: Vec<u8> = (0..PIXELS * spec.spots as usize)
            .map(|i| u8::from(i % 7 < 4 || i % 11 == 0))
            .collect();
        let spots: Vec<_> = (0..spec.spots)
            .map(|s| {
                (s != 3).then_some(Spot {
                    position: [s as f32, 0.5, 3.0],
                    normal: [0.0, 0.0, -1.0],
                    path_m: 3.0,
                })
            })
            .collect();
        let record = SceneRecord {
            transient: &transient,
            subsets: &subsets,
            depth: &lengths,
            range: &lengths,
            normal: &vec![0.5; PIXELS * 3],
            instance: &vec![70_000; PIXELS],
            label: &vec![3; PIXELS],
            specular: &vec![1; PIXELS],
            visibility: &visibility,
            two_bounce: &[],
            rgb: &vec![0.25; PIXELS * 3],
            spots: &spots,
            intrinsics: Intrinsics {
                fx: 20.0,
                fy: 20.0,
                cx: 20.0,
                cy: 20.0,
            },
            camera: [[1.0; 4]; 4],
            laser: [0.1, 0.0, 0.0],
            scale: 400.0,
        };
        let provenance = Provenance {
            task_key: TaskKey([index as u8 + 1; 32]).to_string(),
            renderer: "transient-1".into(),
            seed: 7,
            plan: json!({"labels": ["floor"], "scene": {"seed": index}}),
        };
        let source = self.open("source", Some(&spec)).await;
        source.publish(index, &record, &provenance).await.unwrap();
    }

    async fn open(&self, name: &str, spec: Option<&DatasetSpec>) -> Dataset {
        let (store, prefix) = open_store(self.dir.path().join(name).to_str().unwrap()).unwrap();
        match spec {
            Some(spec) => Dataset::create_or_open(store, prefix, spec).await.unwrap(),
            None => Dataset::open(store, prefix).await.unwrap(),
        }
    }

    async fn run(&self, index: u64) -> Result<Output, TaskError> {
        self.run_on(2, index).await
    }

    async fn run_on(&self, threads: usize, index: u64) -> Result<Output, TaskError> {
        let task = ReprocessTask {
            source: SourceSettings {
                store: self.target.store.clone(),
                dataset: "source".into(),
            },
            count: 4,
            reprocess: self.settings.clone(),
            output: self.target.clone(),
        };
        let reprocessor = Reprocessor::new(tokio::runtime::Handle::current());
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        tokio::task::spawn_blocking(move || {
            let control = Arc::new(Control::default());
            pool.install(|| reprocessor.run(&task, index, &control))
        })
        .await
        .unwrap()
    }

    /// Returns scene 0 after the sensor: photons as `[pixel][bin]`, and the gate.
    async fn photons(&self) -> (Vec<f64>, Gate) {
        self.run(0).await.unwrap();
        let target = self.open("target", None).await;
        let scale = f64::from(target.manifest(0).await.unwrap().scale);
        let h = target.read_transient(0).await.unwrap();
        let photons = h.iter().map(|h| f64::from(*h) * scale).collect();
        (photons, target.spec().gate)
    }

    async fn complaint(&self, index: u64) -> String {
        match self.run(index).await {
            Err(TaskError::User(text)) => text,
            other => panic!("expected a user's error, found {other:?}"),
        }
    }

    fn files(&self, dataset: &str) -> BTreeMap<String, Vec<u8>> {
        let mut all = BTreeMap::new();
        walk(&self.dir.path().join(dataset), "", &mut all);
        all
    }
}

fn walk(folder: &Path, name: &str, all: &mut BTreeMap<String, Vec<u8>>) {
    for entry in fs::read_dir(folder).unwrap() {
        let entry = entry.unwrap();
        let name = format!("{name}/{}", entry.file_name().to_str().unwrap());
        match entry.path().is_dir() {
            true => walk(&entry.path(), &name, all),
            false => drop(all.insert(name, fs::read(entry.path()).unwrap())),
        }
    }
}

fn spec(spots: u32) -> DatasetSpec {
    DatasetSpec {
        scenes: 4,
        height: SIDE,
        width: SIDE,
        spots,
        subsets: Subsets::NONE,
        per_spot: false,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        gate: Gate {
            start_m: 0.9,
            bin_width_m: 0.002_398_34,
            bins: BINS,
        },
        profile: Profile::LOSSLESS,
    }
}

/// A histogram with some light in every bin and a peak that varies by pixel.
fn lively(pixel: usize, bin: usize) -> f32 {
    let peak = pixel % 40;
    if bin < peak {
        0.0
    } else {
        0.05 / (1 + bin - peak) as f32
    }
}

#[tokio::test]
async fn photon_counts_get_another_sensors_noise_only_when_asked() {
    let counts = |p: usize, b: usize| ((p + b) % 5) as f32 / 400.0;
    let mut place = Place::new(Sensor::default());
    place.settings.on_counts = false;
    place.publish(0, counts).await;
    let TaskError::User(said) = place.run(0).await.unwrap_err() else {
        panic!("the user's mistake");
    };
    for word in [
        "scene 0",
        "photon counts",
        "sensor.pulse",
        "reprocess.on_counts = true",
    ] {
        assert!(said.contains(word), "{word}: {said}");
    }
    place.settings.on_counts = true;
    place.run(0).await.unwrap();
    let mut place = Place::new(Sensor {
        scale: Scale::Fixed {
            photons_per_unit: 1.0,
        },
        rebin: 2,
        ..ideal()
    });
    place.settings.on_counts = false;
    place.publish(0, counts).await;
    place.run(0).await.unwrap();
    place.settings.sensor.dark_per_bin = 0.1;
    place.target.dataset = "another".into();
    let TaskError::User(said) = place.run(0).await.unwrap_err() else {
        panic!("the user's mistake");
    };
    assert!(said.contains("sensor.dark_per_bin"), "{said}");
}

#[tokio::test]
async fn rebinning_keeps_every_photon_and_the_gate() {
    let mut place = Place::new(ideal());
    place.publish(0, lively).await;
    let (fine, gate) = place.photons().await;
    assert_eq!(gate, spec(9).gate);
    place.target.dataset = "coarse".into();
    place.settings.sensor.rebin = 4;
    place.run(0).await.unwrap();
    let coarse = place.open("coarse", None).await;
    let h = coarse.read_transient(0).await.unwrap();
    assert_eq!(coarse.spec().gate.bins, 12);
    assert_eq!(coarse.spec().gate.bin_width_m, 4.0 * 0.002_398_34);
    assert_eq!(coarse.spec().gate.start_m, 0.9);
    for (h, four) in h.iter().zip(fine.chunks_exact(4)) {
        let sum: f64 = four.iter().sum();
        assert!((f64::from(*h) * 1000.0 - sum).abs() <= 1e-6 * sum.max(1.0));
    }
}

#[tokio::test]
async fn left_over_bins_are_dropped_only_on_request() {
    let mut place = Place::new(ideal());
    place.publish(0, lively).await;
    place.settings.sensor.rebin = 5;
    let text = place.complaint(0).await;
    assert!(
        text.contains("reprocess.sensor.rebin") && text.contains("48") && text.contains("last 3"),
        "{text}"
    );
    place.settings.drop_left_over = true;
    place.run(0).await.unwrap();
    assert_eq!(place.open("target", None).await.spec().gate.bins, 9);
}

#[tokio::test]
async fn the_sensors_own_bins_are_those_of_the_target() {
    // Twelve bins, each of four of the source's, from the source's eighth on.
    let (width_ps, start_ps) = (0.002_398_34 * PS_PER_M, 0.9 * PS_PER_M);
    let place = Place::new(Sensor {
        gate: Some(TimeGate {
            start_ps: start_ps + 8.0 * width_ps,
            bin_width_ps: 4.0 * width_ps,
            bins: 10,
        }),
        ..ideal()
    });
    place.publish(0, lively).await;
    let (photons, gate) = place.photons().await;
    assert_eq!(gate.bins, 10);
    assert!((gate.start_m - 0.9 - 8.0 * 0.002_398_34).abs() < 1e-9);
    assert!((gate.bin_width_m - 4.0 * 0.002_398_34).abs() < 1e-9);
    for (pixel, h) in photons.chunks_exact(10).enumerate() {
        for (bin, photons) in h.iter().enumerate() {
            let sum: f64 = (0..4)
                .map(|k| f64::from(lively(pixel, 8 + 4 * bin + k)) * 1000.0)
                .sum();
            assert!(
                (photons - sum).abs() <= 1e-5 * sum.max(1.0),
                "{pixel} {bin}"
            );
        }
    }
}

#[tokio::test]
async fn zones_of_a_data_set_are_its_pixels_or_refused() {
    let zones = |rows, columns| Sensor {
        zones: Some(Zones { rows, columns }),
        ..ideal()
    };
    let place = Place::new(zones(8, 8));
    place.publish(0, lively).await;
    let text = place.complaint(0).await;
    assert!(
        text.contains("reprocess.sensor.zones") && text.contains("one pixel for each zone"),
        "{text}"
    );
    let place = Place::new(zones(SIDE, SIDE));
    place.publish(0, lively).await;
    let (photons, _) = place.photons().await;
    assert!((photons[5] - f64::from(lively(0, 5)) * 1000.0).abs() < 1e-3);
}

#[tokio::test]
async fn counts_are_whole_and_have_the_mean_and_the_variance_of_poisson() {
    let place = Place::new(Sensor {
        poisson: true,
        dark_per_bin: 1.5,
        ..ideal()
    });
    place.publish(0, |_, _| 0.0055).await;
    let (counts, _) = place.photons().await;
    assert!(counts.iter().all(|c| (c - c.round()).abs() < 1e-4));
    let n = counts.len() as f64;
    let mean = counts.iter().sum::<f64>() / n;
    let variance = counts.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / (n - 1.0);
    // λ = 7; the variance of the sample variance of n Poisson numbers is about (2λ² + λ)/n.
    assert!((mean - 7.0).abs() < 5.0 * (7.0 / n).sqrt(), "{mean}");
    assert!(
        (variance - 7.0).abs() < 5.0 * (105.0 / n).sqrt(),
        "{variance}"
    );
}

#[tokio::test]
async fn a_pulse_moves_light_but_makes_and_loses_none() {
    let sampled = Pulse::Sampled {
        bin_width_ps: 8.0,
        values: vec![1.0, 2.0, 1.0, 0.0, 4.0],
        zero_bin: Some(0.0),
    };
    let place = Place::new(Sensor {
        pulse: sampled,
        ..ideal()
    });
    let lit = |p: usize| 10 + p % 20;
    place
        .publish(0, |p, b| if b == lit(p) { 0.04 } else { 0.0 })
        .await;
    let (photons, _) = place.photons().await;
    for (p, h) in photons.chunks_exact(BINS as usize).enumerate() {
        assert!((h.iter().sum::<f64>() - 40.0).abs() < 1e-3);
        let mean: f64 = h
            .iter()
            .zip(0..)
            .map(|(h, b)| h * f64::from(b))
            .sum::<f64>()
            / 40.0;
        // The mean of the pulse, (2·1 + 1·2 + 4·4)/8 of its bins, which are the histogram's bins
        // within 10⁻⁵.
        assert!((mean - lit(p) as f64 - 2.5).abs() < 1e-3, "{mean}");
    }
}

#[tokio::test]
async fn pile_up_follows_its_formula() {
    let pulses = 100;
    let place = Place::new(Sensor {
        dead_time: Some(DeadTime::FirstPhoton { pulses }),
        ..ideal()
    });
    // 50 photons would arrive in bin 5, 30 in bin 9.
    let h = |b: usize| {
        [(5, 0.05), (9, 0.03)]
            .iter()
            .find(|l| l.0 == b)
            .map_or(0.0, |l| l.1)
    };
    place.publish(0, move |_, b| h(b)).await;
    let (photons, _) = place.photons().await;
    let n = pulses as f64;
    let first = n * (1.0 - (-50.0 / n).exp());
    let second = n * (-50.0 / n).exp() * (1.0 - (-30.0 / n).exp());
    for h in photons.chunks_exact(BINS as usize) {
        assert!(
            (h[5] - first).abs() < 1e-3 && (h[9] - second).abs() < 1e-3,
            "{h:?}"
        );
    }
}

#[tokio::test]
async fn the_same_bytes_on_any_number_of_threads_and_the_second_time_they_are_adopted() {
    let mut place = Place::new(Sensor::default());
    place.publish(0, lively).await;
    place.run_on(1, 0).await.unwrap();
    let alone = place.files("target");
    for (threads, dataset) in [(2, "two"), (7, "seven")] {
        place.target.dataset = dataset.into();
        let made = place.run_on(threads, 0).await.unwrap();
        assert!(!made.adopted);
        assert!(place.files(dataset) == alone, "{threads} threads");
        let again = place.run_on(threads, 0).await.unwrap();
        assert!(again.adopted);
        assert_eq!(
            (again.bytes, again.manifest_sha256),
            (made.bytes, made.manifest_sha256)
        );
    }
    assert!(place.files("seven") == alone);
    // Another seed gives another draw, which does not replace the stored one.
    place.settings.seed = 1;
    let text = place.complaint(0).await;
    assert!(
        text.contains("output.dataset") && text.contains("another job"),
        "{text}"
    );
    place.target.dataset = "other".into();
    place.run(0).await.unwrap();
    assert!(place.files("other")["/transient/c/0/0/0/0"] != alone["/transient/c/0/0/0/0"]);
}

#[tokio::test]
async fn the_target_is_usable_alone_and_knows_where_it_comes_from() {
    let place = Place::new(Sensor::default());
    place.publish(2, lively).await;
    place.run(2).await.unwrap();
    let (source, target) = (place.files("source"), place.files("target"));
    for truth in [
        "depth",
        "range",
        "normal",
        "instance",
        "label",
        "specular",
        "visibility",
        "rgb",
        "spots",
        "intrinsics",
        "camera",
        "laser",
    ] {
        let of = |files: &BTreeMap<String, Vec<u8>>| -> Vec<Vec<u8>> {
            let prefix = format!("/{truth}/c/2");
            let mut found = files.iter().filter(|f| f.0.starts_with(&prefix));
            found.by_ref().map(|f| f.1.clone()).collect()
        };
        assert!(
            !of(&source).is_empty() && of(&source) == of(&target),
            "{truth}"
        );
    }
    let manifest = place.open("target", None).await.manifest(2).await.unwrap();
    let provenance = &manifest.provenance;
    let source_key = TaskKey([3; 32]);
    let stage = place.settings.stage_key(&place.target.profile);
    assert_eq!(
        provenance.task_key,
        derived_key(&stage, &source_key).to_string()
    );
    assert_eq!(provenance.renderer, sensor_version());
    let plan = &provenance.plan;
    assert_eq!(plan["source"]["task_key"], source_key.to_string());
    let hash = sha2::Sha256::digest(&source["/manifests/2.json"]);
    assert_eq!(plan["source"]["manifest_sha256"], hex::encode(hash));
    assert_eq!(plan["labels"], json!(["floor"]));
    let verified = place
        .open("target", None)
        .await
        .verify(VerifyMode::Full)
        .await
        .unwrap();
    assert!(verified.is_sound(), "{:?}", verified.problems);
}

#[tokio::test]
async fn chosen_spots_are_summed_and_only_theirs_is_the_truth() {
    let mut place = Place::new(ideal());
    let hundred = DatasetSpec {
        per_spot: true,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        subsets: Subsets::of(&[4]).unwrap(),
        ..spec(100)
    };
    place.publish_as(0, hundred, lively).await;
    let source = place.open("source", None).await;
    let (all, lit) = (
        source.read_transient(0).await.unwrap(),
        source.read_visibility(0).await.unwrap(),
    );
    let spots = source.read_spots(0).await.unwrap();
    for (histogram, chosen) in [
        (Histogram::TransientSpots, vec![3, 9, 64]),
        (Histogram::Transient4, vec![22, 27, 72, 77]),
    ] {
        place.settings.histogram = histogram;
        place.settings.spots = match histogram {
            Histogram::TransientSpots => chosen.clone(),
            _ => vec![],
        };
        place.target.dataset = histogram.name().into();
        place.run(0).await.unwrap();
        let target = place.open(histogram.name(), None).await;
        assert_eq!(target.spec().spots as usize, chosen.len());
        let part = chosen.iter().map(|s| s + 1).sum::<u32>() as f32 / 5050.0;
        let h = target.read_transient(0).await.unwrap();
        for (h, all) in h.iter().zip(&all) {
            assert!(
                (h - all * part).abs() <= 1e-5 * all * part,
                "{h} {}",
                all * part
            );
        }
        let expected: Vec<u8> = chosen
            .iter()
            .flat_map(|s| &lit[*s as usize * PIXELS..][..PIXELS])
            .copied()
            .collect();
        assert!(target.read_visibility(0).await.unwrap() == expected);
        let expected: Vec<_> = chosen.iter().map(|s| spots[*s as usize]).collect();
        assert_eq!(target.read_spots(0).await.unwrap(), expected);
    }
    place.settings.histogram = Histogram::TransientSpots;
    place.settings.spots = vec![5, 100];
    let text = place.complaint(0).await;
    assert!(
        text.contains("reprocess.spots: 100") && text.contains("100 spots"),
        "{text}"
    );
}

#[tokio::test]
async fn counts_beyond_sixteen_bits_are_kept() {
    let place = Place::new(Sensor {
        poisson: true,
        ..ideal()
    });
    let bright = |p: usize, b: usize| if (p, b) == (7, 3) { 500.0 } else { 0.001 };
    place.publish(0, bright).await;
    let (counts, _) = place.photons().await;
    let found = counts[7 * BINS as usize + 3];
    assert!((found - 5e5).abs() < 5.0 * 5e5f64.sqrt(), "{found}");
}

#[tokio::test]
async fn a_scene_that_is_not_there_is_named_and_one_that_cannot_be_is_refused() {
    let mut place = Place::new(Sensor::default());
    let text = place.complaint(0).await;
    assert!(
        text.starts_with("source: ") && text.contains("no data set here"),
        "{text}"
    );
    place.publish(0, lively).await;
    match place.run(1).await {
        Err(TaskError::User(text)) => assert!(text.contains("scene 1 is not there")),
        other => panic!("{other:?}"),
    }
    let text = place.complaint(4).await;
    assert!(text.contains("room for 4 scenes"), "{text}");
    for (histogram, names) in [
        (Histogram::Transient25, "transient_25"),
        (Histogram::TransientSpots, "transient_spots"),
    ] {
        place.settings.histogram = histogram;
        if histogram == Histogram::TransientSpots {
            place.settings.spots = vec![1];
        }
        let text = place.complaint(0).await;
        assert!(
            text.starts_with("reprocess.histogram: ")
                && text.contains(&format!("no {names}; it has transient")),
            "{text}"
        );
    }
    place.settings.histogram = Histogram::Transient;
    place.settings.spots = vec![];
    place.settings.version = "sensor-0/encoder-0".into();
    assert!(place.complaint(0).await.starts_with("reprocess.version"));
    place.settings.version = sensor_version();
    place.target.profile = "gzip".into();
    assert!(place.complaint(0).await.starts_with("output.profile"));
    place.target.profile = "counts-u16".into();
    place.target.dataset = "source".into();
    let text = place.complaint(0).await;
    assert!(text.starts_with("output.dataset"), "{text}");
    assert!(!place.dir.path().join("target").exists());
}

#[tokio::test]
async fn a_damaged_source_is_named_and_nothing_is_published_from_it() {
    let place = Place::new(Sensor::default());
    place.publish(0, lively).await;
    let victim = place.dir.path().join("source/depth/c/0/0/0");
    let mut bytes = fs::read(&victim).unwrap();
    bytes[9] ^= 1;
    fs::write(&victim, bytes).unwrap();
    match place.run(0).await {
        Err(TaskError::Damaged(text)) => assert!(text.contains("source/depth/c/0/0/0"), "{text}"),
        other => panic!("expected the store's trouble, found {other:?}"),
    }
    assert!(!place.dir.path().join("target/manifests").exists());
}
