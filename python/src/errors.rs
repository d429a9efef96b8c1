//! Maps errors of the Rust crates to Python's exceptions.

use picofarm_demultiplex::DemultiplexError;
use picofarm_reconstruct::ReconstructError;
use picofarm_scene::SceneError;
use picofarm_store::StorageError;
use picofarm_transient::RenderError;
use pyo3::{
    PyErr,
    exceptions::{
        PyFileNotFoundError, PyKeyError, PyMemoryError, PyOSError, PyRuntimeError, PyValueError,
    },
};

/// Returns a `FileNotFoundError` or another `OSError` for a file that cannot be read or written,
/// and a `ValueError` otherwise.
pub(crate) fn scene(error: SceneError) -> PyErr {
    match &error {
        SceneError::Read { source, .. } if source.kind() == std::io::ErrorKind::NotFound => {
            PyFileNotFoundError::new_err(error.to_string())
        }
        SceneError::Read { .. } | SceneError::Write { .. } => PyOSError::new_err(error.to_string()),
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// Returns a `ValueError`, or a `MemoryError` if the histograms do not fit into memory.
pub(crate) fn render(error: RenderError) -> PyErr {
    match error {
        RenderError::Memory { .. } => PyMemoryError::new_err(error.to_string()),
        RenderError::Stopped => PyRuntimeError::new_err(error.to_string()),
        RenderError::Scene(e) => scene(e),
        RenderError::Invalid { .. } => PyValueError::new_err(error.to_string()),
    }
}

/// Returns a `ValueError` naming the argument.
pub(crate) fn demultiplex(error: DemultiplexError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Returns a `ValueError`, or a `RuntimeError` if the work was stopped.
pub(crate) fn reconstruct(error: ReconstructError) -> PyErr {
    match error {
        ReconstructError::Stopped => PyRuntimeError::new_err(error.to_string()),
        ReconstructError::Render(e) => render(e),
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// Returns a `KeyError` for a scene that is not published, a `FileNotFoundError` without a data
/// set, a `ValueError` for a wrong argument, and an `OSError` for an unreadable or damaged object.
pub(crate) fn store(error: StorageError) -> PyErr {
    let text = error.to_string();
    match error {
        StorageError::NotPublished { .. } | StorageError::SceneOutOfRange { .. } => {
            PyKeyError::new_err(text)
        }
        StorageError::NoDataset { .. } => PyFileNotFoundError::new_err(text),
        StorageError::Invalid { .. }
        | StorageError::SpecMismatch { .. }
        | StorageError::UnsupportedStore { .. }
        | StorageError::StoreSettings { .. } => PyValueError::new_err(text),
        _ => PyOSError::new_err(text),
    }
}

/// Returns a `ValueError` that names the argument.
pub(crate) fn argument(name: &str, what: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(format!("{name}: {what}"))
}
