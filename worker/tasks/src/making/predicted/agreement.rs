//! Measures whether the predictions of a scene agree with each other and with its spots, without
//! ground truth.

use picofarm_dataset::{Dataset, Quantity};
use picofarm_reconstruct::{
    Agreement,
    source::{Given, Times, given},
};
use picofarm_results::Predicted;
use picofarm_scene::{Camera, Intrinsics, Vec3};
use serde_json::{Value, json};

use crate::{
    errors::reconstruction_error,
    input::camera::slant,
    stores::Stores,
    task::{Control, TaskError},
};

/// Version of the figures in a manifest.
pub const VERSION: &str = "agreement-2";

/// Compares depths with spots, and masks with both. Returns null if no depth is predicted. `lit_by`
/// are the spots of the masks.
pub(crate) fn measure(
    stores: &Stores,
    (dataset, scene): (&Dataset, u64),
    predicted: &Predicted,
    lit_by: &[u32],
    control: &Control,
) -> Result<Value, TaskError> {
    if predicted.depth_m.is_empty() {
        return Ok(Value::Null);
    }
    let spec = dataset.spec();
    let read = async {
        futures::try_join!(
            dataset.read_spots(scene),
            dataset.read_intrinsics(scene),
            dataset.read::<f32>(scene, Quantity::Laser),
        )
    };
    let (spots, i, laser) = stores.wait(control, read)?;
    // All positions are in the camera's frame.
    let camera = Camera {
        intrinsics: Intrinsics {
            fx: i.fx,
            fy: i.fy,
            cx: i.cx,
            cy: i.cy,
            width: spec.width,
            height: spec.height,
        },
        origin: Vec3::ZERO,
        right: Vec3::new(1.0, 0.0, 0.0),
        down: Vec3::new(0.0, 1.0, 0.0),
        forward: Vec3::new(0.0, 0.0, 1.0),
    };
    let spots: Vec<Option<(Vec3, f32)>> = spots
        .iter()
        .map(|spot| spot.map(|s| (Vec3::from(s.position), s.path_m)))
        .collect();
    let along = |(p, depth): (usize, &f32)| depth * slant(&camera, p);
    let range: Vec<f32> = predicted.depth_m.iter().enumerate().map(along).collect();
    let masks = !predicted.lit.is_empty();
    let beams: Vec<u32> = match masks {
        true => lit_by.to_vec(),
        false => (0..spec.spots).collect(),
    };
    // A probability of at least one half.
    let half = |p: &u8| u8::from(*p >= 128);
    let lit = match masks {
        true => predicted.lit.iter().map(half).collect(),
        false => vec![1; beams.len() * range.len()],
    };
    let mirror = match predicted.specular.is_empty() {
        true => vec![0; range.len()],
        false => predicted.specular.iter().map(half).collect(),
    };
    let measured = given(&Given {
        camera,
        laser: Vec3::from([laser[0], laser[1], laser[2]]),
        spots: &spots,
        beams: &beams,
        times: Times::Range(&range),
        lit: &lit,
        mirror: &mirror,
    });
    let measured = measured.map_err(reconstruction_error)?;
    Ok(json!(Agreement::of_depths(&measured, &range, masks)))
}
