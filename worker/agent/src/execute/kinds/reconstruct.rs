//! Reconstruction: a scene of a data set as a density field, a mesh and their errors. Adopt, or measure, fit and publish.
//!
//! A grid takes seconds, so it keeps no checkpoint: a task that is stopped begins again, and comes to the same bytes. Networks
//! take minutes to days: they go on from their newest checkpoint.

mod captured;
#[cfg(feature = "networks")]
mod mlp;
#[cfg(not(feature = "networks"))]
#[path = "reconstruct/without_networks.rs"]
mod mlp;
mod pictures;
mod written;

use std::collections::BTreeMap;

use bytes::Bytes;
use picofarm_dataset::{
    Dataset, DatasetError, Manifest, Predictions, Quantity, ReconstructionManifest,
    Reconstructions, SceneUsed,
};
use picofarm_proto::{
    key::TaskKey,
    model::{
        SpecError, TaskSpec,
        kinds::{
            ReconstructTask, TaskKind,
            reconstruct::{Measurements, ReconstructSettings},
        },
    },
};
use picofarm_reconstruct::{
    Measured, Phase, Progress, ReconstructError, Reconstructed, Reconstruction, VERSION, World,
    score,
    source::{Given, given},
    surface,
};
use picofarm_scene::{Intrinsics, Vec3};
use serde_json::json;
use sha2::{Digest, Sha256};
use tracing::{info, warn};

use crate::execute::{
    Context, Control, Output, RunTask, Submission, Task, TaskError,
    output::{Stores, manifest_sha256, of_dataset},
    remade,
    reprocess::source_manifest,
};

pub use captured::slant;
use captured::{Frame, captures};
pub use pictures::{CELL, STEP, columns, first_row, shaded, views};
pub use written::{density, errors, facts};

/// Pixels a side of a novel view.
const VIEW_SIDE: u32 = 128;
/// Progress once everything is measured, and once the field is fitted.
const MEASURED: f32 = 0.2;
const FITTED: f32 = 0.85;

impl RunTask for ReconstructTask {
    fn code_version() -> String {
        VERSION.to_owned()
    }

    fn resolve(&mut self, _: &Submission<'_>) -> Result<(), SpecError> {
        match (self.variant(), mlp::NOT_BUILT) {
            (Some(_), Some(what)) => Err(SpecError::new("reconstruct.field", what)),
            _ => Ok(()),
        }
    }

    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, place, index) = (&context.stores, &self.source, task.index);
        let dataset = stores.open_source(&place.store, &place.dataset, control)?;
        stores.fits(TaskSpec::Reconstruct(self.clone()), Some(dataset.spec()))?;
        let found = source_manifest(stores, &dataset, index, control)?;
        let work = Work(self);
        let predictions = work.predictions(stores, &found, control)?;
        let manifest = work.manifest(index, &found, predictions.as_ref().map(|(_, used)| used));
        let (store, prefix) = stores.probed(&self.output.store, control)?;
        let folder = Reconstructions::create_or_open(store, prefix.join(&*self.output.dataset));
        let folder = stores.wait(control, folder)?;
        if !task.spec.force
            && let Some(there) = finished(stores, &folder, &manifest, control)?
        {
            mlp::forget(self, &folder, &manifest, (stores, control))?;
            return Ok(output(&there, true));
        }
        let predictions = predictions.map(|(predictions, _)| predictions);
        let measured = work.measured(stores, &dataset, &found, predictions.as_ref(), control)?;
        let made = work.fit(stores, (&folder, &manifest), measured, control)?;
        let files = work.files(context, index, &made, control)?;
        let made = stores.patiently(control, async || {
            folder.restore(manifest.clone(), files.clone()).await
        })?;
        mlp::forget(self, &folder, &manifest, (stores, control))?;
        control.at(1.0);
        Ok(output(&made, false))
    }
}

fn output(manifest: &ReconstructionManifest, adopted: bool) -> Output {
    Output {
        manifest_sha256: manifest.sha256(),
        bytes: manifest.total_bytes(),
        adopted,
    }
}

/// What is there if this very task has published it.
fn finished(
    stores: &Stores,
    folder: &Reconstructions,
    ours: &ReconstructionManifest,
    control: &Control,
) -> Result<Option<ReconstructionManifest>, TaskError> {
    let looked = async {
        match folder.finished(ours.scene, &ours.task_key).await {
            Err(error @ DatasetError::Damaged { .. }) => {
                warn!(%error, "a reconstruction is damaged; it is made again and put back");
                Ok(None)
            }
            other => other,
        }
    };
    stores.wait(control, looked)
}

