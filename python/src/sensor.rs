//! The sensor: histograms in, photon counts out.

use numpy::{IntoPyArray, PyArrayMethods, PyReadonlyArray3, PyUntypedArrayMethods};
use picofarm_sensor::{Frame, Histograms, PS_PER_M, Sensor, Values, sense_image};
use pyo3::{prelude::*, types::PyDict};
use serde_json::json;

use crate::{errors::argument, work};

/// Measures a histogram `[row, column, bin]`. `sensor` is the JSON of a job's sensor. Returns a
/// dict of `counts` (`[row, column, bin]` of pixels or zones, uint32, or float32 without noise)
/// and `facts` (JSON).
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "a function of another language")]
pub(crate) fn sense<'py>(
    py: Python<'py>,
    histogram: PyReadonlyArray3<'py, f32>,
    two: Option<PyReadonlyArray3<'py, f32>>,
    start_m: f64,
    bin_width_m: f64,
    sensor: &str,
    seed: u64,
    scene: u64,
    threads: Option<usize>,
) -> PyResult<Bound<'py, PyDict>> {
    let sensor: Sensor = serde_json::from_str(sensor).map_err(|e| argument("sensor", e))?;
    sensor.check().map_err(|e| argument("sensor", e))?;
    let shape = histogram.shape().to_vec();
    let contiguous = |name: &str| argument(name, "the array must be contiguous");
    let transient = histogram.as_slice().map_err(|_| contiguous("histogram"))?;
    let two_bounce = match &two {
        Some(two) => Some(two.as_slice().map_err(|_| contiguous("two"))?),
        None => None,
    };
    let input = Histograms {
        transient,
        two_bounce,
        bins: shape[2],
        bin_width_ps: bin_width_m * PS_PER_M,
    };
    let frame = Frame {
        width: shape[1],
        start_ps: start_m * PS_PER_M,
    };
    let sensed = work::run(py, threads, None, |_| {
        sense_image(&sensor, &input, &frame, seed, scene)
    })?
    .map_err(|e| argument("sensor", e))?;
    let facts = json!({
        "sensor": sensor,
        "bins": sensed.bins,
        "start_m": sensor.gate.map_or(start_m, |gate| gate.start_ps / PS_PER_M),
        "bin_width_m": sensor.gate.map_or(bin_width_m, |gate| gate.bin_width_ps / PS_PER_M)
            * f64::from(sensor.rebin),
        "scale": sensed.scale,
        "peak_photons": sensed.peak_photons,
        "shift_bins": sensed.shift_bins,
        "dropped": sensed.dropped,
    });
    let shape = match sensor.zones {
        Some(zones) => [zones.rows as usize, zones.columns as usize, sensed.bins],
        None => [shape[0], shape[1], sensed.bins],
    };
    let out = PyDict::new(py);
    match sensed.values {
        Values::Counts(counts) => {
            out.set_item("counts", counts.into_pyarray(py).reshape(shape)?)?;
        }
        Values::Rate(rate) => out.set_item("counts", rate.into_pyarray(py).reshape(shape)?)?,
    }
    out.set_item("facts", facts.to_string())?;
    Ok(out)
}
