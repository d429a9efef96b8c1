//! Errors of libraries, classified by cause for the farm.

#[cfg(feature = "networks")]
use picofarm_model::ModelError;
use picofarm_reconstruct::ReconstructError;
use picofarm_scene::SceneError;
use picofarm_session::TaskError;
use picofarm_store::StorageError;
use picofarm_transient::RenderError;

/// Classifies a data set's error by cause.
pub(crate) fn dataset_error(error: StorageError) -> TaskError {
    let text = error.to_string();
    match error {
        // Wrong store settings are the fault of this worker's environment; another worker may have
        // the right ones.
        StorageError::Store { .. }
        | StorageError::StoreSettings { .. }
        | StorageError::Io { .. } => TaskError::Store(text),
        // Repeated reading has not helped. Running the task elsewhere may help, and repairing the
        // store does.
        StorageError::Damaged { .. } => TaskError::Damaged(text),
        StorageError::Codec { .. } => TaskError::Crash(text),
        _ => TaskError::User(text),
    }
}

/// Classifies a scene's error: a failing disk is not the job's fault, everything else is.
pub(crate) fn scene_error(error: SceneError) -> TaskError {
    use std::io::ErrorKind::{
        InvalidInput, IsADirectory, NotADirectory, NotFound, PermissionDenied,
    };
    match &error {
        SceneError::Read { source, .. } => match source.kind() {
            NotFound | NotADirectory | IsADirectory | PermissionDenied | InvalidInput => {
                TaskError::User(format!("{error}; every worker must see it under this path"))
            }
            _ => TaskError::Interrupted(error.to_string()),
        },
        _ => TaskError::User(error.to_string()),
    }
}

/// Classifies a training's error by cause.
#[cfg(feature = "networks")]
pub(crate) fn model_error(error: ModelError) -> TaskError {
    match error {
        ModelError::Scene { scene, source } => match source.downcast::<StorageError>() {
            Ok(error) => dataset_error(*error),
            Err(error) => TaskError::Crash(format!("scene {scene}: {error}")),
        },
        // Stored objects have checksums, so this program wrote a value that it cannot read.
        ModelError::Weights { what } | ModelError::File { what } => TaskError::Crash(what),
        ModelError::Group(what) => TaskError::Interrupted(what),
        ModelError::Engine(what) => TaskError::Crash(what),
        error @ ModelError::Gpu { .. } => TaskError::Crash(error.to_string()),
        other => TaskError::User(other.to_string()),
    }
}

/// Classifies an error of a model's predictions, and adds the names of model and scene. `scenes`
/// are those that the model ran on.
#[cfg(feature = "networks")]
pub(crate) fn prediction_error<'a>(
    model: &'a str,
    dataset: &'a str,
    scenes: &'a [u64],
) -> impl Fn(ModelError) -> TaskError + 'a {
    move |error| match error {
        ModelError::Answer { scene, what } => {
            let scene = scenes.get(scene.unwrap_or(0));
            let scene = scene.map_or_else(String::new, |scene| format!("scene {scene} of "));
            TaskError::User(format!("model {model:?}, {scene}{dataset}: {what}"))
        }
        other => model_error(other),
    }
}

pub(crate) fn render_error(error: RenderError) -> TaskError {
    match error {
        RenderError::Stopped => TaskError::Stopped,
        RenderError::Scene(error) => scene_error(error),
        RenderError::Invalid { .. } => TaskError::User(format!("render.{error}")),
        RenderError::Memory { .. } => TaskError::Crash(error.to_string()),
    }
}

pub(crate) fn reconstruction_error(error: ReconstructError) -> TaskError {
    match error {
        ReconstructError::Stopped => TaskError::Stopped,
        error @ ReconstructError::Inconsistent { .. } => TaskError::User(format!(
            "reconstruct: {error}; correct the source, or go on with grid = {{ accept_inconsistent = true }}"
        )),
        error => TaskError::User(format!("reconstruct: {error}")),
    }
}

#[cfg(feature = "networks")]
pub(crate) fn in_field(field: &str, error: TaskError) -> TaskError {
    match error {
        TaskError::User(text) => TaskError::User(format!("{field}: {text}")),
        other => other,
    }
}
