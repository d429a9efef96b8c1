//! A room in which a mirror folds a beam. The two-bounce times derived from its data set agree with
//! the rendered light.

use std::sync::Arc;

use picofarm_dataset::{Dataset, DatasetSpec, Gate, Profile, Provenance, Subsets, Wavelength};
use picofarm_model::scene::{Scene as Seen, Scenes};
use picofarm_proto::{key::TaskKey, spec::Histogram};
use picofarm_scene::{
    Affine, Beam, Camera, Intrinsics, Laser, Material, Mesh, Object, Scene, Vec3,
};
use picofarm_store::open_store;
use picofarm_transient::{Budget, Progress, Settings};
use serde_json::json;
use tokio::runtime::Runtime;

use super::Examples;
use crate::{
    making::rendered::{in_camera, record},
    stores::Stores,
};

const SIDE: u32 = 16;
const BIN_M: f64 = 0.02;

struct Quiet;

impl Progress for Quiet {
    fn at(&self, _done: f32) -> bool {
        true
    }
}

fn v(x: f32, y: f32, z: f32) -> Vec3 {
    Vec3::new(x, y, z)
}

fn quad(name: &str, [corner, a, b]: [Vec3; 3], material: Material) -> Object {
    Object {
        mesh: Arc::new(Mesh {
            name: name.into(),
            triangle_material: vec![0; 2],
            positions: vec![corner, corner + a, corner + a + b, corner + b],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            materials: vec![material],
            uv: vec![],
        }),
        to_world: Affine::IDENTITY,
        label: 0,
        name: name.into(),
    }
}

fn grey() -> Material {
    Material {
        name: "grey".into(),
        bsdf: picofarm_scene::Bsdf::Diffuse { reflectance: 0.5 },
        rgb: [0.5; 3],
        texture: None,
        two_sided: true,
        spectrum: vec![],
    }
}

/// Returns a room with a floor, a back wall and a mirror on the right. The beam goes to the mirror
/// and from there to the wall. The camera sees a patch of the floor.
fn room() -> Scene {
    let floor = [v(-2.0, -1.5, 0.0), v(4.0, 0.0, 0.0), v(0.0, 0.0, -4.0)];
    let wall = [v(-2.0, -1.5, -4.0), v(4.0, 0.0, 0.0), v(0.0, 3.0, 0.0)];
    let mirror = [v(1.2, -1.0, -1.0), v(0.0, 2.0, 0.0), v(0.0, 0.0, -2.0)];
    let intrinsics = Intrinsics::from_fov(4.0, SIDE, SIDE);
    Scene {
        name: "folded".into(),
        objects: vec![
            quad("floor", floor, grey()),
            quad("wall", wall, grey()),
            quad("mirror", mirror, Material::mirror("mirror", 0.01)),
        ],
        labels: vec!["thing".into()],
        camera: Camera::look_at(Vec3::ZERO, v(-0.5, -1.5, -2.5), intrinsics),
        laser: Laser {
            origin: Vec3::ZERO,
            beams: vec![Beam {
                direction: v(0.6, 0.05, -1.0).normalized(),
                spot: None,
            }],
        },
        provenance: Default::default(),
    }
}

/// Reads the rendered room from a data set twice, as a stage with `left_mib` MiB of spare memory
/// does.
fn seen_twice(left_mib: Option<u64>) -> [Arc<Seen>; 2] {
    let (folder, runtime) = (tempfile::tempdir().unwrap(), Runtime::new().unwrap());
    let gate = Gate {
        start_m: 4.0,
        bin_width_m: BIN_M,
        bins: 400,
    };
    let spec = DatasetSpec {
        scenes: 1,
        height: SIDE,
        width: SIDE,
        spots: 1,
        subsets: Subsets::NONE,
        per_spot: false,
        wavelengths_nm: Wavelength::NONE,
        two_bounce: false,
        gate,
        profile: Profile::LOSSLESS,
    };
    let scene = room();
    let settings = Settings {
        max_bounces: Some(2),
        seed: 1,
        ..Settings::new(gate, Budget::Samples(64))
    };
    let rendered = picofarm_transient::render(&scene, &settings, &Quiet).unwrap();
    let spots = rendered.spots.iter();
    let spots: Vec<_> = spots
        .map(|spot| spot.as_ref().map(|s| in_camera(s, &scene.camera)))
        .collect();
    let provenance = Provenance {
        task_key: TaskKey([1; 32]).to_string(),
        renderer: "test".into(),
        seed: 1,
        plan: json!({}),
    };
    let (store, prefix) = open_store(folder.path().to_str().unwrap()).unwrap();
    let dataset = runtime.block_on(async {
        let opened = Dataset::create_or_open(store, prefix.join("folded"), &spec);
        let dataset = opened.await.unwrap();
        let record = record(&scene, &rendered, &[], &spots);
        dataset.publish(0, &record, &provenance).await.unwrap();
        dataset
    });
    let stores = Stores::new(runtime.handle().clone(), std::time::Duration::ZERO);
    let shown = (Histogram::Transient, &[][..]);
    let Ok(examples) = Examples::new(&stores, &dataset, shown, vec![0], "test") else {
        panic!("the data set has that histogram")
    };
    let examples = examples.staying(left_mib);
    [(); 2].map(|()| examples.load(0).unwrap())
}

#[test]
fn scenes_stay_in_a_share_of_the_memory_that_is_left_beside_their_task() {
    // The scene has 400 kB, and each of the four spare buffers as much again.
    for (left_mib, stays) in [
        (None, false),
        (Some(0), false),
        (Some(10), false),
        (Some(20), true),
    ] {
        let [first, second] = seen_twice(left_mib);
        assert_eq!(Arc::ptr_eq(&first, &second), stays, "{left_mib:?} MiB");
    }
}

#[test]
fn two_bounce_times_from_any_depth_begin_with_the_folded_beams_length() {
    let [scene, _] = seen_twice(None);
    let [x, y, z] = scene.spots[0];
    let straight = (x * x + y * y + z * z).sqrt();
    assert!(
        scene.beams_m[0] > straight + 20.0 * BIN_M as f32,
        "the beam is folded: {} m, straight {straight} m",
        scene.beams_m[0]
    );
    // A network with the right depth in every pixel.
    let predicted = picofarm_model::scene::Scene {
        seen_depth_m: Some(scene.depth_m.clone()),
        depth_m: vec![f32::NAN; scene.depth_m.len()],
        ..scene.as_ref().clone()
    };
    let (mut pixels, bins) = (0, scene.bins);
    let image = scene.pixels();
    for (p, tof) in predicted.tof(0).into_iter().enumerate() {
        let h: Vec<f32> = (0..bins).map(|b| scene.histogram[b * image + p]).collect();
        let Some(onset) = h.iter().position(|h| *h > 0.0) else {
            continue;
        };
        let last = bins - 1 - h.iter().rev().position(|h| *h > 0.0).unwrap();
        let bin = ((f64::from(tof) - scene.first_m) / scene.bin_width_m).floor() as usize;
        // A pixel sees a patch; the bin of its centre is within that of the patch.
        assert!(
            (onset..=last).contains(&bin) && last - onset <= 4,
            "pixel {p}: computed bin {bin}, rendered {onset} to {last}"
        );
        pixels += 1;
    }
    assert_eq!(pixels, (SIDE * SIDE) as usize, "the whole patch is lit");
    assert_eq!(scene.tof(0), predicted.tof(0));
}
