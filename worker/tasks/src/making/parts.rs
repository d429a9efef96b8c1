//! Stored parts of heavy scenes. They are only a cache: the joining task renders those that are
//! missing or damaged, and the scene is the same to the bit.

use picofarm_dataset::{Dataset, PartName};
use picofarm_proto::{key::TaskKey, spec::RenderTask};
use picofarm_scene::Scene;
use picofarm_transient::{Part, PartOf, Progress, Rendered, Settings, join_parts, render_part};
use tracing::warn;

use super::rendered::Watched;
use crate::{
    errors::render_error,
    stores::Stores,
    task::{Control, TaskError},
};

/// The stored parts of a scene.
pub(crate) struct Parts<'a> {
    stores: &'a Stores,
    dataset: &'a Dataset,
    scene: u64,
    task_key: TaskKey,
    of: u32,
}

impl<'a> Parts<'a> {
    /// Creates the parts that the render task `task_key` joins.
    pub(crate) fn new(
        stores: &'a Stores,
        dataset: &'a Dataset,
        spec: &RenderTask,
        scene: u64,
        task_key: TaskKey,
    ) -> Self {
        Self {
            stores,
            dataset,
            scene,
            task_key,
            of: spec.parts,
        }
    }

    fn name(&self, index: u32) -> PartName {
        PartName {
            scene: self.scene,
            task_key: self.task_key.to_string(),
            part: (index, self.of),
        }
    }

    /// Reads a part and its size in bytes; `None` if it is missing or incomplete.
    pub(crate) fn read(
        &self,
        index: u32,
        control: &Control,
    ) -> Result<Option<(Part, u64)>, TaskError> {
        let name = self.name(index);
        let Some(bytes) = self.stores.wait(control, self.dataset.part(&name))? else {
            return Ok(None);
        };
        let which = PartOf { index, of: self.of };
        match postcard::from_bytes::<Part>(&bytes) {
            Ok(part) if part.which() == which => return Ok(Some((part, bytes.len() as u64))),
            Ok(part) => {
                warn!(scene = self.scene, part = index, found = ?part.which(), "a part is another one; it is rendered again")
            }
            Err(error) => {
                warn!(scene = self.scene, part = index, %error, "a part is damaged; it is rendered again")
            }
        }
        Ok(None)
    }

    /// Stores a part and returns its size in bytes.
    pub(crate) fn write(&self, part: &Part, control: &Control) -> Result<u64, TaskError> {
        let bytes = postcard::to_allocvec(part)
            .map_err(|e| TaskError::Crash(format!("a part of scene {}: {e}", self.scene)))?;
        let name = self.name(part.which().index);
        let put = async || self.dataset.put_part(&name, &bytes).await;
        self.stores.patiently(control, put)?;
        Ok(bytes.len() as u64)
    }

    /// Joins all parts. Renders those that are missing.
    pub(crate) fn join(
        &self,
        scene: &Scene,
        settings: &Settings,
        control: &Control,
    ) -> Result<Rendered, TaskError> {
        let count = self.of + 1;
        let mut parts = Vec::with_capacity(count as usize);
        for which in PartOf::all(self.of) {
            let part = match self.read(which.index, control)? {
                Some((part, _)) => part,
                None => {
                    warn!(
                        scene = self.scene,
                        part = which.index,
                        "a part is missing; it is rendered here"
                    );
                    let share = Share(control, which.index as f32, count as f32);
                    render_part(scene, settings, which, &share).map_err(render_error)?
                }
            };
            parts.push(part);
        }
        join_parts(scene, settings, parts, &Watched(control)).map_err(render_error)
    }

    /// Deletes the parts of a published scene. Parts that cannot be deleted now are removed by
    /// garbage collection.
    pub(crate) fn delete(&self, control: &Control) {
        for which in PartOf::all(self.of) {
            let name = self.name(which.index);
            if let Err(error) = self.stores.wait(control, self.dataset.delete_part(&name)) {
                warn!(scene = self.scene, part = which.index, %error, "a part that was joined is left behind");
            }
        }
    }
}

/// Maps a part's progress into that of the task that renders all parts.
struct Share<'a>(&'a Control, f32, f32);

impl Progress for Share<'_> {
    fn at(&self, done: f32) -> bool {
        let Self(control, before, count) = self;
        Watched(control).at((before + done) / count)
    }
}
