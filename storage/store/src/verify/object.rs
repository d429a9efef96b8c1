//! Checks an object against its entry in a manifest.

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;

use super::report::{Fault, VerifyMode};
use crate::error::StorageError;
use crate::objects::{self, Rereads};
use crate::sealed::{ObjectEntry, sha256_hex};

/// Returns the object's fault, or its bytes if they were read. [`VerifyMode::Fast`] does not read
/// them.
///
/// # Errors
/// [`StorageError::Store`].
pub async fn looked_at(
    store: &dyn ObjectStore,
    path: &Path,
    entry: &ObjectEntry,
    mode: VerifyMode,
) -> Result<Result<Option<Bytes>, Fault>, StorageError> {
    let Some(size) = objects::size(store, path).await? else {
        return Ok(Err(Fault::Missing));
    };
    if size != entry.size {
        return Ok(Err(Fault::WrongSize {
            expected: entry.size,
            found: size,
        }));
    }
    if mode == VerifyMode::Fast {
        return Ok(Ok(None));
    }
    let bytes = objects::require(store, path).await?;
    let found = sha256_hex(&bytes);
    Ok(match found == entry.sha256 {
        true => Ok(Some(bytes)),
        false => Err(Fault::WrongHash {
            expected: entry.sha256.clone(),
            found,
        }),
    })
}

/// Reads an object and checks it against its manifest entry.
///
/// # Errors
/// [`StorageError::Damaged`] if it is missing or differs; [`StorageError::Store`].
pub async fn intact(
    store: &dyn ObjectStore,
    path: &Path,
    entry: &ObjectEntry,
) -> Result<Bytes, StorageError> {
    let mut rereads = Rereads::new(store);
    loop {
        let read = intact_once(store, path, entry).await;
        match rereads.pause(&read) {
            None => return read,
            Some(pause) => tokio::time::sleep(pause).await,
        }
    }
}

async fn intact_once(
    store: &dyn ObjectStore,
    path: &Path,
    entry: &ObjectEntry,
) -> Result<Bytes, StorageError> {
    let bytes = objects::require(store, path).await?;
    match sha256_hex(&bytes) == entry.sha256 {
        true => Ok(bytes),
        false => Err(StorageError::Damaged {
            object: objects::shown(store, path),
            what: "its SHA-256 is not the manifest's".into(),
        }),
    }
}
