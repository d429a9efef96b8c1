//! Object stores: folders and clouds. Opens a store from a path or URL, checks that it is safe for
//! several writers, and reads, creates and checks single objects with errors that name them.
//!
//! Objects are created, never overwritten. A result with several objects is published by its
//! manifest, which is written last.

mod account;
mod bandwidth;
mod bucket_url;
mod cache;
#[cfg(feature = "clouds")]
mod clouds;
pub mod concurrent;
mod error;
mod failure;
pub mod folder;
mod guard;
mod identity;
mod local;
pub mod objects;
pub mod packed;
mod probe;
pub mod published;
pub mod sealed;
mod service;
#[cfg(feature = "clouds")]
mod steady;
mod together;
pub mod verify;
mod writable;

use std::sync::Arc;

use object_store::ObjectStore;
use object_store::path::Path;

pub use bandwidth::{Bandwidth, limit_bandwidth};
pub use cache::Cache;
pub use error::StorageError;
pub use failure::io_hint;
pub use folder::check_own_folder;
pub use identity::{IDENTITY, check_identity, expect_identity, identify_store, store_identity};
pub use local::{leftovers, probe_leftovers};
pub use objects::publish_files;
pub use probe::{PROBE, PROBE_WITHIN, probe};
pub use sealed::{ObjectEntry, sha256_hex};
pub use together::get_sized;
pub use verify::{Fault, Problem, RecordKind, Remedy, Verification, VerifyMode, Watch};
pub use writable::{Writable, check_writable, local_ground};

use bucket_url::BucketUrl;
use together::FolderStore;

/// Returns the store, and the prefix in it, for a local path, a `file://` URL,
/// `s3://bucket/prefix`, `gs://bucket/prefix` (Google) or `az://container/prefix` (Azure). The
/// folder or prefix need not exist. No request is sent to the store yet.
///
/// Local writes are flushed to the disk before they count, so that after a power failure an
/// existing manifest has its objects. Other stores need the feature `clouds`, and take location and
/// credentials from the environment (docs/credentials.md). A store keeps its connections and its
/// limit of concurrent requests, so it should be opened once and reused. See also
/// [`limit_bandwidth`].
///
/// ```
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), picofarm_store::StorageError> {
/// let folder = tempfile::tempdir().expect("a temporary folder");
/// let (store, prefix) = picofarm_store::open_store(&folder.path().display().to_string())?;
/// let key = picofarm_store::objects::path_of(&prefix, "notes/a.txt");
/// assert!(picofarm_store::objects::create(&*store, &key, "first".into()).await?);
/// assert!(folder.path().join("notes/a.txt").is_file());
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// [`StorageError::UnsupportedStore`] for other schemes and for paths that cannot be object keys;
/// [`StorageError::StoreSettings`] names a missing or unusable variable.
pub fn open_store(url_or_path: &str) -> Result<(Arc<dyn ObjectStore>, Path), StorageError> {
    if let Some(place) = BucketUrl::parse(url_or_path)? {
        #[cfg(feature = "clouds")]
        let store = clouds::connect(&place)?;
        #[cfg(not(feature = "clouds"))]
        let store = not_built(&place)?;
        return Ok((store, place.prefix));
    }
    let path = local::local_path(url_or_path)?;
    let prefix = Path::from_absolute_path(&path).map_err(|e| StorageError::UnsupportedStore {
        url: url_or_path.to_string(),
        what: format!("cannot be the prefix of object keys: {e}"),
    })?;
    Ok((Arc::new(FolderStore::new()), prefix))
}

/// Checks that a location can be parsed. Does not check whether it can be reached.
///
/// ```
/// use picofarm_store::check_location;
///
/// assert!(check_location("data/sets").is_ok());
/// let error = check_location("s3:/bucket/sets").unwrap_err();
/// assert!(error.to_string().contains("did you mean s3://bucket/sets?"));
/// ```
///
/// # Errors
/// [`StorageError::UnsupportedStore`].
pub fn check_location(url_or_path: &str) -> Result<(), StorageError> {
    match BucketUrl::parse(url_or_path)? {
        Some(_) => Ok(()),
        None => local::local_path(url_or_path).map(drop),
    }
}

#[cfg(not(feature = "clouds"))]
fn not_built(place: &BucketUrl) -> Result<Arc<dyn ObjectStore>, StorageError> {
    let scheme = place.service.scheme();
    Err(StorageError::UnsupportedStore {
        url: format!("{scheme}://{}", place.bucket),
        what: "this picofarm was built without object stores; build it with `--features clouds`, or name a folder"
            .into(),
    })
}
