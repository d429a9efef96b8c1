//! Reads MATLAB's HDF5 files: numeric arrays in the root group.

use std::path::Path;

use hdf5_pure::{AttrValue, Error, File};

/// An open file. Arrays stay on disk until they are read.
pub(super) struct Hdf5(Box<File>);

impl Hdf5 {
    /// Opens a file.
    ///
    /// # Errors
    /// The library's message.
    pub fn open(path: &Path) -> Result<Self, String> {
        let opened = File::open_streaming(path).map_err(message_of)?;
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
        set.shape().map(Some).map_err(message_of)
    }

    /// Reads a whole array.
    ///
    /// # Errors
    /// The library's message.
    pub fn all(&self, name: &str) -> Result<Vec<f64>, String> {
        self.0
            .dataset(name)
            .map_err(message_of)?
            .read_f64()
            .map_err(message_of)
    }

    /// Reads an attribute of the root group that is a number; `None` if there is none.
    ///
    /// # Errors
    /// The library's message.
    pub fn attribute(&self, name: &str) -> Result<Option<f64>, String> {
        let attributes = self.0.root().attrs().map_err(message_of)?;
        Ok(match attributes.get(name) {
            Some(AttrValue::F64(x)) => Some(*x),
            Some(AttrValue::U64(n)) => Some(*n as f64),
            _ => None,
        })
    }

    /// Reads `n` rows of the slowest axis, beginning at `first`.
    ///
    /// # Errors
    /// The library's message.
    pub fn rows(&self, name: &str, first: u64, n: u64) -> Result<Vec<f64>, String> {
        let set = self.0.dataset(name).map_err(message_of)?;
        set.read_f64_rows(first, n).map_err(message_of)
    }
}

fn message_of(error: Error) -> String {
    error.to_string()
}
