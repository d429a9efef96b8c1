//! Renders scenes into arrays.

use numpy::{IntoPyArray, PyArrayMethods};
use picofarm_proto::spec::RenderSettings;
use picofarm_scene::Spot;
use picofarm_transient::{Budget, Gate, GroundTruth, Rendered, Settings, Split};
use pyo3::{exceptions::PyMemoryError, prelude::*, types::PyDict};

use crate::{
    errors::{self, argument},
    scene::{Scene, intrinsics},
    work,
};

/// The gate that is kept if it records most of the scene's light.
const USUAL: Gate = Gate {
    start_m: 1.0,
    bin_width_m: 0.0384,
    bins: 637,
};

/// Renders a scene. `gate` is (start, bin width) in metres of optical path; without it, the usual
/// gate or one that fits the scene. Returns a dict of arrays and facts.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "the arguments of Scene.render")]
pub(crate) fn render<'py>(
    py: Python<'py>,
    scene: &Scene,
    samples: u32,
    error: Option<f64>,
    bins: u32,
    gate: Option<(f64, f64)>,
    seed: u64,
    max_bounces: Option<u32>,
    split: bool,
    threads: Option<usize>,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    if bins == 0 {
        return Err(argument("bins", "expected at least 1"));
    }
    let gate = py.detach(|| self::gate(&scene.scene, bins, gate));
    let asked = RenderSettings {
        gate_start_m: gate.start_m,
        bin_width_m: gate.bin_width_m,
        bins,
        budget: error.map_or(Budget::Samples(samples), Budget::Error),
        max_bounces: max_bounces.unwrap_or(0),
        ..RenderSettings::default()
    };
    // Checked as in a job, so that the ranges are defined in one place.
    asked.check().map_err(|e| {
        let field = e.field.trim_start_matches("render.");
        argument(field, e.what)
    })?;
    let settings = Settings {
        seed,
        split,
        ..picofarm_tasks::renderer_settings(&asked)
    };
    let size = picofarm_tasks::scene_size(&scene.scene);
    let cores = threads.unwrap_or_else(picofarm_tasks::cores);
    picofarm_tasks::check_memory(&settings, size, cores).map_err(PyMemoryError::new_err)?;
    let rendered = work::run(py, threads, progress.as_ref(), |watch| {
        picofarm_transient::render(&scene.scene, &settings, watch)
    })?;
    arrays(py, scene, rendered.map_err(errors::render)?)
}

fn gate(scene: &picofarm_scene::Scene, bins: u32, asked: Option<(f64, f64)>) -> Gate {
    if let Some((start_m, bin_width_m)) = asked {
        return Gate {
            start_m,
            bin_width_m,
            bins,
        };
    }
    let usual = Gate { bins, ..USUAL };
    match scene.fitted_gate(usual) {
        Some(fitted) if !fitted.usual_fits => fitted.gate,
        _ => usual,
    }
}

fn arrays<'py>(py: Python<'py>, scene: &Scene, r: Rendered) -> PyResult<Bound<'py, PyDict>> {
    let (h, w, bins) = (r.height as usize, r.width as usize, r.gate.bins as usize);
    let out = PyDict::new(py);
    let facts = serde_json::json!({
        "gate": r.gate,
        "error": r.error,
        "plan": r.plan,
        "overflow": r.overflow,
        "rays": r.rays,
        "warnings": r.warnings,
    });
    out.set_item("facts", facts.to_string())?;
    let cube = [h, w, bins];
    out.set_item("transient", r.transient.into_pyarray(py).reshape(cube)?)?;
    let GroundTruth {
        depth,
        range,
        normal,
        instance,
        label,
        specular,
        visibility,
        rgb,
    } = r.truth;
    out.set_item("depth", depth.into_pyarray(py).reshape([h, w])?)?;
    out.set_item("range", range.into_pyarray(py).reshape([h, w])?)?;
    out.set_item("normal", normal.into_pyarray(py).reshape([h, w, 3])?)?;
    out.set_item("instance", instance.into_pyarray(py).reshape([h, w])?)?;
    out.set_item("label", label.into_pyarray(py).reshape([h, w])?)?;
    out.set_item("specular", specular.into_pyarray(py).reshape([h, w])?)?;
    let beams = r.spots.len();
    out.set_item(
        "visibility",
        visibility.into_pyarray(py).reshape([beams, h, w])?,
    )?;
    out.set_item("rgb", rgb.into_pyarray(py).reshape([h, w, 3])?)?;
    let rows: Vec<f32> = r.spots.iter().flat_map(spot_row).collect();
    out.set_item("spots", rows.into_pyarray(py).reshape([beams, 7])?)?;
    let i = intrinsics(&scene.scene.camera.intrinsics);
    out.set_item("intrinsics", i.to_vec().into_pyarray(py))?;
    if let Some(Split {
        two,
        two_se,
        two_noise,
        multi,
        multi_se,
        multi_noise,
    }) = r.split
    {
        for (name, values) in [
            ("two", two),
            ("two_se", two_se),
            ("two_noise", two_noise),
            ("multi", multi),
            ("multi_se", multi_se),
            ("multi_noise", multi_noise),
        ] {
            out.set_item(name, values.into_pyarray(py).reshape(cube)?)?;
        }
    }
    Ok(out)
}

/// Returns x, y, z, nx, ny, nz and the path from the laser, world frame; NaN without a spot.
fn spot_row(spot: &Option<Spot>) -> [f32; 7] {
    spot.map_or([f32::NAN; 7], |s| {
        let ([x, y, z], [nx, ny, nz]) = (<[f32; 3]>::from(s.point), <[f32; 3]>::from(s.normal));
        [x, y, z, nx, ny, nz, s.path_m]
    })
}
