//! A store's identity: a small object in its root with a random number, like restic's config and
//! Ceph's fsid. An unmounted folder, or another store at the same location, has no identity or a
//! different one.
//!
//! Only a submission creates it, and only create-only: the submission is the first user of a store,
//! it knows the job, and its user sees the report. A worker never creates it, because it cannot
//! distinguish an unmounted folder from a new store. The identity is not part of task keys or of
//! published bytes.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use object_store::path::Path;
use object_store::{Error, ObjectStore, ObjectStoreExt};
use uuid::Uuid;

use super::guard::Guarded;
use super::objects;
use crate::error::StorageError;

/// Key of the identity in the store's root.
pub const IDENTITY: &str = ".picofarm-store.json";
/// The JSON field with the number.
const FIELD: &str = "picofarm_store";
/// Validity period of a check of a network store. Folders are checked before each write, because
/// this costs next to nothing there, and only folders can be unmounted.
pub(super) const FRESH: Duration = Duration::from_secs(10);

/// The error for a store with another identity than expected.
#[derive(Debug)]
pub(crate) struct Mismatch(String);

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Mismatch {}

impl Mismatch {
    /// Returns the mismatch in a chain of store errors, if any.
    pub(crate) fn among<'a>(
        chain: &[&'a (dyn std::error::Error + 'static)],
    ) -> Option<&'a Mismatch> {
        chain.iter().find_map(|e| e.downcast_ref())
    }
}

impl From<Mismatch> for Error {
    fn from(mismatch: Mismatch) -> Self {
        Error::Generic {
            store: "identity",
            source: Box::new(mismatch),
        }
    }
}

fn key(prefix: &Path) -> Path {
    prefix.clone().join(IDENTITY)
}

fn parse(bytes: &[u8]) -> Option<Uuid> {
    let value: serde_json::Value = serde_json::from_slice(bytes).ok()?;
    value[FIELD].as_str()?.parse().ok()
}

fn damaged(store: &dyn ObjectStore, prefix: &Path) -> StorageError {
    StorageError::Damaged {
        object: objects::shown(store, &key(prefix)),
        what: format!(
            "expected the store's identity, JSON with a UUID in {FIELD:?}; put it back from a copy"
        ),
    }
}

/// Returns the identity of the store at `prefix`; `None` if it has none.
///
/// # Errors
/// [`StorageError::Damaged`] if its object cannot be parsed; [`StorageError::Store`].
pub async fn store_identity(
    store: &dyn ObjectStore,
    prefix: &Path,
) -> Result<Option<Uuid>, StorageError> {
    let Some(bytes) = objects::get(store, &key(prefix)).await? else {
        return Ok(None);
    };
    let identity = parse(&bytes).ok_or_else(|| damaged(store, prefix))?;
    Ok(Some(identity))
}

/// Returns the identity of the store at `prefix`, creating it if necessary. Concurrent callers get
/// the same identity. Only for submissions: see above.
///
/// # Errors
/// Those of [`store_identity`].
pub async fn identify_store(store: &dyn ObjectStore, prefix: &Path) -> Result<Uuid, StorageError> {
    if let Some(identity) = store_identity(store, prefix).await? {
        return Ok(identity);
    }
    let identity = Uuid::new_v4();
    let text = format!("{}\n", serde_json::json!({FIELD: identity.to_string()}));
    if objects::create(store, &key(prefix), Bytes::from(text)).await? {
        return Ok(identity);
    }
    // Another process created it first.
    let theirs = store_identity(store, prefix).await?;
    theirs.ok_or_else(|| damaged(store, prefix))
}

/// Returns the store at `prefix` with checks of its identity: if the identity is missing or
/// different, writes fail, and so do reads of missing objects. A missing folder is not created
/// again.
pub fn expect_identity(
    store: Arc<dyn ObjectStore>,
    prefix: &Path,
    identity: Uuid,
) -> Arc<dyn ObjectStore> {
    Arc::new(Guarded::new(store, prefix, identity))
}

/// Checks the identity of the store at `prefix`.
///
/// # Errors
/// [`StorageError::Store`] with the reason.
pub async fn check_identity(
    store: &dyn ObjectStore,
    prefix: &Path,
    identity: Uuid,
) -> Result<(), StorageError> {
    let checked = check(store, prefix, identity).await;
    checked.map_err(|e| StorageError::store("use", objects::shown(store, prefix), e))
}

/// Like [`check_identity`], with a store error.
pub(super) async fn check(
    store: &dyn ObjectStore,
    prefix: &Path,
    expected: Uuid,
) -> Result<(), Error> {
    let (place, ask) = match objects::folder(store, prefix) {
        Some(folder) => (format!("the folder {}", folder.display()), "is it mounted?"),
        None => (
            objects::shown(store, prefix),
            "is this the right bucket, and are its objects all there?",
        ),
    };
    let bytes = match store.get(&key(prefix)).await {
        Ok(found) => found.bytes().await?,
        Err(e @ Error::NotFound { .. }) if !super::failure::no_bucket(&e) => {
            let what = format!("{place} has no store identity; expected {expected}; {ask}");
            return Err(Mismatch(what).into());
        }
        Err(e) => return Err(e),
    };
    match parse(&bytes) {
        Some(found) if found == expected => Ok(()),
        Some(found) => {
            let what =
                format!("{place} has the store identity {found}; expected {expected}; {ask}");
            Err(Mismatch(what).into())
        }
        None => {
            let what =
                format!("{place} has a store identity that cannot be read; expected {expected}");
            Err(Mismatch(what).into())
        }
    }
}
