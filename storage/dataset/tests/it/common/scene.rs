//! A small scene with every kind of value, and stores for it.
use std::sync::Arc;

use object_store::ObjectStore;
use object_store::memory::InMemory;
use object_store::path::Path;
use picofarm_dataset::*;
use serde_json::json;

/// 40×36 pixels, so that tiles at the right and the bottom are cut off, and 9 spots, so that there
/// are two bytes of bits.
pub fn spec(profile: Profile) -> DatasetSpec {
    DatasetSpec {
        scenes: 4,
        height: 36,
        width: 40,
        spots: 9,
        subsets: Subsets::NONE,
        per_spot: false,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        gate: Gate {
            start_m: 1.0,
            bin_width_m: 0.0384,
            bins: 24,
        },
        profile,
    }
}

/// The owner of the data that a record borrows.
pub struct Scene {
    pub transient: Vec<f32>,
    pub depth: Vec<f32>,
    pub range: Vec<f32>,
    pub normal: Vec<f32>,
    pub instance: Vec<u32>,
    pub label: Vec<u16>,
    pub specular: Vec<u8>,
    pub visibility: Vec<u8>,
    pub rgb: Vec<f32>,
    pub spots: Vec<Option<Spot>>,
    pub scale: f32,
}

/// A separate small generator, so that the golden bytes depend on nothing else.
pub struct Lcg(pub u64);

impl Lcg {
    pub fn next(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
    }
}

impl Scene {
    pub fn new(spec: &DatasetSpec, seed: u64) -> Self {
        let mut random = Lcg(seed);
        let (pixels, bins) = (spec.pixels(), spec.gate.bins as usize);
        let mut transient = vec![0f32; pixels * bins];
        for h in transient.chunks_exact_mut(bins) {
            let peak = (random.next() * bins as f32) as usize;
            let height = 0.5 + random.next();
            for (b, h) in h.iter_mut().enumerate().skip(peak) {
                let tail = 1.0 / (1 + b - peak) as f32;
                *h = height * tail * tail * (0.9 + 0.2 * random.next());
            }
        }
        let mut unit = |n: usize| (0..n).map(|_| random.next()).collect::<Vec<f32>>();
        let spots = (0..spec.spots as usize)
            .map(|i| {
                let at = i as f32;
                (i != 3).then_some(Spot {
                    position: [at - 2.0, 0.5 * at, 3.0],
                    normal: [0.0, 0.0, -1.0],
                    path_m: 3.0 + at,
                })
            })
            .collect();
        let scale = photon_scale(&transient, bins, 400.0);
        Self {
            transient,
            depth: unit(pixels).iter().map(|x| 1.0 + 3.0 * x).collect(),
            range: unit(pixels).iter().map(|x| 2.0 + 3.0 * x).collect(),
            normal: unit(pixels * 3).iter().map(|x| 2.0 * x - 1.0).collect(),
            instance: unit(pixels)
                .iter()
                .map(|x| (x * 100_000.0) as u32)
                .collect(),
            label: unit(pixels).iter().map(|x| (x * 40.0) as u16).collect(),
            specular: unit(pixels).iter().map(|x| u8::from(*x > 0.9)).collect(),
            visibility: unit(pixels * spec.spots as usize)
                .iter()
                .map(|x| u8::from(*x > 0.4))
                .collect(),
            rgb: unit(pixels * 3),
            spots,
            scale,
        }
    }

    pub fn record(&self) -> SceneRecord<'_> {
        SceneRecord {
            transient: &self.transient,
            subsets: &[],
            depth: &self.depth,
            range: &self.range,
            normal: &self.normal,
            instance: &self.instance,
            label: &self.label,
            specular: &self.specular,
            visibility: &self.visibility,
            two_bounce: &[],
            rgb: &self.rgb,
            spots: &self.spots,
            intrinsics: Intrinsics {
                fx: 20.0,
                fy: 20.0,
                cx: 20.0,
                cy: 18.0,
            },
            camera: [
                [1.0, 0.0, 0.0, 0.25],
                [0.0, -1.0, 0.0, 1.5],
                [0.0, 0.0, -1.0, -0.125],
                [0.0, 0.0, 0.0, 1.0],
            ],
            laser: [0.0625, 0.0, 0.0],
            scale: self.scale,
        }
    }
}

pub fn provenance() -> Provenance {
    Provenance {
        task_key: "task-0123".into(),
        renderer: "transient-1".into(),
        seed: 7,
        plan: json!({"strategies": ["two-bounce deterministic 4x4"], "approximations": []}),
    }
}

pub async fn in_memory(spec: &DatasetSpec) -> (Arc<dyn ObjectStore>, Dataset) {
    let store: Arc<dyn ObjectStore> = Arc::new(InMemory::new());
    let dataset = Dataset::create_or_open(store.clone(), Path::from("sets/a"), spec)
        .await
        .unwrap();
    (store, dataset)
}

pub const PROFILES: [Profile; 2] = [Profile::SqrtU16 { delta: 0.2 }, Profile::LOSSLESS];
