//! Two-bounce times and masks of a scene, from ground truth or from predictions.

use picofarm_dataset::{Dataset, Manifest, Quantity};
use picofarm_proto::spec::kinds::reconstruct::{Measurements, Mirrors};
use picofarm_reconstruct::{
    Measured,
    source::{Certainty, Given, Times, given, weigh},
};
use picofarm_results::{Predictions, SceneUsed};
use picofarm_scene::{Intrinsics, Vec3};
use picofarm_store::StorageError;
use picofarm_store::published::Manifest as _;
use serde_json::json;

use super::{Work, captured::captures};
use crate::{
    errors::reconstruction_error,
    input::camera::{Frame, slant},
    stores::{Stores, manifest_sha256},
    task::{Control, TaskError},
};

impl Work<'_> {
    /// Opens the predictions of the job, and returns them with the hash of their manifest.
    pub(super) fn predictions(
        &self,
        stores: &Stores,
        found: &Manifest,
        control: &Control,
    ) -> Result<Option<(Predictions, SceneUsed)>, TaskError> {
        let index = found.scene;
        let folder = &self.0.reconstruct.predictions;
        if folder.is_empty() {
            return Ok(None);
        }
        let at = |e: TaskError| match e {
            TaskError::User(what) => TaskError::User(format!("reconstruct.predictions: {what}")),
            other => other,
        };
        let (store, prefix) = stores.source(&self.0.source.store, control)?;
        let opened = Predictions::open(store, prefix.join(&**folder));
        let predictions = stores.wait(control, opened).map_err(at)?;
        let spec = predictions.spec();
        if !spec.depth || spec.spots.is_empty() {
            return Err(TaskError::User(format!(
                "reconstruct.predictions: {} holds {}; depth and masks are needed: name a demultiplex stage, or give its \
                 infer stage a \"tof\" and a \"shadow\" model",
                predictions.place(),
                match (spec.depth, spec.spots.is_empty()) {
                    (true, _) => "no masks of spots",
                    (_, false) => "no depth",
                    _ => "neither depth nor masks",
                }
            )));
        }
        let manifest = stores
            .wait(control, predictions.manifest(index))
            .map_err(at)?;
        if manifest.source.manifest_sha256 != manifest_sha256(found) {
            return Err(TaskError::User(format!(
                "reconstruct.predictions: {} holds predictions of scene {index} of {:?}, which is not the scene of \
                 this stage's source, {:?}; name the data set that the predictions were made of",
                predictions.place(),
                manifest.source.dataset,
                self.0.source.dataset,
            )));
        }
        let used = SceneUsed {
            dataset: folder.clone(),
            task_key: manifest.task_key.clone(),
            manifest_sha256: manifest.sha256(),
        };
        Ok(Some((predictions, used)))
    }

    /// Returns times and masks of the scene, in the scene's coordinates.
    pub(super) fn measured(
        &self,
        stores: &Stores,
        dataset: &Dataset,
        found: &Manifest,
        predictions: Option<&Predictions>,
        control: &Control,
    ) -> Result<Measured, TaskError> {
        let (scene, from) = (found.scene, self.0.reconstruct.from);
        let needed: &[&str] = match from {
            Measurements::Truth => &["depth", "visibility", "spots.path"],
            Measurements::Given => &["visibility", "spots.path"],
            Measurements::Predictions | Measurements::Captures => &["spots.path"],
        };
        let missing = found.missing();
        if let Some(missing) = missing.iter().find(|m| needed.contains(&m.as_str())) {
            return Err(TaskError::User(format!(
                "source: scene {scene} of {} was imported without {missing:?}, which from = {:?} needs; import it with it, \
                 or choose other measurements",
                dataset.place(),
                json!(from).as_str().unwrap_or_default(),
            )));
        }
        let spec = dataset.spec();
        if from == Measurements::Given && !spec.two_bounce {
            return Err(TaskError::User(format!(
                "source: {} has no two-bounce paths, which from = \"given\" reads; import files that have them, or choose other \
                 measurements",
                dataset.place()
            )));
        }
        control.say("reads the scene".into(), &[]);
        let read = async {
            futures::try_join!(
                dataset.read_spots(scene),
                dataset.read_intrinsics(scene),
                dataset.read::<f32>(scene, Quantity::Camera),
                dataset.read::<f32>(scene, Quantity::Laser),
            )
        };
        let (spots, intrinsics, pose, laser) = stores.wait(control, read)?;
        let frame = Frame(&pose);
        let camera = frame.camera(Intrinsics {
            fx: intrinsics.fx,
            fy: intrinsics.fy,
            cx: intrinsics.cx,
            cy: intrinsics.cy,
            width: spec.width,
            height: spec.height,
        });
        let laser = frame.point([laser[0], laser[1], laser[2]]);
        let spots: Vec<Option<(Vec3, f32)>> = spots
            .iter()
            .map(|spot| spot.map(|s| (frame.point(s.position), s.path_m)))
            .collect();
        let beams = self.beams(spec.spots, predictions)?;
        if from == Measurements::Captures {
            return captures(
                stores,
                dataset,
                scene,
                (camera, laser, &spots, &beams),
                &self.0.reconstruct,
                control,
            );
        }
        let mut images = match predictions {
            None => stores.wait(control, images_of(dataset, scene))?,
            Some(predictions) => predicted(stores, dataset, predictions, scene, control)?,
        };
        if self.0.reconstruct.mirrors == Mirrors::Keep {
            images.mirror.fill(0);
        }
        let pixels = spec.pixels();
        let lit: Vec<u8> = of_beams(&images.lit, &beams, pixels);
        let mut range: Vec<f32> = Vec::new();
        let paths: Vec<f32>;
        let times = if from == Measurements::Given {
            let all = dataset.read::<f32>(scene, Quantity::TwoBouncePath);
            paths = of_beams(&stores.wait(control, all)?, &beams, pixels);
            Times::Paths {
                metres: &paths,
                bin_width_m: spec.gate.bin_width_m as f32,
            }
        } else {
            let along = |(p, depth): (usize, &f32)| depth * slant(&camera, p);
            range = images.depth_m.iter().enumerate().map(along).collect();
            Times::Range(&range)
        };
        let mut measured = given(&Given {
            camera,
            laser,
            spots: &spots,
            beams: &beams,
            times,
            lit: &lit,
            mirror: &images.mirror,
        })
        .map_err(reconstruction_error)?;
        if let Some(sure) = &images.sure {
            let probability: Vec<f32> = of_beams(&sure.lit, &beams, pixels);
            let certainty = Certainty {
                lit: &probability,
                confidence: &sure.confidence,
                range: &range,
            };
            weigh(&mut measured, &beams, &certainty).map_err(reconstruction_error)?;
        }
        Ok(measured)
    }

    /// Returns the beams to use.
    fn beams(&self, spots: u32, predictions: Option<&Predictions>) -> Result<Vec<u32>, TaskError> {
        let there: Vec<u32> = match predictions {
            Some(predictions) => predictions.spec().spots.clone(),
            None => (0..spots).collect(),
        };
        let wanted = &self.0.reconstruct.spots;
        if let Some(none) = wanted.iter().find(|s| !there.contains(s)) {
            return Err(TaskError::User(format!(
                "reconstruct.spots: there is nothing of spot {none}; there is of {}",
                there
                    .iter()
                    .map(u32::to_string)
                    .collect::<Vec<_>>()
                    .join(", ")
            )));
        }
        Ok(match wanted.is_empty() {
            true => there,
            false => wanted.clone(),
        })
    }
}

