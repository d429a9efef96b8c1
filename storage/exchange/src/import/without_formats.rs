//! Error messages of a program built without OpenEXR and HDF5.

use std::path::Path;

use super::ImportError;
use super::files::Files;
use super::image::Exr;
use crate::{BUILD_WITH_FORMATS, WITHOUT_FORMATS};

/// Returns the error.
///
/// # Errors
/// Always.
pub(super) fn exr_size(file: &Path, _: &Files) -> Result<(usize, usize), ImportError> {
    Err(missing(file))
}

/// Returns the error.
///
/// # Errors
/// Always.
pub(super) fn exr(file: &Path, _: &[u8]) -> Result<Exr, ImportError> {
    Err(missing(file))
}

/// Returns the error for a file that this program cannot read.
pub(super) fn missing(file: &Path) -> ImportError {
    ImportError::unreadable(file, WITHOUT_FORMATS, BUILD_WITH_FORMATS)
}

/// An uninhabited type.
pub(super) enum Hdf5 {}

impl Hdf5 {
    /// Returns the error.
    ///
    /// # Errors
    /// Always.
    pub fn open(_: &Path) -> Result<Self, String> {
        Err(format!("{WITHOUT_FORMATS}; {BUILD_WITH_FORMATS}"))
    }

    /// Cannot be called.
    pub fn names(&self) -> Vec<String> {
        match *self {}
    }

    /// Cannot be called.
    pub fn shape(&self, _: &str) -> Result<Option<Vec<u64>>, String> {
        match *self {}
    }

    /// Cannot be called.
    pub fn all(&self, _: &str) -> Result<Vec<f64>, String> {
        match *self {}
    }

    /// Cannot be called.
    pub fn attribute(&self, _: &str) -> Result<Option<f64>, String> {
        match *self {}
    }

    /// Cannot be called.
    pub fn rows(&self, _: &str, _: u64, _: u64) -> Result<Vec<f64>, String> {
        match *self {}
    }
}
