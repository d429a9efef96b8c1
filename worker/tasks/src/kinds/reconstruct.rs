//! Reconstruction: computes a density field, a mesh and their errors from a scene of a data set.
//! The task adopts a reconstruction that exists, or measures, fits and publishes.
//!
//! A grid takes seconds and has no checkpoints: an interrupted task starts again and produces the
//! same bytes. Networks take minutes to days and resume from their newest checkpoint.

mod captured;
mod measured;
#[cfg(feature = "networks")]
mod mlp;
#[cfg(not(feature = "networks"))]
#[path = "reconstruct/without_networks.rs"]
mod mlp;
mod pictures;
mod written;

use std::collections::BTreeMap;

use bytes::Bytes;
use picofarm_dataset::Manifest;
use picofarm_proto::{
    key::TaskKey,
    spec::{
        SpecError, TaskSpec,
        kinds::{ReconstructTask, TaskKind, reconstruct::ReconstructSettings},
    },
};
use picofarm_reconstruct::{
    Measured, Phase, Progress, Reconstructed, Reconstruction, VERSION, World, score, surface,
};
use picofarm_results::{ReconstructionManifest, Reconstructions, SceneUsed, Verdict};
use picofarm_store::StorageError;
use picofarm_store::published::Manifest as _;
use serde_json::json;
use sha2::{Digest, Sha256};
use tracing::{info, warn};

use crate::{
    errors::{dataset_error, reconstruction_error},
    input::source_manifest,
    repair::remade,
    stores::{Stores, manifest_sha256, saying},
    submission::Submission,
    task::{Context, Control, Output, RunTask, Task, TaskError, proceed},
};

pub use pictures::{CELL, STEP, columns, first_row, shaded, views};
pub use written::{density, errors, facts};

/// Width and height of a novel view, in pixels.
const VIEW_SIDE: u32 = 128;
/// Name of the object with the figures of a reconstruction.
const METRICS: &str = "metrics.json";
/// Progress of the task after measuring and after fitting the field.
const MEASURED: f32 = 0.2;
const FITTED: f32 = 0.85;

impl RunTask for ReconstructTask {
    fn code_version() -> String {
        VERSION.to_owned()
    }

    fn resolve(&mut self, _: &Submission<'_>) -> Result<(), SpecError> {
        match (self.dispatch().variant, mlp::NOT_BUILT) {
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
            let metrics = stores.wait(control, folder.read(index, METRICS))?;
            tell(index, &metrics)?;
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
        if let Some(metrics) = files.get(METRICS) {
            tell(index, metrics)?;
        }
        control.at(1.0);
        Ok(output(&made, false))
    }
}

/// Logs the quality of a reconstruction, given its metrics.
fn tell(scene: u64, metrics: &[u8]) -> Result<(), TaskError> {
    let metrics = serde_json::from_slice(metrics)
        .map_err(|e| TaskError::Crash(format!("{METRICS} of scene {scene} is not JSON: {e}")))?;
    saying(
        &Verdict::of_reconstruction(&metrics),
        &format!("scene {scene}"),
    );
    Ok(())
}

fn output(manifest: &ReconstructionManifest, adopted: bool) -> Output {
    Output {
        manifest_sha256: manifest.sha256(),
        bytes: manifest.total_bytes(),
        adopted,
    }
}

/// Returns the reconstruction if this exact task has published it.
fn finished(
    stores: &Stores,
    folder: &Reconstructions,
    ours: &ReconstructionManifest,
    control: &Control,
) -> Result<Option<ReconstructionManifest>, TaskError> {
    let looked = async {
        match folder.finished(ours.scene, &ours.task_key).await {
            Err(error @ StorageError::Damaged { .. }) => {
                warn!(%error, "a reconstruction is damaged; it is made again and put back");
                Ok(None)
            }
            other => other,
        }
    };
    stores.wait(control, looked)
}

/// A task with the steps that it consists of.
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
                Reconstruction::begin(measured, grid, &watch).map_err(reconstruction_error)?;
            if !fitting.run(&watch).map_err(reconstruction_error)? {
                return Err(TaskError::Stopped);
            }
            fitting.finish()
        };
        for note in &made.notes {
            info!(note, "reconstruction");
        }
        Ok(made)
    }

    /// Returns the scene's files by name.
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
            let errors =
                errors(made, &mesh, &world, &cameras, seed).map_err(reconstruction_error)?;
            metrics.extend(errors);
            metrics.insert("scene".into(), json!(scene.name));
            metrics.insert("provenance".into(), json!(scene.provenance));
            let drawn = views(made, &world, &cameras);
            files.insert("views.png".into(), drawn.png().into());
        }
        let objects = density(made).map_err(dataset_error)?.into_iter();
        files.extend(objects.map(|(key, bytes)| (format!("density.zarr/{key}"), bytes)));
        files.insert("mesh.ply".into(), mesh.ply().into());
        let glb = mesh.glb(&made.measured).map_err(reconstruction_error)?;
        files.insert("mesh.glb".into(), glb.into());
        let text = serde_json::to_string_pretty(&metrics).expect("metrics are plain data");
        files.insert(METRICS.into(), (text + "\n").into());
        Ok(files)
    }
}

/// Forwards progress and stop requests between a task's control and a reconstruction.
struct Watch<'a>(&'a Control);

impl Progress for Watch<'_> {
    fn at(&self, phase: Phase, done: f32, loss: Option<f64>) -> bool {
        // Rough share of each phase in the total time.
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
