//! Where a task's networks are computed: on the CPU, or on the worker's graphics processor where the stage asks for one.

use picofarm_model::{
    Device, ModelError, cpu,
    device::{OpenGpu, guarded},
};

use super::Context;
use crate::execute::{Output, Task, TaskError};

impl Context {
    /// The graphics processor of a task that asks for one.
    pub(in crate::execute) fn gpu(&self, task: &Task) -> Option<&OpenGpu> {
        let asked = task.spec.resources.gpus as usize;
        self.gpus.get(asked.checked_sub(1)?)
    }

    /// Where a task's networks are computed.
    pub(in crate::execute) fn device(&self, task: &Task) -> Result<Device, TaskError> {
        match (task.spec.resources.gpus, self.gpu(task)) {
            (0, _) => Ok(cpu()),
            (_, Some(gpu)) => Ok(gpu.device.clone()),
            // It is placed on workers that have one.
            (_, None) => Err(TaskError::Interrupted(
                "this worker has no graphics processor (--gpus)".into(),
            )),
        }
    }
}

/// Runs a task that computes on a graphics processor, if it does; what its driver panics with is the task's error.
pub(in crate::execute) fn on_gpu(
    gpu: Option<&OpenGpu>,
    run: impl FnOnce() -> Result<Output, TaskError>,
) -> Result<Output, TaskError> {
    let Some(gpu) = gpu else {
        return run();
    };
    guarded(&gpu.to_string(), run).unwrap_or_else(|error| Err(TaskError::Crash(plain(error))))
}

/// Without the field, which the caller names.
pub(super) fn plain(error: ModelError) -> String {
    match error {
        ModelError::Invalid { what, .. } => what,
        other => other.to_string(),
    }
}
