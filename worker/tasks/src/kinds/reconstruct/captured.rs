//! Measurements from a separate histogram of each spot.

use picofarm_dataset::Dataset;
use picofarm_proto::spec::kinds::reconstruct::ReconstructSettings;
use picofarm_reconstruct::{
    Measured,
    source::{Captures, LIT_THRESHOLD},
};
use picofarm_scene::{Beam, Camera, Laser, Vec3};

use super::MEASURED;
use crate::{
    errors::reconstruction_error,
    stores::Stores,
    task::{Control, TaskError, proceed},
};

/// Maximum difference between the path length of a straight beam and the distance to its spot, in
/// metres. A greater difference means that a mirror folds the beam.
const FOLDED_M: f32 = 0.01;

/// Position of each spot and the length of its path from the laser; `None` if the beam hits
/// nothing.
pub(super) type Spots = [Option<(Vec3, f32)>];

pub(super) fn captures(
    stores: &Stores,
    dataset: &Dataset,
    scene: u64,
    (camera, origin, spots, beams): (Camera, Vec3, &Spots, &[u32]),
    settings: &ReconstructSettings,
    control: &Control,
) -> Result<Measured, TaskError> {
    if !dataset.spec().per_spot {
        return Err(TaskError::User(format!(
            "source: {} has no histogram of each spot alone, which from = \"captures\" reads; render it with per_spot = true",
            dataset.place()
        )));
    }
    // Directions of beams are not stored. A beam points at its spot unless a mirror folds it.
    let towards = |spot: &Option<(Vec3, f32)>| {
        let away = spot.map_or(camera.forward, |(point, _)| point - origin);
        Beam {
            direction: away.normalized(),
            spot: None,
        }
    };
    let laser = Laser {
        origin,
        beams: spots.iter().map(towards).collect(),
    };
    let mut all = Captures::new(camera, laser, dataset.spec().gate, LIT_THRESHOLD);
    if let Some(sensor) = &settings.sensor {
        let seed = settings.grid.seed;
        all = all.behind(sensor, seed).map_err(reconstruction_error)?;
    }
    for (done, beam) in beams.iter().enumerate() {
        control.say(format!("capture {} of {}", done + 1, beams.len()), &[]);
        proceed(control, MEASURED * done as f32 / beams.len() as f32)?;
        let spot = spots.get(*beam as usize).copied().flatten();
        if spot.is_some_and(|(point, path_m)| (path_m - (point - origin).length()).abs() > FOLDED_M)
        {
            let why = "a mirror folds the beam, whose direction the data set does not say";
            all.leave_out(*beam as usize, why);
            continue;
        }
        let histogram = stores.wait(control, dataset.read_spot(scene, *beam))?;
        all.add(*beam as usize, &histogram)
            .map_err(reconstruction_error)?;
    }
    Ok(all.finish())
}
