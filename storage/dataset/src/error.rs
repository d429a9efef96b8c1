//! What can go wrong with a data set.

use std::io;

use crate::store::account::Failure;
use crate::store::failure::io_hint;
use crate::store::service::Service;

/// An operation on a data set that failed.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A specification or a scene's record is unusable.
    #[error("{field}: {what}")]
    Invalid {
        /// The field, e.g. `spec.gate.bins` or `record.depth`.
        field: String,
        /// What was expected, what was found and how to correct it.
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
    /// A scene made again came out otherwise. Equal tasks must give equal bytes, so this is an alarm.
    #[error(
        "alarm at {object}: expected SHA-256 {expected} as recorded, but the scene made again has {ours}; nothing stored \
         was changed. Use the program version that made it; if this is the one, its output is not reproducible: report it"
    )]
    Diverged {
        /// The object's full key (its path, in a local store).
        object: String,
        /// SHA-256 that the manifest, or a snapshot, names.
        expected: String,
        /// SHA-256 of what was made again.
        ours: String,
    },
    /// An object of a published scene is missing or broken.
    #[error("{object}: {what}")]
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
    /// The environment does not say how to reach the store, or says it wrongly.
    #[error("{url}: {what}")]
    StoreSettings {
        /// The store.
        url: String,
        /// The variable, what was expected and how to correct it; no variable's value.
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
    #[error("cannot {action} {object}{}: {account}", hint.map(|h| format!(" ({h})")).unwrap_or_default())]
    Store {
        /// E.g. `write`.
        action: &'static str,
        /// The object's full key (its path, in a local store).
        object: String,
        /// How to correct it, where known.
        hint: Option<&'static str>,
        /// What happened, without secrets.
        account: String,
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
        let object = object.to_string();
        let service = Service::of(&object).map(|(service, _)| service);
        let Failure { account, hint } = Failure::of(&source, service);
        Self::Store {
            action,
            object,
            hint,
            account,
        }
    }

    pub(crate) fn io(action: &'static str, path: &std::path::Path, source: io::Error) -> Self {
        Self::Io {
            action,
            path: path.display().to_string(),
            source,
        }
    }

    /// The same where the bytes of an object cannot be decoded: it is damaged.
    pub(crate) fn in_object(self, object: impl FnOnce() -> String) -> Self {
        match self {
            Self::Codec { what, reason } => Self::Damaged {
                object: object(),
                what: format!("{what}: {reason}"),
            },
            other => other,
        }
    }

    pub(crate) fn codec(what: impl Into<String>, reason: impl ToString) -> Self {
        Self::Codec {
            what: what.into(),
            reason: reason.to_string(),
        }
    }
}
