//! The reasons why a file is not opened.

use std::path::{Path, PathBuf};

/// A failure to open or read a file.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The file is outside the allowed folders.
    #[error("{} is not opened: it lies outside {allowed}", path.display())]
    Outside {
        /// The path as given.
        path: PathBuf,
        /// The allowed folders.
        allowed: String,
    },
    /// The name is not a plain path.
    #[error(
        "{name:?} is not opened: {why}; write a path with / between its parts, relative to the file that names it"
    )]
    Name {
        /// The name.
        name: String,
        /// The problem with the name.
        why: &'static str,
    },
    /// The operating system returned an error.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
}

impl FileError {
    pub(crate) fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io {
            path: path.to_owned(),
            source,
        }
    }

    /// Converts to a system error, for readers that support no other type. Refusals have the kind
    /// `PermissionDenied`.
    pub fn into_io(self) -> std::io::Error {
        match self {
            Self::Io { source, .. } => source,
            refused => {
                std::io::Error::new(std::io::ErrorKind::PermissionDenied, refused.to_string())
            }
        }
    }
}
