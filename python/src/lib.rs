//! The extension module `picofarm._native`: the parts of the Python package that are written in
//! Rust. The package `picofarm` (folder `picofarm`) wraps them in classes with documentation.

mod data;
mod errors;
mod flash;
#[cfg(feature = "networks")]
mod model;
mod render;
mod scene;
mod sensor;
mod work;

use std::ffi::OsString;

use pyo3::prelude::*;

/// Runs the command line `picofarm ARGUMENTS…` and returns its exit code. `python` is the
/// interpreter, with which the program starts its own processes.
#[pyfunction]
fn main(py: Python<'_>, python: OsString, arguments: Vec<OsString>) -> u8 {
    const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (Python package)");
    py.detach(|| {
        let start = vec![python, "-m".into(), "picofarm".into()];
        picofarm_cli::run_program_as(start, arguments, VERSION)
    })
}

/// The module.
#[pymodule]
fn _native(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("__version__", env!("CARGO_PKG_VERSION"))?;
    m.add_function(wrap_pyfunction!(main, m)?)?;
    m.add_function(wrap_pyfunction!(render::render, m)?)?;
    m.add_function(wrap_pyfunction!(flash::demultiplex, m)?)?;
    m.add_function(wrap_pyfunction!(flash::reconstruct, m)?)?;
    m.add_function(wrap_pyfunction!(sensor::sense, m)?)?;
    m.add_class::<scene::Scene>()?;
    m.add_class::<data::Dataset>()?;
    #[cfg(feature = "networks")]
    m.add_class::<model::Model>()?;
    m.add_class::<flash::Viewpoint>()?;
    Ok(())
}