/// A task, and what belongs to it.
struct Work<'a>(&'a ReconstructTask);

impl Work<'_> {
    fn manifest(
        &self,
        scene: u64,
        found: &Manifest,
        predictions: Option<&SceneUsed>,
    ) -> ReconstructionManifest {
        let source = SceneUsed {
            dataset: self.0.source.dataset.clone(),
            task_key: found.provenance.task_key.clone(),
            manifest_sha256: manifest_sha256(found),
        };
        let settings = ReconstructSettings {
            version: String::new(),
            ..self.0.reconstruct.clone()
        };
        let settings = json!(settings);
        let named = json!([
            VERSION,
            source.manifest_sha256,
            predictions.map(|p| &p.manifest_sha256),
            settings
        ]);
        let key = TaskKey(Sha256::digest(named.to_string()).into());
        ReconstructionManifest {
            scene,
            task_key: key.to_string(),
            code: VERSION.to_owned(),
            source,
            predictions: predictions.cloned(),
            settings,
            ..ReconstructionManifest::default()
        }
    }

    /// The predictions that are read, and which they are.
    fn predictions(
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
        let (store, prefix) = stores.source(&self.0.source.store)?;
        let opened = Predictions::open(store, prefix.join(&**folder));
        let predictions = stores.wait(control, opened).map_err(at)?;
        let spec = predictions.spec();
        if !spec.depth || spec.spots.is_empty() {
            return Err(TaskError::User(format!(
                "reconstruct.predictions: {} holds {}; depth and masks are needed: give its infer stage a \"tof\" and a \
                 \"shadow\" model",
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
                "reconstruct.predictions: {} holds what networks predict of scene {index} of {:?}, which is not the scene of \
                 this stage's source, {:?}; name the data set that the infer stage has read",
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

    /// Times and masks of the scene, in the axes of the scene.
    fn measured(
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
            Measurements::Predictions => &["spots.path"],
            Measurements::Captures => &["spots.path"],
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
        control.say("reads the scene".into(), &[]);
        let spec = dataset.spec();
        let read = async {
            futures::try_join!(
                dataset.read_spots(scene),
                dataset.read_intrinsics(scene),
                dataset.read::<f32>(scene, Quantity::Camera),
                dataset.read::<f32>(scene, Quantity::Laser),
                dataset.read::<f32>(scene, Quantity::Depth),
                dataset.read::<u8>(scene, Quantity::Specular),
            )
        };
        let (spots, intrinsics, pose, laser, mut depth, mut mirror) = stores.wait(control, read)?;
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
                control,
            );
        }
        let pixels = spec.pixels();
        let all: Vec<u8> = match predictions {
            None => stores.wait(control, dataset.read_visibility(scene))?,
            Some(predictions) => {
                let predicted = stores.wait(control, predictions.read(scene))?;
                if predicted.depth_m.len() != pixels {
                    return Err(TaskError::User(format!(
                        "reconstruct.predictions: {} has images of another size than {}",
                        predictions.place(),
                        dataset.place()
                    )));
                }
                depth = predicted.depth_m;
                // Where no network looks for mirrors, the truth is not asked instead.
                mirror = match predicted.specular.is_empty() {
                    true => vec![0; pixels],
                    false => predicted
                        .specular
                        .iter()
                        .map(|p| u8::from(*p >= 128))
                        .collect(),
                };
                let mut all = vec![0; spots.len() * pixels];
                for (number, mask) in predictions
                    .spec()
                    .spots
                    .iter()
                    .zip(predicted.lit.chunks_exact(pixels))
                {
                    let to = &mut all[*number as usize * pixels..][..pixels];
                    for (to, p) in to.iter_mut().zip(mask) {
                        *to = u8::from(*p >= 128);
                    }
                }
                all
            }
        };
        let lit: Vec<u8> = beams
            .iter()
            .flat_map(|b| &all[*b as usize * pixels..][..pixels])
            .copied()
            .collect();
        let range: Vec<f32> = (0..pixels).map(|p| depth[p] * slant(&camera, p)).collect();
        given(&Given {
            camera,
            laser,
            spots: &spots,
            beams: &beams,
            range_m: &range,
            lit: &lit,
            mirror: &mirror,
        })
        .map_err(of_reconstruction)
    }

    /// The beams that are used.
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

    /// Fits the field.
    fn fit(
        &self,
        stores: &Stores,
        (folder, manifest): (&Reconstructions, &ReconstructionManifest),
        measured: Measured,
        control: &Control,
    ) -> Result<Reconstructed, TaskError> {
        let (grid, watch) = (self.0.reconstruct.grid, Watch(control));
        let made = if let Some(networks) = &self.0.reconstruct.mlp {
            let checkpoints = folder.checkpoints_of(&manifest.task_key);
            mlp::fit(measured, (&grid, networks), (stores, checkpoints), &watch)?
        } else {
            let mut fitting =
                Reconstruction::begin(measured, grid, &watch).map_err(of_reconstruction)?;
            if !fitting.run(&watch).map_err(of_reconstruction)? {
                return Err(TaskError::Stopped);
            }
            fitting.finish()
        };
        for note in &made.notes {
            info!(note, "reconstruction");
        }
        Ok(made)
    }

    /// The scene's files by their names.
    fn files(
        &self,
        context: &Context,
        index: u64,
        made: &Reconstructed,
        control: &Control,
    ) -> Result<BTreeMap<String, Bytes>, TaskError> {
        let seed = self.0.reconstruct.grid.seed;
        let mesh = surface(&made.field);
        proceed(control, FITTED)?;
        let mut metrics = facts(made, &mesh);
        let mut files: BTreeMap<String, Bytes> = BTreeMap::new();
        if self.0.reconstruct.views > 0 {
            control.say("compares with the scene".into(), &[]);
            let scene =
                remade::scene(context, &self.0.source, index, control).map_err(|e| match e {
                    TaskError::User(what) => TaskError::User(format!("reconstruct.views: {what}")),
                    other => other,
                })?;
            let world = World::new(&scene);
            let cameras = score::around(
                &made.measured,
                &made.depth.range,
                &world,
                self.0.reconstruct.views as usize,
                VIEW_SIDE,
            );
            proceed(control, 0.9)?;
            let errors = errors(made, &mesh, &world, &cameras, seed).map_err(of_reconstruction)?;
            metrics.extend(errors);
            metrics.insert("scene".into(), json!(scene.name));
            metrics.insert("provenance".into(), json!(scene.provenance));
            let drawn = views(made, &world, &cameras);
            files.insert("views.png".into(), drawn.png().into());
        }
        let objects = density(made).map_err(of_dataset)?.into_iter();
        files.extend(objects.map(|(key, bytes)| (format!("density.zarr/{key}"), bytes)));
        files.insert("mesh.ply".into(), mesh.ply().into());
        let glb = mesh.glb(&made.measured).map_err(of_reconstruction)?;
        files.insert("mesh.glb".into(), glb.into());
        let text = serde_json::to_string_pretty(&metrics).expect("metrics are plain data");
        files.insert("metrics.json".into(), (text + "\n").into());
        Ok(files)
    }
}

/// Between a task's control and a reconstruction.
struct Watch<'a>(&'a Control);

impl Progress for Watch<'_> {
    fn at(&self, phase: Phase, done: f32, loss: Option<f64>) -> bool {
        // How long each takes of the whole, roughly.
        let (start, share) = match phase {
            Phase::Depth => (0.0, 0.1),
            Phase::Planes => (0.1, 0.05),
            Phase::Start => (0.15, 0.1),
            Phase::Carve => (0.25, 0.15),
            Phase::Rays => (0.4, 0.05),
            Phase::Optimise => (0.45, 0.55),
        };
        let figures: Vec<(&str, f64)> = loss.map(|loss| ("loss", loss)).into_iter().collect();
        self.0.say(phase.name().to_owned(), &figures);
        self.0
            .at(MEASURED + (FITTED - MEASURED) * (start + share * done))
    }
}

fn proceed(control: &Control, fraction: f32) -> Result<(), TaskError> {
    match control.at(fraction) {
        true => Ok(()),
        false => Err(TaskError::Stopped),
    }
}

fn of_reconstruction(error: ReconstructError) -> TaskError {
    match error {
        ReconstructError::Stopped => TaskError::Stopped,
        error => TaskError::User(format!("reconstruct: {error}")),
    }
}
