//! Single objects: create-only puts, gets and sizes, with errors that name the object.

use bytes::Bytes;
use object_store::path::Path;
use object_store::{Error, ObjectStore, ObjectStoreExt, PutMode, PutOptions};

use crate::error::DatasetError;
use crate::manifest::sha256_hex;

/// Full path of a key relative to `prefix`.
pub(crate) fn path_of(prefix: &Path, key: &str) -> Path {
    key.split('/')
        .fold(prefix.clone(), |path, part| path.join(part))
}

/// A path as a person would look for it: with the leading `/` for local stores, whose keys are paths from the root.
pub(crate) fn shown(store: &dyn ObjectStore, path: &Path) -> String {
    // The store's root is told only by how it displays itself.
    match store.to_string().strip_prefix("LocalFileSystem(file://") {
        Some(root) => format!(
            "{}/{path}",
            root.trim_end_matches(')').trim_end_matches('/')
        ),
        None => path.to_string(),
    }
}

/// Puts create-only. `false`: it exists already.
pub(crate) async fn create(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: Bytes,
) -> Result<bool, DatasetError> {
    let options = PutOptions::from(PutMode::Create);
    match store.put_opts(path, bytes.into(), options).await {
        Ok(_) => Ok(true),
        Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => Ok(false),
        Err(e) => Err(DatasetError::store("write", shown(store, path), e)),
    }
}

/// Puts create-only; an object that exists must have equal bytes.
pub(crate) async fn create_or_match(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: Bytes,
) -> Result<(), DatasetError> {
    if create(store, path, bytes.clone()).await? {
        return Ok(());
    }
    // Never trust the server's own checksum: read it back.
    let stored = require(store, path).await?;
    if stored == bytes {
        return Ok(());
    }
    let (stored, ours) = (sha256_hex(&stored), sha256_hex(&bytes));
    tracing::error!(object = %path, %stored, %ours, "conflict: an object exists with other bytes");
    Err(DatasetError::Conflict {
        object: shown(store, path),
        stored,
        ours,
    })
}

/// Puts in any case (for metadata that grows).
pub(crate) async fn overwrite(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: Bytes,
) -> Result<(), DatasetError> {
    let put = store.put_opts(path, bytes.into(), PutOptions::default());
    put.await
        .map(drop)
        .map_err(|e| DatasetError::store("replace", shown(store, path), e))
}

/// The bytes; `None` where there is no such object.
pub(crate) async fn get(
    store: &dyn ObjectStore,
    path: &Path,
) -> Result<Option<Bytes>, DatasetError> {
    let result = match store.get(path).await {
        Ok(result) => result.bytes().await,
        Err(e) => Err(e),
    };
    match result {
        Ok(bytes) => Ok(Some(bytes)),
        Err(Error::NotFound { .. }) => Ok(None),
        Err(e) => Err(DatasetError::store("read", shown(store, path), e)),
    }
}

/// The bytes of an object that must be there.
pub(crate) async fn require(store: &dyn ObjectStore, path: &Path) -> Result<Bytes, DatasetError> {
    get(store, path)
        .await?
        .ok_or_else(|| DatasetError::Damaged {
            object: shown(store, path),
            what: "the object is missing".into(),
        })
}

/// The size; `None` where there is no such object.
pub(crate) async fn size(
    store: &dyn ObjectStore,
    path: &Path,
) -> Result<Option<u64>, DatasetError> {
    match store.head(path).await {
        Ok(meta) => Ok(Some(meta.size)),
        Err(Error::NotFound { .. }) => Ok(None),
        Err(e) => Err(DatasetError::store("look up", shown(store, path), e)),
    }
}
