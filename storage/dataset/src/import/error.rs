//! Why something cannot be imported: which file, which field, what was expected, and how to correct it.

use std::path::Path;

use crate::error::DatasetError;
use crate::store::failure::io_hint;

/// An import that was refused or failed.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The files say something else than they must, or than what was asked for.
    #[error("{file}: {field}: expected {expected}, found {found}; {hint}")]
    Refused {
        /// The file or folder.
        file: String,
        /// What in it: a field, an array, a property.
        field: String,
        /// What it should be.
        expected: String,
        /// What it is.
        found: String,
        /// What to do: an option that overrides, or how to convert the file.
        hint: String,
    },
    /// A file cannot be decoded.
    #[error("{file}: {what}; {hint}")]
    Unreadable {
        /// The file.
        file: String,
        /// What is wrong with it.
        what: String,
        /// How to repair or convert it.
        hint: String,
    },
    /// An option that the format has no use for.
    #[error(
        "{option}: {format} data say this themselves, or have no such thing; leave the option out"
    )]
    UselessOption {
        /// The option.
        option: &'static str,
        /// The format's name.
        format: &'static str,
    },
    /// A file that may not be opened, or cannot be.
    #[error("{error}{}", file_hint(error))]
    File {
        /// Which and why.
        #[from]
        error: picofarm_files::FileError,
    },
    /// A file operation failed.
    #[error("cannot {action} {path}{}: {source}", io_hint(source).map(|h| format!(" ({h})")).unwrap_or_default())]
    Io {
        /// E.g. `read`.
        action: &'static str,
        /// The path.
        path: String,
        /// The system's account.
        source: std::io::Error,
    },
    /// The data set refused what was made of the files.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
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
