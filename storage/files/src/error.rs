//! Why a file is not opened.

use std::path::{Path, PathBuf};

/// A file that is not opened, or cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// It lies elsewhere than in the folders allowed.
    #[error("{} is not opened: it lies outside {allowed}", path.display())]
    Outside {
        /// The file as it was named.
        path: PathBuf,
        /// Where files may lie.
        allowed: String,
    },
    /// A name that is no plain path.
    #[error(
        "{name:?} is not opened: {why}; write a path with / between its parts, relative to the file that names it"
    )]
    Name {
        /// The name.
        name: String,
        /// What is wrong with it.
        why: &'static str,
    },
    /// The system refuses.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's account.
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

    /// As the system's error, for readers that know no other: refusals are of kind `PermissionDenied`.
    pub fn into_io(self) -> std::io::Error {
        match self {
            Self::Io { source, .. } => source,
            refused => {
                std::io::Error::new(std::io::ErrorKind::PermissionDenied, refused.to_string())
            }
        }
    }
}
