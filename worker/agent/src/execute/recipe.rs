//! Recipes: a data set stores how its scenes are made, so that `dataset repair` can make one again.
//! A recipe is the stage of the job, without its location and its number of scenes. Its key is
//! derived from the recipe's content. If scenes are files, the recipe contains only its own scene's
//! file, but the key covers all files of the job.

use picofarm_dataset::{Dataset, Recipe};
use picofarm_proto::{
    key::StageKey,
    model::{OutputSettings, ReprocessTask, SceneKind, StageSpec, TaskSpec},
};
use serde_json::json;

use super::{Control, Task, TaskError, output::Stores};

/// Name that stands for the data set that contains the recipe.
const HERE: &str = "here";

/// Stores the recipe of a rendering.
pub(super) fn note(
    stores: &Stores,
    dataset: &Dataset,
    task: &Task,
    control: &Control,
) -> Result<(), TaskError> {
    let only = task.spec.only(task.index, task.index + 1);
    let TaskSpec::Render(mut render) = only.task else {
        return Ok(());
    };
    let own = match &render.scenes.kind {
        SceneKind::Files { .. } => Some(task.index),
        _ => None,
    };
    render.scenes.count = 1;
    render.parts = 1;
    render.output = here(&render.output.profile);
    let content = content(TaskSpec::Render(render));
    stores.note_recipe(dataset, &task.stage.to_string(), own, &content, control)
}

/// Stores the recipe of a reprocessing. A source in the same store is named without the store, so
/// that both can move together.
pub(super) fn note_reprocess(
    stores: &Stores,
    dataset: &Dataset,
    task: &ReprocessTask,
    control: &Control,
) -> Result<(), TaskError> {
    let key = task.reprocess.stage_key(&task.output.profile);
    let mut task = task.clone();
    if task.source.store == task.output.store {
        task.source.store = HERE.to_owned();
    }
    task.count = 1;
    task.output = here(&task.output.profile);
    let content = content(TaskSpec::Reprocess(task));
    stores.note_recipe(dataset, &key.to_string(), None, &content, control)
}

fn content(task: TaskSpec) -> serde_json::Value {
    json!({"stage": StageSpec::new(task)})
}

fn here(profile: &str) -> OutputSettings {
    OutputSettings {
        store: HERE.to_owned(),
        dataset: HERE.to_owned(),
        profile: profile.to_owned(),
    }
}

/// Returns the task that a recipe describes, in the data set `dataset` of `store`, and its key.
pub(super) fn read(
    recipe: &Recipe,
    store: &str,
    dataset: &str,
) -> Result<(StageKey, TaskSpec), TaskError> {
    let unusable = |what: String| TaskError::User(format!("{}: {what}", recipe.place));
    let key = StageKey::parse(&recipe.key)
        .ok_or_else(|| unusable("its name is no key of a stage".into()))?;
    let stage: StageSpec = serde_json::from_value(recipe.content["stage"].clone())
        .map_err(|e| unusable(format!("not a recipe: {e}")))?;
    let mut task = stage.task;
    let found = match &mut task {
        TaskSpec::Render(render) => {
            render.output.store = store.to_owned();
            render.output.dataset = dataset.to_owned();
            match render.scenes.kind {
                SceneKind::Files { .. } => key,
                _ => render.stage_key(),
            }
        }
        TaskSpec::Reprocess(task) => {
            task.output.store = store.to_owned();
            task.output.dataset = dataset.to_owned();
            if task.source.store == HERE {
                task.source.store = store.to_owned();
            }
            task.reprocess.stage_key(&task.output.profile)
        }
        other => return Err(unusable(format!("a {} makes no scenes", other.kind()))),
    };
    match found == key {
        true => Ok((key, task)),
        false => Err(unusable(format!(
            "what it says has the key {found}, not that of its name; it belongs to another program version"
        ))),
    }
}
