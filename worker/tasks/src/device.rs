//! Chooses the device for a task's networks: the CPU, or the worker's GPU if the stage requests
//! one.

use picofarm_model::{
    Device, ModelError, cpu,
    device::{OpenGpu, guarded},
};

use crate::task::{Context, Output, Task, TaskError};

impl Context {
    /// Returns the GPU for a task that requests one.
    pub(crate) fn gpu(&self, task: &Task) -> Option<&OpenGpu> {
        let asked = task.spec.resources.gpus as usize;
        self.gpus.get(asked.checked_sub(1)?)
    }

    /// Returns the device on which a task's networks are computed.
    pub(crate) fn device(&self, task: &Task) -> Result<Device, TaskError> {
        match (task.spec.resources.gpus, self.gpu(task)) {
            (0, _) => Ok(cpu()),
            (_, Some(gpu)) => Ok(gpu.device.clone()),
            // The coordinator assigns such tasks only to workers with a GPU.
            (_, None) => Err(TaskError::Interrupted(
                "this worker has no graphics processor (--gpus)".into(),
            )),
        }
    }
}

/// Runs a task, on a GPU if it uses one. A panic of the GPU's driver becomes the task's error.
pub(crate) fn on_gpu(
    gpu: Option<&OpenGpu>,
    run: impl FnOnce() -> Result<Output, TaskError>,
) -> Result<Output, TaskError> {
    let Some(gpu) = gpu else {
        return run();
    };
    guarded(&gpu.to_string(), run).unwrap_or_else(|error| Err(TaskError::Crash(plain(error))))
}

/// Returns the error's message without its field, which the caller adds.
pub(crate) fn plain(error: ModelError) -> String {
    match error {
        ModelError::Invalid { what, .. } => what,
        other => other.to_string(),
    }
}
