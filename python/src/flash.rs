//! One flash: depth, shadows and mirrors from a multiplexed histogram, and a room in 3D.

use numpy::{
    IntoPyArray, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use picofarm_demultiplex::{Capture, Place, Settings, Shading, Spot};
use picofarm_reconstruct::{
    Phase, Progress, ReconstructError, Reconstruction, World, score, source, surface,
};
use picofarm_scene::{Camera, Intrinsics, Vec3};
use picofarm_settings::GridSettings;
use picofarm_tasks::reconstruct::{errors as errors_of, facts};
use picofarm_transient::Gate;
use pyo3::{
    prelude::*,
    types::{PyBytes, PyDict},
};

use crate::{
    errors::{self, argument},
    scene::Scene,
    work,
};

/// Width and height of the views that the errors of a room are measured in, pixels.
const VIEW_SIDE: u32 = 128;
/// Number of these views.
const VIEWS: usize = 24;

/// Camera and laser of a capture.
#[pyclass(frozen, module = "picofarm._native")]
pub(crate) struct Viewpoint {
    camera: Camera,
    laser: Vec3,
}

#[pymethods]
impl Viewpoint {
    /// A camera at the origin that looks along z, with x to the right and y downwards. `intrinsics`
    /// are fx, fy, cx, cy in pixels; `shape` is (height, width).
    #[new]
    fn new(intrinsics: [f32; 4], shape: (u32, u32), laser: [f32; 3]) -> PyResult<Self> {
        let [fx, fy, cx, cy] = intrinsics;
        let sound = [fx, fy].iter().all(|f| f.is_finite() && *f > 0.0);
        if !sound || !cx.is_finite() || !cy.is_finite() {
            let what = format!("expected fx, fy, cx, cy in pixels, found {intrinsics:?}");
            return Err(argument("intrinsics", what));
        }
        let laser = Vec3::from(laser);
        if !laser.is_finite() {
            return Err(argument("laser", "expected a position in metres"));
        }
        let (height, width) = shape;
        Ok(Self {
            camera: Camera {
                intrinsics: Intrinsics {
                    fx,
                    fy,
                    cx,
                    cy,
                    width,
                    height,
                },
                origin: Vec3::ZERO,
                right: Vec3::new(1.0, 0.0, 0.0),
                down: Vec3::new(0.0, 1.0, 0.0),
                forward: Vec3::new(0.0, 0.0, 1.0),
            },
            laser,
        })
    }

    /// Camera and laser of a scene.
    #[staticmethod]
    fn of_scene(scene: &Scene) -> Self {
        Self {
            camera: scene.scene.camera,
            laser: scene.scene.laser.origin,
        }
    }
}

/// A histogram with the beams that made spots.
struct Flash<'a> {
    view: &'a Viewpoint,
    histogram: &'a [f32],
    gate: Gate,
    /// Index of each spot's beam.
    beams: Vec<usize>,
    spots: Vec<Spot>,
    /// Rows, columns.
    shape: [usize; 2],
}

impl<'a> Flash<'a> {
    /// `spots` are rows of at least x, y, z, and the path from the laser in the last column; rows
    /// of NaN are beams without a spot. Rows of three columns are directions of beams whose spots
    /// are unknown.
    fn new(
        view: &'a Viewpoint,
        histogram: &'a PyReadonlyArray3<'_, f32>,
        gate: (f64, f64),
        spots: &PyReadonlyArray2<'_, f32>,
    ) -> PyResult<Self> {
        let shape = histogram.shape();
        let image = &view.camera.intrinsics;
        if shape[..2] != [image.height as usize, image.width as usize] {
            let what = format!(
                "has {}x{} pixels, but the camera's image has {}x{}",
                shape[0], shape[1], image.height, image.width
            );
            return Err(argument("histogram", what));
        }
        let contiguous = |name: &str| argument(name, "the array must be contiguous");
        let columns = spots.shape()[1];
        if columns < 3 {
            let what = format!("expected at least 3 columns, found {columns}");
            return Err(argument("spots", what));
        }
        let rows = spots.as_slice().map_err(|_| contiguous("spots"))?;
        let (mut beams, mut known) = (Vec::new(), Vec::new());
        for (k, row) in rows.chunks_exact(columns).enumerate() {
            let (point, path_m) = (Vec3::new(row[0], row[1], row[2]), row[columns - 1]);
            if point.is_finite() && path_m.is_finite() {
                beams.push(k);
                known.push(match columns {
                    3 => Spot {
                        direction: point,
                        place: None,
                    },
                    _ => Spot {
                        direction: point - view.laser,
                        place: Some(Place { point, path_m }),
                    },
                });
            }
        }
        let bins = u32::try_from(shape[2]);
        Ok(Self {
            view,
            histogram: histogram.as_slice().map_err(|_| contiguous("histogram"))?,
            gate: Gate {
                start_m: gate.0,
                bin_width_m: gate.1,
                bins: bins.map_err(|_| argument("histogram", "has too many bins"))?,
            },
            beams,
            spots: known,
            shape: [shape[0], shape[1]],
        })
    }

    fn capture(&self) -> Capture<'_> {
        Capture {
            histogram: self.histogram,
            gate: self.gate,
            camera: &self.view.camera,
            laser: self.view.laser,
            spots: &self.spots,
        }
    }
}