/// Per-pixel images of a scene.
struct Images {
    depth_m: Vec<f32>,
    /// `[spot][row][column]` of every spot.
    lit: Vec<u8>,
    mirror: Vec<u8>,
    /// How sure predictions are, where they say so.
    sure: Option<Sure>,
}

/// The confidence of predictions.
struct Sure {
    /// Probability of light: `[spot][row][column]` of every spot.
    lit: Vec<f32>,
    /// Confidence of the depth: `[row][column]`.
    confidence: Vec<f32>,
}

/// Reads the images of a data set. Quantities that an import lacks are zero.
async fn images_of(dataset: &Dataset, scene: u64) -> Result<Images, StorageError> {
    let (depth_m, lit, mirror) = futures::try_join!(
        dataset.read::<f32>(scene, Quantity::Depth),
        dataset.read_visibility(scene),
        dataset.read::<u8>(scene, Quantity::Specular),
    )?;
    Ok(Images {
        depth_m,
        lit,
        mirror,
        sure: None,
    })
}

/// Returns the images that are predicted. If no mirrors are predicted, there are none: the
/// true mirror mask is not used as a substitute.
fn predicted(
    stores: &Stores,
    dataset: &Dataset,
    predictions: &Predictions,
    scene: u64,
    control: &Control,
) -> Result<Images, TaskError> {
    let (spec, pixels) = (dataset.spec(), dataset.spec().pixels());
    let found = stores.wait(control, predictions.read(scene))?;
    if found.depth_m.len() != pixels {
        return Err(TaskError::User(format!(
            "reconstruct.predictions: {} has images of another size than {}",
            predictions.place(),
            dataset.place()
        )));
    }
    // A probability of at least one half.
    let likely = |p: &u8| u8::from(*p >= 128);
    let mirror = match found.specular.is_empty() {
        true => vec![0; pixels],
        false => found.specular.iter().map(likely).collect(),
    };
    let mut probability = vec![0; spec.spots as usize * pixels];
    let masks = found.lit.chunks_exact(pixels);
    for (number, mask) in predictions.spec().spots.iter().zip(masks) {
        probability[*number as usize * pixels..][..pixels].copy_from_slice(mask);
    }
    let shares = |all: &[u8]| all.iter().map(|p| f32::from(*p) / 255.0).collect();
    let sure = predictions.spec().confidence.then(|| Sure {
        lit: shares(&probability),
        confidence: shares(&found.confidence),
    });
    Ok(Images {
        depth_m: found.depth_m,
        lit: probability.iter().map(likely).collect(),
        mirror,
        sure,
    })
}

/// Selects the images of the given beams.
fn of_beams<T: Copy>(all: &[T], beams: &[u32], pixels: usize) -> Vec<T> {
    let of = beams.iter().map(|b| &all[*b as usize * pixels..][..pixels]);
    of.collect::<Vec<_>>().concat()
}
