//! Makes the scenes of a data set again from its recipes, as the ground truth for results computed
//! from them.

use picofarm_proto::spec::{SourceSettings, TaskSpec};
use picofarm_scene::Scene;

use crate::{
    input::{scenes, source_manifest},
    repair::recipe,
    task::{Context, Control, TaskError},
};

/// Maximum depth of a chain of reprocessed data sets.
const DEEPEST: usize = 8;

/// Returns the scene that a data set's scene was rendered from. Follows the data sets that it was
/// reprocessed from.
///
/// # Errors
/// [`TaskError::User`] if no recipe leads to the scene; errors of making a scene.
pub(crate) fn scene(
    context: &Context,
    source: &SourceSettings,
    index: u64,
    control: &Control,
) -> Result<Scene, TaskError> {
    let stores = &context.stores;
    let mut place = source.clone();
    for _ in 0..DEEPEST {
        let dataset = stores.open_source(&place.store, &place.dataset, control)?;
        let manifest = source_manifest(stores, &dataset, index, control)?;
        let mut from = None;
        for key in stores.wait(control, dataset.recipe_keys())? {
            let Some(stored) = stores.wait(control, dataset.recipe(&key, index))? else {
                continue;
            };
            match recipe::read(&stored, &place.store, &place.dataset)? {
                (stage, TaskSpec::Render(task))
                    if recipe::made(&stage, &task, index, &manifest.provenance.task_key)
                        .is_some() =>
                {
                    let size = task.render.resolution;
                    return scenes::scene(&task.scenes, size, index, context.scenes());
                }
                (_, TaskSpec::Reprocess(task))
                    if manifest.provenance.plan["kind"] == "reprocess" =>
                {
                    from = Some(task.source);
                }
                _ => {}
            }
        }
        match from {
            Some(earlier) => place = earlier,
            None => {
                return Err(TaskError::User(format!(
                    "{} does not say how scene {index} is made, so that nothing can be compared with it; set views = 0",
                    dataset.place()
                )));
            }
        }
    }
    Err(TaskError::User(format!(
        "{}/{}: data sets are reprocessed from one another {DEEPEST} times over; set views = 0",
        source.store, source.dataset
    )))
}
