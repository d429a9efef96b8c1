//! Reads MATLAB's HDF5 files: numeric arrays in the root group.

use std::path::Path;

use hdf5_pure::{Error, File};

/// An open file. Arrays stay on disk until they are read.
pub(super) struct Hdf5(Box<File>);

impl Hdf5 {
    /// Opens a file.
    ///
    /// # Errors
    /// The library's message.
    pub fn open(path: &Path) -> Result<Self, String> {
        let opened = File::open_streaming(path).map_err(said)?;
        Ok(Self(Box::new(opened)))
    }

    /// Returns the names of the arrays.
    pub fn names(&self) -> Vec<String> {
        self.0.root().datasets().unwrap_or_default()
    }

    /// Returns the shape of an array, slowest axis first; `None` if there is none of this name.
    ///
    /// # Errors
    /// The library's message.
    pub fn shape(&self, name: &str) -> Result<Option<Vec<u64>>, String> {
        let Ok(set) = self.0.dataset(name) else {
            return Ok(None);
        };
        set.shape().map(Some).map_err(said)
    }

    /// Reads a whole array.
    ///
    /// # Errors
    /// The library's message.
    pub fn all(&self, name: &str) -> Result<Vec<f64>, String> {
        self.0.dataset(name).map_err(said)?.read_f64().map_err(said)
    }

    /// Reads `n` rows of the slowest axis, beginning at `first`.
    ///
    /// # Errors
    /// The library's message.
    pub fn rows(&self, name: &str, first: u64, n: u64) -> Result<Vec<f64>, String> {
        let set = self.0.dataset(name).map_err(said)?;
        set.read_f64_rows(first, n).map_err(said)
    }
}

fn said(error: Error) -> String {
    error.to_string()
}
