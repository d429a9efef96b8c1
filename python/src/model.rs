//! Trained networks on the program's own kernels.

use numpy::{
    IntoPyArray, PyArray3, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3,
    PyUntypedArrayMethods,
};
use picofarm_model::{
    ModelError, answers, cpu,
    input::{Target, merged},
    scene::Scene,
};
use picofarm_results::Models;
use pyo3::{
    exceptions::{PyOSError, PyRuntimeError},
    prelude::*,
};

use crate::{
    errors::{self, argument},
    work,
};

/// The object of a model that has its weights.
const WEIGHTS: &str = "weights.safetensors";

/// A trained network in memory.
#[pyclass(frozen, module = "picofarm._native")]
pub(crate) struct Model {
    model: picofarm_model::Model,
    manifest: String,
    /// Path at the start of the first bin and width of a bin, metres.
    gate: (f64, f64),
    bins: usize,
    /// Divisor of the image's sides.
    multiple: usize,
}

#[pymethods]
impl Model {
    #[new]
    fn new(py: Python<'_>, store: &str, name: &str) -> PyResult<Self> {
        picofarm_cli::provide_cryptography();
        py.detach(|| {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build()
                .map_err(|e| PyRuntimeError::new_err(format!("cannot start a thread: {e}")))?;
            let (manifest, weights) = runtime
                .block_on(async {
                    let (store, prefix) = picofarm_store::open_store(store)?;
                    let models = Models::new(store, &prefix);
                    let manifest = models.manifest(name).await?;
                    let weights = models.read(&manifest, WEIGHTS).await?;
                    Ok((manifest, weights))
                })
                .map_err(errors::store)?;
            let (gate, multiple) =
                picofarm_tasks::takes(&manifest).map_err(|what| argument("name", what))?;
            let model = picofarm_model::Model::read(&weights, &cpu());
            let model = model.map_err(|e| PyOSError::new_err(format!("{name}: {e}")))?;
            let manifest = serde_json::to_string(&manifest).map_err(|e| {
                PyRuntimeError::new_err(format!("a manifest cannot be written: {e}"))
            })?;
            Ok(Self {
                model,
                manifest,
                gate: (gate.start_m, gate.bin_width_m),
                bins: gate.bins as usize,
                multiple: multiple as usize,
            })
        })
    }

    /// The manifest as JSON.
    fn manifest(&self) -> &str {
        &self.manifest
    }

    /// Predicts `[plane, row, column]`: z-depth in metres, or probabilities of a mask for each
    /// spot. `spots` are rows of x, y, z and the path from the laser.
    fn predict<'py>(
        &self,
        py: Python<'py>,
        histogram: PyReadonlyArray3<'py, f32>,
        depth: Option<PyReadonlyArray2<'py, f32>>,
        spots: Option<PyReadonlyArray2<'py, f32>>,
        intrinsics: Option<[f64; 4]>,
        threads: Option<usize>,
    ) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let question = self.model.question();
        if question.sees_evidence() {
            let what = "the model reads evidence of physics; run it as a stage `infer` of a job";
            return Err(argument("transient", what));
        }
        let contiguous = |name: &str| argument(name, "the array must be contiguous");
        let &[height, width, bins] = histogram.shape() else {
            return Err(argument("transient", "expected [row, column, bin]"));
        };
        if bins != self.bins {
            let what = format!("has {bins} bins, the model was trained on {}", self.bins);
            return Err(argument("transient", what));
        }
        merged(bins, question.bins).map_err(|what| argument("transient", what))?;
        if height % self.multiple != 0 || width % self.multiple != 0 || height * width == 0 {
            let what = format!(
                "has {width}x{height} pixels, the model takes multiples of {}",
                self.multiple
            );
            return Err(argument("transient", what));
        }
        let values = histogram.as_slice().map_err(|_| contiguous("transient"))?;
        if let Some(i) = values.iter().position(|x| !x.is_finite()) {
            let (row, column, bin) = (i / bins / width, i / bins % width, i % bins);
            let what = format!("{} at row {row}, column {column}, bin {bin}", values[i]);
            return Err(argument(
                "transient",
                format!("expected finite numbers, found {what}"),
            ));
        }
        let pixels = height * width;
        let timed = question.timed();
        let mut scene = Scene {
            height,
            width,
            bins,
            first_m: self.gate.0,
            bin_width_m: self.gate.1,
            histogram: values.to_vec(),
            depth_m: vec![0.0; pixels],
            specular: vec![0; pixels],
            lit: vec![0; pixels * question.spots],
            intrinsics: [1.0; 4],
            ..Scene::default()
        };
        if timed {
            let why = "the model needs two-bounce times";
            let given = depth.as_ref().zip(spots.as_ref()).zip(intrinsics);
            let Some(((depth, spots), intrinsics)) = given else {
                return Err(argument(
                    "depth",
                    format!("{why}: give depth, spots and intrinsics"),
                ));
            };
            if depth.shape() != [height, width] {
                let what = format!(
                    "expected {height}x{width} values, found {:?}",
                    depth.shape()
                );
                return Err(argument("depth", what));
            }
            if spots.shape() != [question.spots, 4] {
                let what = format!(
                    "expected {} rows of x, y, z, path, found {:?}",
                    question.spots,
                    spots.shape()
                );
                return Err(argument("spots", what));
            }
            if !intrinsics.iter().all(|x| x.is_finite()) || intrinsics[..2].contains(&0.0) {
                let what = format!("expected fx, fy, cx, cy in pixels, found {intrinsics:?}");
                return Err(argument("intrinsics", what));
            }
            scene.depth_m = depth.as_slice().map_err(|_| contiguous("depth"))?.to_vec();
            let rows = spots.as_slice().map_err(|_| contiguous("spots"))?;
            scene.spots = rows.chunks(4).map(|r| [r[0], r[1], r[2]]).collect();
            scene.beams_m = rows.chunks(4).map(|r| r[3]).collect();
            scene.intrinsics = intrinsics;
        }
        let mut planes: Vec<f32> = Vec::new();
        work::run(py, threads, None, |_| {
            answers(&self.model, &scene, &mut |values, _| {
                planes.extend_from_slice(values);
            })
        })?
        .map_err(failed)?;
        let scale = question.depth_scale_m;
        for x in &mut planes {
            *x = match question.target {
                Target::Tof => x.clamp(0.0, 1.0) * scale,
                Target::Shadow | Target::Specular => 1.0 / (1.0 + (-*x).exp()),
            };
        }
        let count = planes.len() / pixels;
        planes.into_pyarray(py).reshape([count, height, width])
    }
}

/// Returns a `ValueError` for an input that does not fit or gives non-finite numbers, and a
/// `RuntimeError` otherwise.
fn failed(error: ModelError) -> PyErr {
    match &error {
        ModelError::Invalid { .. } | ModelError::Answer { .. } => argument("transient", error),
        _ => PyRuntimeError::new_err(error.to_string()),
    }
}
