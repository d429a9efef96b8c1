//! Import errors: the file, the field, the expected value, and how to correct it.

use std::path::Path;

use picofarm_store::StorageError;
use picofarm_store::io_hint;

/// A refused or failed import.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The content of the files is invalid, or differs from the request.
    #[error("{file}: {field}: expected {expected}, found {found}; {hint}")]
    Refused {
        /// The file or folder.
        file: String,
        /// The field, array or property.
        field: String,
        /// The expected value.
        expected: String,
        /// The actual value.
        found: String,
        /// What to do: an option that overrides the value, or how to convert the file.
        hint: String,
    },
    /// A file cannot be decoded.
    #[error("{file}: {what}; {hint}")]
    Unreadable {
        /// The file.
        file: String,
        /// A description of the problem.
        what: String,
        /// How to repair or convert it.
        hint: String,
    },
    /// The format does not use this option.
    #[error(
        "{option}: {format} data say this themselves, or have no such thing; leave the option out"
    )]
    UselessOption {
        /// The option.
        option: &'static str,
        /// The format's name.
        format: &'static str,
    },
    /// A file that must not be opened, or cannot be.
    #[error("{error}{}", file_hint(error))]
    File {
        /// The file and the reason.
        #[from]
        error: picofarm_files::FileError,
    },
    /// A file operation failed.
    #[error("cannot {action} {path}{}: {source}", io_hint(source).map(|h| format!(" ({h})")).unwrap_or_default())]
    Io {
        /// The operation, e.g. `read`.
        action: &'static str,
        /// The path.
        path: String,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The data set rejected the converted scene.
    #[error(transparent)]
    Dataset(#[from] StorageError),
}

fn file_hint(error: &picofarm_files::FileError) -> String {
    match error {
        picofarm_files::FileError::Io { source, .. } => {
            io_hint(source).map_or_else(String::new, |h| format!(" ({h})"))
        }
        _ => String::new(),
    }
}

impl ImportError {
    pub(super) fn refused(
        file: impl AsRef<Path>,
        field: impl Into<String>,
        expected: impl Into<String>,
        found: impl Into<String>,
        hint: impl Into<String>,
    ) -> Self {
        Self::Refused {
            file: file.as_ref().display().to_string(),
            field: field.into(),
            expected: expected.into(),
            found: found.into(),
            hint: hint.into(),
        }
    }

    pub(super) fn unreadable(
        file: impl AsRef<Path>,
        what: impl ToString,
        hint: impl Into<String>,
    ) -> Self {
        Self::Unreadable {
            file: file.as_ref().display().to_string(),
            what: what.to_string(),
            hint: hint.into(),
        }
    }

    pub(super) fn io(action: &'static str, path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Self::Io {
            action,
            path: path.as_ref().display().to_string(),
            source,
        }
    }
}
