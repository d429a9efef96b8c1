//! Measurements from a separate histogram of each spot, and conversion between the frames of a data
//! set.

use picofarm_dataset::Dataset;
use picofarm_proto::spec::kinds::reconstruct::ReconstructSettings;
use picofarm_reconstruct::{
    Measured,
    source::{Captures, LIT_THRESHOLD},
};
use picofarm_scene::{Beam, Camera, Intrinsics, Laser, Vec3};

use super::{MEASURED, of_reconstruction, proceed};
use crate::execute::{Control, TaskError, output::Stores};

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
        all = all.behind(sensor, seed).map_err(of_reconstruction)?;
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
            .map_err(of_reconstruction)?;
    }
    Ok(all.finish())
}

/// A row-major camera-to-world matrix.
pub(in crate::execute) struct Frame<'a>(pub &'a [f32]);

impl Frame<'_> {
    fn axis(&self, column: usize) -> Vec3 {
        Vec3::new(self.0[column], self.0[4 + column], self.0[8 + column])
    }

    pub fn point(&self, p: [f32; 3]) -> Vec3 {
        self.axis(3) + self.axis(0) * p[0] + self.axis(1) * p[1] + self.axis(2) * p[2]
    }

    pub fn camera(&self, intrinsics: Intrinsics) -> Camera {
        Camera {
            intrinsics,
            origin: self.axis(3),
            right: self.axis(0),
            down: self.axis(1),
            forward: self.axis(2),
        }
    }
}

/// Returns the distance along a pixel's ray per metre of z-depth.
pub fn slant(camera: &Camera, pixel: usize) -> f32 {
    let i = &camera.intrinsics;
    let (u, v) = (
        (pixel % i.width as usize) as f32 + 0.5,
        (pixel / i.width as usize) as f32 + 0.5,
    );
    let (x, y) = ((u - i.cx) / i.fx, (v - i.cy) / i.fy);
    (x * x + y * y + 1.0).sqrt()
}
