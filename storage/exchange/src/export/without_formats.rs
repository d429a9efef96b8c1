//! Error messages of a program built without OpenEXR and HDF5.

use super::{ExportFormat, plain::PlainScene, sb3d::Samples};
use crate::{BUILD_WITH_FORMATS, WITHOUT_FORMATS};
use picofarm_dataset::DatasetSpec;
use picofarm_store::StorageError;

/// Returns an error for a format that this program cannot write, before anything is written.
///
/// # Errors
/// [`StorageError::Invalid`] at `format`.
pub(super) fn check(format: ExportFormat) -> Result<(), StorageError> {
    match format {
        ExportFormat::Sb3d | ExportFormat::Hdf5 => Err(missing()),
        ExportFormat::Zarr | ExportFormat::WebDataset => Ok(()),
    }
}

/// Returns the error.
///
/// # Errors
/// Always.
pub(super) fn image(_: (usize, usize), _: Samples) -> Result<Vec<u8>, StorageError> {
    Err(missing())
}

/// Returns the error.
///
/// # Errors
/// Always.
pub(super) fn file(_: &PlainScene, _: &DatasetSpec) -> Result<Vec<u8>, StorageError> {
    Err(missing())
}

fn missing() -> StorageError {
    StorageError::invalid("format", format!("{WITHOUT_FORMATS}; {BUILD_WITH_FORMATS}"))
}