/// Finds depth, shadows and mirrors in a histogram `[row, column, bin]`. Returns a dict of arrays.
#[pyfunction]
pub(crate) fn demultiplex<'py>(
    py: Python<'py>,
    histogram: PyReadonlyArray3<'py, f32>,
    view: &Viewpoint,
    gate: (f64, f64),
    spots: PyReadonlyArray2<'py, f32>,
    shadows: &str,
    threads: Option<usize>,
) -> PyResult<Bound<'py, PyDict>> {
    let settings = Settings {
        shadows: match shadows {
            "physics" => Shading::Physics,
            "learned" => Shading::Learned,
            other => {
                let what = format!("expected \"physics\" or \"learned\", found {other:?}");
                return Err(argument("shadows", what));
            }
        },
        ..Settings::default()
    };
    let flash = Flash::new(view, &histogram, gate, &spots)?;
    let capture = flash.capture();
    let found = work::run(py, threads, None, |_| {
        picofarm_demultiplex::demultiplex(&capture, &settings)
    })?
    .map_err(errors::demultiplex)?;
    let image = flash.shape;
    let each = [flash.spots.len(), image[0], image[1]];
    let ground: Vec<u8> = found.ground.iter().map(|g| *g as u8).collect();
    let out = PyDict::new(py);
    let images = [
        ("depth", found.depth_m),
        ("confidence", found.confidence),
        ("albedo", found.albedo),
        ("mirror", found.mirror_probability),
    ];
    for (name, values) in images {
        out.set_item(name, values.into_pyarray(py).reshape(image)?)?;
    }
    out.set_item("beams", &flash.beams)?;
    out.set_item("lit", found.lit.into_pyarray(py).reshape(each)?)?;
    out.set_item("ground", ground.into_pyarray(py).reshape(each)?)?;
    Ok(out)
}

/// Reconstructs a room from a histogram `[row, column, bin]` of all spots. Returns a dict of
/// `vertices`, `triangles`, `glb` (a file), and `facts` (JSON), which include the errors against a
/// given scene.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "a function of another language")]
pub(crate) fn reconstruct<'py>(
    py: Python<'py>,
    histogram: PyReadonlyArray3<'py, f32>,
    view: &Viewpoint,
    scene: Option<&Scene>,
    gate: (f64, f64),
    spots: PyReadonlyArray2<'py, f32>,
    nodes: Option<u32>,
    seed: u64,
    threads: Option<usize>,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let default = GridSettings::default();
    let settings = GridSettings {
        nodes: nodes.unwrap_or(default.nodes),
        seed,
        ..default
    };
    settings
        .check()
        .map_err(|(field, what)| argument(field, what))?;
    let flash = Flash::new(view, &histogram, gate, &spots)?;
    let made = work::run(py, threads, progress.as_ref(), |watch| {
        room(&flash, scene, settings, &Phases(watch))
    })??;
    let (positions, triangles) = (made.mesh.positions, made.mesh.triangles);
    let (points, corners) = (positions.len(), triangles.len());
    let positions: Vec<f32> = positions.into_iter().flat_map(<[f32; 3]>::from).collect();
    let out = PyDict::new(py);
    let vertices = positions.into_pyarray(py).reshape([points, 3])?;
    out.set_item("vertices", vertices)?;
    let triangles = triangles.into_flattened().into_pyarray(py);
    out.set_item("triangles", triangles.reshape([corners, 3])?)?;
    out.set_item("glb", PyBytes::new(py, &made.glb))?;
    out.set_item("facts", made.facts)?;
    Ok(out)
}

/// A reconstructed room.
struct Room {
    mesh: picofarm_reconstruct::Surface,
    glb: Vec<u8>,
    /// JSON.
    facts: String,
}

fn room(
    flash: &Flash<'_>,
    truth: Option<&Scene>,
    settings: GridSettings,
    watch: &Phases<'_>,
) -> PyResult<Room> {
    let capture = flash.capture();
    let found = picofarm_demultiplex::demultiplex(&capture, &Settings::default());
    let found = found.map_err(errors::demultiplex)?;
    let measured = source::from_flash(&capture, &found, &flash.beams);
    let reconstruct = || -> Result<Room, ReconstructError> {
        let mut reconstruction = Reconstruction::begin(measured?, settings, watch)?;
        if !reconstruction.run(watch)? {
            return Err(ReconstructError::Stopped);
        }
        let made = reconstruction.finish();
        let mesh = surface(&made.field);
        let mut all = facts(&made, &mesh);
        if let Some(truth) = truth {
            let world = World::new(&truth.scene);
            let range = &made.depth.range;
            let views = score::around(&made.measured, range, &world, VIEWS, VIEW_SIDE);
            all.extend(errors_of(&made, &mesh, &world, &views, settings.seed)?);
        }
        let glb = mesh.glb(&made.measured)?;
        let facts = serde_json::Value::Object(all).to_string();
        Ok(Room { mesh, glb, facts })
    };
    reconstruct().map_err(errors::reconstruct)
}

/// Forwards the progress of a reconstruction. The optimisation takes most of the time.
struct Phases<'a>(&'a work::Watch);

impl Progress for Phases<'_> {
    fn at(&self, phase: Phase, done: f32, _: Option<f64>) -> bool {
        let (from, share) = match phase {
            Phase::Depth => (0.0, 0.02),
            Phase::Planes => (0.02, 0.03),
            Phase::Start => (0.05, 0.02),
            Phase::Carve => (0.07, 0.13),
            Phase::Rays => (0.2, 0.1),
            Phase::Optimise => (0.3, 0.7),
        };
        picofarm_transient::Progress::at(self.0, from + share * done)
    }
}
