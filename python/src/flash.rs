//! One flash taken apart: depth, shadows and mirrors from a multiplexed histogram.

use numpy::{
    IntoPyArray, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3, PyUntypedArrayMethods,
};
use picofarm_demultiplex::{Capture, Place, Settings, Shading, Spot};
use picofarm_scene::Vec3;
use picofarm_transient::Gate;
use pyo3::{prelude::*, types::PyDict};

use crate::{
    errors::{self, argument},
    scene::Scene,
    work,
};

/// Takes a histogram `[row, column, bin]` apart. `spots` are rows of at least x, y, z, and the path
/// from the laser in the last column; rows of NaN are beams without a spot. Returns a dict of
/// arrays.
#[pyfunction]
pub(crate) fn demultiplex<'py>(
    py: Python<'py>,
    histogram: PyReadonlyArray3<'py, f32>,
    scene: &Scene,
    gate: (f64, f64),
    spots: PyReadonlyArray2<'py, f32>,
    shadows: &str,
    threads: Option<usize>,
) -> PyResult<Bound<'py, PyDict>> {
    let shading = match shadows {
        "physics" => Shading::Physics,
        "learned" => Shading::Learned,
        other => {
            let what = format!("expected \"physics\" or \"learned\", found {other:?}");
            return Err(argument("shadows", what));
        }
    };
    let shape = histogram.shape().to_vec();
    let image = &scene.scene.camera.intrinsics;
    if shape[..2] != [image.height as usize, image.width as usize] {
        let what = format!(
            "has {}x{} pixels, but the scene's image has {}x{}",
            shape[0], shape[1], image.height, image.width
        );
        return Err(argument("histogram", what));
    }
    let contiguous = |name: &str| argument(name, "the array must be contiguous");
    let values = histogram.as_slice().map_err(|_| contiguous("histogram"))?;
    let columns = spots.shape()[1];
    if columns < 4 {
        let what = format!("expected at least 4 columns (x, y, z, path), found {columns}");
        return Err(argument("spots", what));
    }
    let rows = spots.as_slice().map_err(|_| contiguous("spots"))?;
    let laser = scene.scene.laser.origin;
    let (mut beams, mut known) = (Vec::new(), Vec::new());
    for (k, row) in rows.chunks_exact(columns).enumerate() {
        let (point, path_m) = (Vec3::new(row[0], row[1], row[2]), row[columns - 1]);
        if point.is_finite() && path_m.is_finite() {
            beams.push(k);
            known.push(Spot {
                direction: point - laser,
                place: Some(Place { point, path_m }),
            });
        }
    }
    let bins = u32::try_from(shape[2]).map_err(|_| argument("histogram", "has too many bins"))?;
    let capture = Capture {
        histogram: values,
        gate: Gate {
            start_m: gate.0,
            bin_width_m: gate.1,
            bins,
        },
        camera: &scene.scene.camera,
        laser,
        spots: &known,
    };
    let settings = Settings {
        shadows: shading,
        ..Settings::default()
    };
    let found = work::run(py, threads, None, |_| {
        picofarm_demultiplex::demultiplex(&capture, &settings)
    })?
    .map_err(errors::demultiplex)?;
    let (h, w) = (shape[0], shape[1]);
    let out = PyDict::new(py);
    out.set_item("beams", beams)?;
    out.set_item("depth", found.depth_m.into_pyarray(py).reshape([h, w])?)?;
    out.set_item(
        "confidence",
        found.confidence.into_pyarray(py).reshape([h, w])?,
    )?;
    out.set_item("albedo", found.albedo.into_pyarray(py).reshape([h, w])?)?;
    out.set_item(
        "mirror",
        found.mirror_probability.into_pyarray(py).reshape([h, w])?,
    )?;
    out.set_item(
        "lit",
        found.lit.into_pyarray(py).reshape([known.len(), h, w])?,
    )?;
    let ground: Vec<u8> = found.ground.iter().map(|g| *g as u8).collect();
    out.set_item(
        "ground",
        ground.into_pyarray(py).reshape([known.len(), h, w])?,
    )?;
    Ok(out)
}
