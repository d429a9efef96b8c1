//! Rendering: adopts a scene that exists, or makes, renders, encodes and publishes it.

use picofarm_proto::spec::{RenderTask, SpecError, TaskKind};
use picofarm_scene::Scene;
use picofarm_store::published::Manifest as _;
use picofarm_transient::Settings;

use crate::{
    errors::render_error,
    making::{
        parts::Parts,
        rendered::{RENDER_SHARE, Watched, make_by, renderer_version, scene_key},
    },
    repair::recipe,
    stores::manifest_sha256,
    submission::Submission,
    task::{Context, Control, Output, RunTask, Task, TaskError},
};

impl RunTask for RenderTask {
    fn code_version() -> String {
        renderer_version()
    }

    /// Renders scene `task.index` of the job into its data set.
    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, with, spec) = (&context.stores, context.scenes(), self);
        let key = scene_key(spec, task.index)?;
        let dataset = stores.open(spec, control)?;
        if !task.spec.force
            && let Some(manifest) = stores.finished(&dataset, task.index, &key, control)?
        {
            return Ok(Output {
                manifest_sha256: manifest_sha256(&manifest),
                bytes: manifest.total_bytes(),
                adopted: true,
            });
        }
        let render = |scene: &Scene, settings: &Settings| {
            stores.check_render(settings, scene)?;
            // Not before the scene is there: a file that cannot be read leaves no recipe beside its
            // corrected form's.
            recipe::note(stores, &dataset, task, control)?;
            if spec.parts > 1 {
                let parts = Parts::new(stores, &dataset, spec, task.index, key);
                return parts.join(scene, settings, control);
            }
            picofarm_transient::render(scene, settings, &Watched(control)).map_err(render_error)
        };
        let encoded = make_by(&dataset, with, spec, task.index, &key, render)?;
        control.at((1.0 + RENDER_SHARE) / 2.0);
        let manifest = stores.publish(&dataset, encoded, control)?;
        if spec.parts > 1 {
            Parts::new(stores, &dataset, spec, task.index, key).delete(control);
        }
        control.at(1.0);
        Ok(Output {
            manifest_sha256: manifest_sha256(&manifest),
            bytes: manifest.total_bytes(),
            adopted: false,
        })
    }

    fn resolve(&mut self, here: &Submission<'_>) -> Result<(), SpecError> {
        self.check()?;
        here.profile(&self.output.profile)?;
        here.scenes(&mut self.scenes)
    }
}
