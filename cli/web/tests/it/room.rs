//! A data set with a room that is known in closed form: a wall in front of the camera, and spots on
//! it.

use std::path::Path;

use picofarm_dataset::{
    Dataset, DatasetSpec, Gate, Intrinsics, Profile, Provenance, Quantity, SceneRecord, Spot,
    SubsetRecord, Subsets, Wavelength,
};
use serde_json::json;

pub const SIDE: usize = 20;
pub const BINS: usize = 70;
pub const SPOTS: usize = 2;
/// Distance of the wall, metres.
const WALL: f32 = 2.0;

pub const SPEC: DatasetSpec = DatasetSpec {
    scenes: 3,
    height: SIDE as u32,
    width: SIDE as u32,
    spots: SPOTS as u32,
    subsets: Subsets::NONE,
    per_spot: true,
    wavelengths_nm: Wavelength::NONE,
    two_bounce: false,
    gate: Gate {
        start_m: 1.0,
        bin_width_m: 0.125,
        bins: BINS as u32,
    },
    profile: Profile::SqrtU16 { delta: 0.2 },
};

/// h of a pixel's bin: spot s lights bin 10 + s + pixel mod 40.
pub fn h(spot: usize, pixel: usize, bin: usize) -> f32 {
    match bin == 10 + spot + pixel % 40 {
        true => 1.0 + spot as f32 + (pixel % 7) as f32,
        false => 0.0,
    }
}

/// Writes the data set `rooms` with scenes 0 and 2 into a store.
pub fn write(store: &Path) {
    let pixels = SIDE * SIDE;
    let plane = |spot: usize| -> Vec<f32> {
        let pixel = move |p| (0..BINS).map(move |b| h(spot, p, b));
        (0..pixels).flat_map(pixel).collect()
    };
    let planes = [plane(0), plane(1)];
    let transient: Vec<f32> = planes[0]
        .iter()
        .zip(&planes[1])
        .map(|(a, b)| a + b)
        .collect();
    let spot = |x: f32| Spot {
        position: [x, 0.0, WALL],
        normal: [0.0, 0.0, -1.0],
        path_m: x.hypot(WALL),
    };
    let record = SceneRecord {
        transient: &transient,
        subsets: &[SubsetRecord {
            quantity: Quantity::TransientSpots,
            planes: planes.iter().map(Vec::as_slice).collect(),
        }],
        depth: &vec![WALL; pixels],
        range: &vec![WALL; pixels],
        normal: &[0.0, 0.0, -1.0].repeat(pixels),
        instance: &vec![1; pixels],
        label: &vec![1; pixels],
        specular: &vec![0; pixels],
        // Spot 0 lights all, spot 1 the upper half.
        visibility: &(0..2 * pixels)
            .map(|i| u8::from(i < pixels + pixels / 2))
            .collect::<Vec<u8>>(),
        two_bounce: &[],
        rgb: &vec![0.5; 3 * pixels],
        spots: &[Some(spot(-0.5)), Some(spot(0.5))],
        intrinsics: Intrinsics {
            fx: 10.0,
            fy: 10.0,
            cx: 10.0,
            cy: 10.0,
        },
        camera: [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ],
        laser: [0.0; 3],
        scale: 400.0,
    };
    let provenance = Provenance {
        task_key: "task".into(),
        renderer: "transient".into(),
        seed: 1,
        plan: json!({
            "labels": ["<b>wall</b>"],
            "scene": {"notes": {"room_type": "kitchen"}},
            "error": {"median_relative": 0.02},
        }),
    };
    let mirrored = Provenance {
        plan: json!({
            "labels": ["<b>wall</b>"],
            "strategies": ["mirror images: 1 planar mirrors"],
            "error": {"median_relative": 0.1},
        }),
        ..provenance.clone()
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let (at, prefix) = picofarm_store::open_store(&store.display().to_string()).unwrap();
        let rooms = prefix.join("rooms");
        let dataset = Dataset::create_or_open(at, rooms, &SPEC).await.unwrap();
        for (scene, provenance) in [(0, &provenance), (2, &mirrored)] {
            dataset.publish(scene, &record, provenance).await.unwrap();
        }
    });
}
