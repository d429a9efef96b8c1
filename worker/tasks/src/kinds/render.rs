//! Rendering: adopts a scene that exists, or makes, renders, encodes and publishes it.

use picofarm_files::Opener;
use picofarm_proto::spec::{RenderSettings, RenderTask, SpecError, TaskKind};
use picofarm_scene::{FittedGate, Scene};
use picofarm_store::published::Manifest as _;
use picofarm_transient::Settings;

use crate::{
    errors::render_error,
    input::scenes,
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
        here.scenes(&mut self.scenes)?;
        if self.render.fit_gate {
            fit_gate(self)?;
        }
        Ok(())
    }
}

/// Fits the gate to the light of all files: from shortly before the first to well after the last.
fn fit_gate(task: &mut RenderTask) -> Result<(), SpecError> {
    let fail = |what: String| SpecError::new("render.gate", what);
    let mut range: Option<[f64; 2]> = None;
    for index in 0..task.scenes.count {
        let size = task.render.resolution;
        let scene = scenes::scene(&task.scenes, size, index, (&[], &Opener::anywhere()));
        let scene = scene.map_err(|e| fail(format!("\"auto\" cannot be fitted: {e}")))?;
        if let Some([first, last]) = scene.path_range_m() {
            let [lo, hi] = range.unwrap_or([first, last]);
            range = Some([lo.min(first), hi.max(last)]);
        }
    }
    let Some(range) = range else {
        let what = "\"auto\" cannot be fitted: no beam hits anything that a camera sees";
        return Err(fail(what.into()));
    };
    let fitted = FittedGate::new(range, task.render.gate());
    if fitted.gate.bin_width_m > RenderSettings::MAX_BIN_M {
        let [_, last] = range;
        return Err(fail(format!(
            "\"auto\" cannot be fitted: light takes up to {last:.0} m; set scenes.unit, for example to \"mm\""
        )));
    }
    if !fitted.usual_fits {
        task.render.gate_start_m = fitted.gate.start_m;
        task.render.bin_width_m = fitted.gate.bin_width_m;
    }
    task.render.fit_gate = false;
    Ok(())
}
