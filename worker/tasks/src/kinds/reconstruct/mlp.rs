//! PlatoNeRF's networks as a task: fitted for minutes to days, with checkpoints.

use std::time::{Duration, Instant};

use picofarm_platonerf::{MlpSettings, Settings as Networks, Training, grid};
use picofarm_proto::spec::kinds::{ReconstructTask, TaskKind};
use picofarm_reconstruct::{Measured, Reconstructed, Reconstruction, Settings};
use picofarm_results::{Checkpoints, Pieces, ReconstructionManifest, Reconstructions};
use tracing::{info, warn};

use crate::{
    errors::reconstruction_error,
    saver::Saver,
    stores::Stores,
    task::{Control, TaskError},
};

/// This build can fit the networks.
pub const NOT_BUILT: Option<&str> = None;

/// Interval between checkpoints of at most 24 MB.
const EVERY: Duration = Duration::from_secs(120);

/// Fits the networks, from the newest checkpoint if there is one.
pub fn fit(
    measured: Measured,
    (settings, asked): (&Settings, &MlpSettings),
    (stores, checkpoints): (&Stores, Checkpoints),
    watch: &super::Watch<'_>,
) -> Result<Reconstructed, TaskError> {
    let start = Reconstruction::begin(measured.clone(), grid(*settings), watch);
    let start = start.map_err(reconstruction_error)?.finish();
    let networks = Networks::of(asked, &start, settings.seed);
    let newest = stores.wait(watch.0, checkpoints.newest())?;
    let resumed = newest.and_then(|(step, content)| {
        match Training::resume(measured.clone(), networks, &content.concat()) {
            Ok(training) => {
                info!("goes on from the checkpoint after {step} steps");
                Some(training)
            }
            Err(error) => {
                warn!(%error, "the checkpoint after {step} steps cannot be used; begins again");
                None
            }
        }
    });
    let mut training = match resumed {
        Some(training) => training,
        None => Training::begin(measured, networks).map_err(reconstruction_error)?,
    };
    let mut saver = Saver::new(stores, checkpoints);
    let mut saved = Instant::now();
    let finished = training.run_with(watch, &mut |training| {
        if saved.elapsed() >= EVERY {
            saver.save(training.step(), whole(training));
            saved = Instant::now();
        }
    });
    if !finished.map_err(reconstruction_error)? {
        saver.save(training.step(), whole(&training));
        saver.last();
        return Err(TaskError::Stopped);
    }
    saver.last();
    Ok(training.finish(start))
}

/// Returns a checkpoint in one piece, because it is small.
fn whole(training: &Training) -> Pieces {
    Box::new(std::iter::once(training.checkpoint().into()))
}

/// Deletes the checkpoints of a task that has published its reconstruction.
pub fn forget(
    task: &ReconstructTask,
    folder: &Reconstructions,
    manifest: &ReconstructionManifest,
    (stores, control): (&Stores, &Control),
) -> Result<(), TaskError> {
    if !task.dispatch().resumes {
        return Ok(());
    }
    stores.wait(control, folder.checkpoints_of(&manifest.task_key).delete())
}
