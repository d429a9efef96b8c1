//! What can go wrong with a data set, and the hint that goes with each trouble of the store.

use std::error::Error as _;
use std::io;

/// An operation on a data set that failed.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A specification or a scene's record is unusable.
    #[error("{field}: {what}")]
    Invalid {
        /// The field, e.g. `spec.gate.bins` or `record.depth`.
        field: String,
        /// What was expected, what was found and how to mend it.
        what: String,
    },
    /// The data set exists with other properties.
    #[error(
        "{prefix}: the data set stored here has {field} = {stored}, but {asked} was asked for; \
         use another location, or the stored value"
    )]
    SpecMismatch {
        /// Where the data set lies.
        prefix: String,
        /// The differing field, e.g. `gate.bins`.
        field: String,
        /// Its stored value.
        stored: String,
        /// The value asked for.
        asked: String,
    },
    /// There is no data set at the location.
    #[error(
        "{prefix}: no data set here (zarr.json is missing); check the location, or create it first"
    )]
    NoDataset {
        /// The location.
        prefix: String,
    },
    /// The scene's index is not below the number of scenes.
    #[error(
        "scene {scene}: the data set has room for {scenes} scenes (0 to {scenes} - 1); grow it first"
    )]
    SceneOutOfRange {
        /// The index.
        scene: u64,
        /// Number of scenes.
        scenes: u64,
    },
    /// The scene has no manifest, so it is not part of the data set (yet).
    #[error("scene {scene} is not published: {object} does not exist; render it first")]
    NotPublished {
        /// The scene.
        scene: u64,
        /// Its manifest's key.
        object: String,
    },
    /// An object exists with other bytes. Two runs of the same task must give the same bytes, so this is an alarm.
    #[error(
        "conflict at {object}: it exists with SHA-256 {stored}, but this run made {ours}; the stored object was \
         left as it is. The same task must give the same bytes: compare renderer and encoder versions, then \
         verify the data set"
    )]
    Conflict {
        /// The object's full key (its path, in a local store).
        object: String,
        /// SHA-256 of the stored bytes.
        stored: String,
        /// SHA-256 of the bytes that were to be stored.
        ours: String,
    },
    /// An object of a published scene is missing or broken.
    #[error(
        "{object}: {what}; publish the scene again to replace a missing object, or delete a broken one first"
    )]
    Damaged {
        /// The object's full key (its path, in a local store).
        object: String,
        /// What is wrong with it.
        what: String,
    },
    /// The kind of store is not supported.
    #[error("{url}: {what}")]
    UnsupportedStore {
        /// The URL or path.
        url: String,
        /// What was expected.
        what: String,
    },
    /// The store does not keep the promise of create-only puts.
    #[error(
        "the store at {prefix} is unsafe for several writers: {what}; use a local file system or a store with conditional puts"
    )]
    UnsafeStore {
        /// The location.
        prefix: String,
        /// The promise broken.
        what: String,
    },
    /// The store refused or failed.
    #[error("cannot {action} {object}{}: {source}", hint.map(|h| format!(" ({h})")).unwrap_or_default())]
    Store {
        /// E.g. `write`.
        action: &'static str,
        /// The object's full key (its path, in a local store).
        object: String,
        /// How to mend it, where known.
        hint: Option<&'static str>,
        /// The store's own account.
        source: Box<object_store::Error>,
    },
    /// A file operation failed.
    #[error("cannot {action} {path}{}: {source}", io_hint(source).map(|h| format!(" ({h})")).unwrap_or_default())]
    Io {
        /// E.g. `create`.
        action: &'static str,
        /// The path.
        path: String,
        /// The system's account.
        source: io::Error,
    },
    /// Zarr's codecs refused.
    #[error("{what}: {reason}")]
    Codec {
        /// What was being encoded or decoded.
        what: String,
        /// The codec's account.
        reason: String,
    },
}

impl DatasetError {
    pub(crate) fn invalid(field: impl Into<String>, what: impl Into<String>) -> Self {
        Self::Invalid {
            field: field.into(),
            what: what.into(),
        }
    }

    pub(crate) fn store(
        action: &'static str,
        object: impl ToString,
        source: object_store::Error,
    ) -> Self {
        Self::Store {
            action,
            object: object.to_string(),
            hint: root_io_error(&source).and_then(io_hint),
            source: Box::new(source),
        }
    }

    pub(crate) fn io(action: &'static str, path: &std::path::Path, source: io::Error) -> Self {
        Self::Io {
            action,
            path: path.display().to_string(),
            source,
        }
    }

    pub(crate) fn codec(what: impl Into<String>, reason: impl ToString) -> Self {
        Self::Codec {
            what: what.into(),
            reason: reason.to_string(),
        }
    }
}

/// The system's error at the end of the chain, if there is one.
fn root_io_error(error: &object_store::Error) -> Option<&io::Error> {
    let mut at: Option<&(dyn std::error::Error + 'static)> = error.source();
    while let Some(e) = at {
        if let Some(io) = e.downcast_ref::<io::Error>() {
            return Some(io);
        }
        at = e.source();
    }
    None
}

fn io_hint(error: &io::Error) -> Option<&'static str> {
    match error.kind() {
        io::ErrorKind::PermissionDenied => {
            Some("no permission: check the owner and mode of the folder")
        }
        io::ErrorKind::ReadOnlyFilesystem => {
            Some("the file system is mounted read-only: choose another location")
        }
        io::ErrorKind::StorageFull => Some("the disk is full: free some space, then run it again"),
        io::ErrorKind::QuotaExceeded => {
            Some("the disk quota is used up: free some space, then run it again")
        }
        io::ErrorKind::NotADirectory => Some("a part of the path is a file, not a folder"),
        io::ErrorKind::Unsupported => {
            Some("the file system has no hard links, which create-only writes need")
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_told_with_the_object_and_a_hint() {
        let nested = |kind| object_store::Error::Generic {
            store: "LocalFileSystem",
            source: Box::new(object_store::Error::Generic {
                store: "inner",
                source: Box::new(io::Error::from(kind)),
            }),
        };
        let text =
            |kind| DatasetError::store("write", "sets/a/depth/c/0/0/0", nested(kind)).to_string();
        let full = text(io::ErrorKind::StorageFull);
        assert!(
            full.starts_with(
                "cannot write sets/a/depth/c/0/0/0 (the disk is full: free some space"
            ),
            "{full}"
        );
        let read_only = text(io::ErrorKind::ReadOnlyFilesystem);
        assert!(read_only.contains("mounted read-only"), "{read_only}");
    }
}
