//! Parts of heavy scenes: rendered as tasks of their own, and joined by the scene's render task.
//! Parts are only a cache: the joining task renders those that are missing or damaged, and the
//! scene is the same to the bit.

use picofarm_proto::{
    spec::{PartTask, SpecError},
    trace,
};
use picofarm_transient::{PartOf, render_part};
use sha2::{Digest, Sha256};
use tracing::{debug_span, info};

use crate::{
    errors::render_error,
    making::parts::Parts,
    making::rendered::{Watched, prepare, renderer_version, scene_key},
    submission::Submission,
    task::{Context, Control, Output, RunTask, Task, TaskError},
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
            .map_err(render_error)?;
        info!(scene, part = index, rays = part.rays(), "part rendered");
        let bytes = parts.write(&part, control)?;
        control.at(1.0);
        done(bytes, false)
    }

    fn resolve(&mut self, here: &Submission<'_>) -> Result<(), SpecError> {
        self.whole.resolve(here)
    }
}
