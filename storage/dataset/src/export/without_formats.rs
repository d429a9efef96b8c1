//! Errors that say that this program was built without OpenEXR and HDF5.

use super::sb3d::Samples;
use crate::{BUILD_WITH_FORMATS, WITHOUT_FORMATS, error::DatasetError};

/// Says so.
///
/// # Errors
/// Always.
pub(super) fn image(_: (usize, usize), _: Samples) -> Result<Vec<u8>, DatasetError> {
    Err(missing())
}

/// The error of a program that cannot write OpenEXR: [`DatasetError::Invalid`] at `format`.
pub(super) fn missing() -> DatasetError {
    DatasetError::invalid("format", format!("{WITHOUT_FORMATS}; {BUILD_WITH_FORMATS}"))
}
