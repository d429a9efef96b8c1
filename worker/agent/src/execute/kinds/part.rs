//! Parts of heavy scenes: rendered as tasks of their own, and joined by the scene's render task.
//! Parts are only a cache: the joining task renders those that are missing or damaged, and the
//! scene is the same to the bit.

use picofarm_dataset::{Dataset, PartName};
use picofarm_proto::{
    key::TaskKey,
    spec::{PartTask, RenderTask, SpecError},
    trace,
};
use picofarm_scene::Scene;
use picofarm_transient::{Part, PartOf, Progress, Rendered, Settings, join_parts, render_part};
use sha2::{Digest, Sha256};
use tracing::{debug_span, info, warn};

use crate::execute::{
    Context, Control, Output, RunTask, Submission, Task, TaskError,
    output::Stores,
    render::{Watched, of_render, prepare, renderer_version, scene_key},
};

impl RunTask for PartTask {
    fn code_version() -> String {
        renderer_version()
    }

    /// Renders the part with index `task.index`, unless it or its whole scene exists.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, with, spec) = (&context.stores, context.scenes(), self);
        let (scene, index) = spec.division().split(task.index);
        let key = scene_key(&spec.whole, scene)?;
        let dataset = stores.open(&spec.whole, control)?;
        let done = |bytes, adopted| {
            Ok(Output {
                // A part is deleted after its scene is published, so only its name is stable.
                manifest_sha256: hex::encode(Sha256::digest(task.key().0)),
                bytes,
                adopted,
            })
        };
        let parts = Parts::new(stores, &dataset, &spec.whole, scene, key);
        if !task.spec.force {
            if stores.finished(&dataset, scene, &key, control)?.is_some() {
                return done(0, true);
            }
            if let Some((_, bytes)) = parts.read(index, control)? {
                return done(bytes, true);
            }
        }
        let (made, settings) = prepare(with, &spec.whole, &dataset, scene, &key)?;
        let which = PartOf {
            index,
            of: spec.whole.parts,
        };
        let part = debug_span!(target: trace::TARGET, "render")
            .in_scope(|| render_part(&made, &settings, which, &Watched(control)))
            .map_err(of_render)?;
        info!(scene, part = index, rays = part.rays(), "part rendered");
        let bytes = parts.write(&part, control)?;
        control.at(1.0);
        done(bytes, false)
    }

    fn resolve(&mut self, here: &Submission<'_>) -> Result<(), SpecError> {
        self.whole.resolve(here)
    }
}

/// The stored parts of a scene.
pub(in crate::execute) struct Parts<'a> {
    stores: &'a Stores,
    dataset: &'a Dataset,
    scene: u64,
    task_key: TaskKey,
    of: u32,
}

impl<'a> Parts<'a> {
    /// Creates the parts that the render task `task_key` joins.
    pub(in crate::execute) fn new(
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
    fn read(&self, index: u32, control: &Control) -> Result<Option<(Part, u64)>, TaskError> {
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
    fn write(&self, part: &Part, control: &Control) -> Result<u64, TaskError> {
        let bytes = postcard::to_allocvec(part)
            .map_err(|e| TaskError::Crash(format!("a part of scene {}: {e}", self.scene)))?;
        let name = self.name(part.which().index);
        let put = async || self.dataset.put_part(&name, &bytes).await;
        self.stores.patiently(control, put)?;
        Ok(bytes.len() as u64)
    }

    /// Joins all parts. Renders those that are missing.
    pub(in crate::execute) fn join(
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
                    render_part(scene, settings, which, &share).map_err(of_render)?
                }
            };
            parts.push(part);
        }
        join_parts(scene, settings, parts, &Watched(control)).map_err(of_render)
    }

    /// Deletes the parts of a published scene. Parts that cannot be deleted now are removed by
    /// garbage collection.
    pub(in crate::execute) fn delete(&self, control: &Control) {
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
