//! Recipes: a data set stores how its scenes are made, so that `dataset repair` can make one again.
//! A recipe is the stage of the job, without its place and its number of scenes. Its key follows
//! from its content. Each scene from a file has a recipe of its own, under a key that counts no
//! file.

use picofarm_dataset::{Dataset, Recipe};
use picofarm_proto::{
    key::{StageKey, TaskKey, task_key},
    spec::{
        OutputSettings, RenderTask, ReprocessTask, SceneKind, StageSpec, TaskSpec, kinds::TaskKind,
    },
};
use serde_json::json;

use crate::{
    stores::Stores,
    task::{Control, Task, TaskError},
};

/// The data set that contains the recipe.
pub(crate) const HERE: &str = "here";

/// Stores the recipe of a rendering. That of a scene file is stored under what all scenes of the
/// list have in common, so that it has one name whichever other files a job lists. Where a recipe
/// of the file's earlier content has that name, because its scene was begun and never published,
/// this one is stored under the key of its stage.
pub(crate) fn note(
    stores: &Stores,
    dataset: &Dataset,
    task: &Task,
    control: &Control,
) -> Result<(), TaskError> {
    let only = task.spec.only(task.index, task.index + 1);
    let TaskSpec::Render(mut render) = only.task else {
        return Ok(());
    };
    let files = render.files_key();
    render.scenes.count = 1;
    render.parts = 1;
    render.output = here(&render.output.profile);
    let content = content(TaskSpec::Render(render));
    let note = |key: &StageKey, own| {
        stores.note_recipe(dataset, (&key.to_string(), own), &content, control)
    };
    let Some(files) = files else {
        return note(&task.stage, None).map(drop);
    };
    let own = Some(task.index);
    if note(&files, own)? {
        return Ok(());
    }
    let files = files.to_string();
    match stores.wait(control, dataset.recipe(&files, task.index))? {
        Some(there) if there.content != content => note(&task.stage, own).map(drop),
        _ => Ok(()),
    }
}

/// Stores the recipe of a reprocessing. A source in the same store is named without the store, so
/// that both can move together.
pub(crate) fn note_reprocess(
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
    stores
        .note_recipe(dataset, (&key.to_string(), None), &content, control)
        .map(drop)
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

/// The key that a scene of a data set has, if a rendering made it. Scenes of files were once named
/// by all files of their job, which only the key of the recipe's stage still tells.
pub(crate) fn made(
    stage: &StageKey,
    task: &RenderTask,
    scene: u64,
    made_by: &str,
) -> Option<TaskKey> {
    let own = task.scene_key(scene);
    let earlier = Some(task_key(stage, scene)).filter(|_| task.files_key().is_some());
    let keys = own.into_iter().chain(earlier);
    { keys }.find(|key| key.to_string() == made_by)
}

/// The task that a recipe describes, in the data set `dataset` of `store`, and its key.
pub(crate) fn read(
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
                // It may have been stored under the key of its stage, which counts files that it
                // does not name.
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
