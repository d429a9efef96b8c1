//! Reprocessing: passes a scene of a finished data set through a sensor into another data set. The
//! task adopts a scene that exists, or reads the histogram, simulates the sensor, and publishes the
//! result with the source's ground truth. Nothing is rendered.
//!
//! A scene that the source lacks is the task's own failure. If another stage makes the source, this
//! stage waits for it, so the missing scene was abandoned. If nothing makes the source, waiting
//! would never end.

use picofarm_proto::spec::{ReprocessTask, SourceSettings, SpecError, TaskKind};
use picofarm_store::published::Manifest as _;
use tokio::runtime::Handle;

pub use crate::making::reprocessed::{sensor_version, target_spec};
use crate::{
    making::reprocessed::{Reprocessing, open_source},
    repair::recipe,
    stores::{STORE_PATIENCE, Stores, manifest_sha256},
    submission::Submission,
    task::{Context, Control, Output, RunTask, Task, TaskError},
};

/// Reprocesses scenes.
pub struct Reprocessor {
    stores: Stores,
}

impl Reprocessor {
    /// Creates a reprocessor. `runtime` serves store requests and must not own the thread that
    /// calls [`Self::run`].
    pub fn new(runtime: Handle) -> Self {
        Self {
            stores: Stores::new(runtime, STORE_PATIENCE),
        }
    }

    /// Returns the scenes that the source has published, in ascending order, and its capacity,
    /// which is the number of tasks.
    ///
    /// # Errors
    /// [`TaskError::User`] if there is no such data set.
    pub fn source(
        &self,
        source: &SourceSettings,
        control: &Control,
    ) -> Result<(Vec<u64>, u64), TaskError> {
        let source = open_source(&self.stores, source, control)?;
        let present = self.stores.wait(control, source.scenes_present())?;
        Ok((present, source.spec().scenes))
    }

    /// Reprocesses scene `index`. Blocks, and computes on rayon's current pool.
    ///
    /// # Errors
    /// [`TaskError`], classified by cause.
    pub fn run(
        &self,
        task: &ReprocessTask,
        index: u64,
        control: &Control,
    ) -> Result<Output, TaskError> {
        run(&self.stores, task, false, index, control)
    }
}

impl RunTask for ReprocessTask {
    fn code_version() -> String {
        sensor_version()
    }

    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        run(&context.stores, self, task.spec.force, task.index, control)
    }

    fn resolve(&mut self, here: &Submission<'_>) -> Result<(), SpecError> {
        self.reprocess.normalise();
        here.profile(&self.output.profile)
    }
}

/// Reprocesses scene `index`; with `force`, even if it exists.
fn run(
    stores: &Stores,
    task: &ReprocessTask,
    force: bool,
    index: u64,
    control: &Control,
) -> Result<Output, TaskError> {
    task.check().map_err(|e| TaskError::User(e.to_string()))?;
    let target = &task.output;
    let made = Reprocessing::open(stores, task, index, control)?;
    let dataset = stores.create_or_open(&target.store, &target.dataset, &made.spec, control)?;
    if !force && let Some(manifest) = stores.finished(&dataset, index, &made.key, control)? {
        return Ok(Output {
            manifest_sha256: manifest_sha256(&manifest),
            bytes: manifest.total_bytes(),
            adopted: true,
        });
    }
    recipe::note_reprocess(stores, &dataset, task, control)?;
    let encoded = made.encode(stores, &dataset, &task.reprocess, index, control)?;
    let manifest = stores.publish(&dataset, encoded, control)?;
    control.at(1.0);
    Ok(Output {
        manifest_sha256: manifest_sha256(&manifest),
        bytes: manifest.total_bytes(),
        adopted: false,
    })
}
