//! Stores from a path or URL, the check that a store is safe for several writers, and leftovers of
//! killed writers.

pub(crate) mod account;
mod bandwidth;
#[cfg(feature = "clouds")]
mod clouds;
pub(crate) mod failure;
pub(crate) mod folder;
mod guard;
pub(crate) mod identity;
mod local;
pub(crate) mod many;
pub(crate) mod objects;
mod place;
mod probe;
pub(crate) mod service;
#[cfg(feature = "clouds")]
mod steady;
mod writable;

use std::sync::Arc;

use object_store::ObjectStore;
use object_store::local::LocalFileSystem;
use object_store::path::Path;

use crate::error::DatasetError;

pub use bandwidth::{Bandwidth, limit_bandwidth};
pub use identity::{check_identity, expect_identity, identify_store, store_identity};
pub(crate) use local::{leftovers, probe_leftovers};
pub(crate) use probe::PROBE;
pub use probe::{PROBE_WITHIN, probe};
pub use writable::{Writable, check_writable, local_ground};

use place::Place;

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
/// # Errors
/// [`DatasetError::UnsupportedStore`] for other schemes and for paths that cannot be object keys;
/// [`DatasetError::StoreSettings`] names a missing or unusable variable.
pub fn open_store(url_or_path: &str) -> Result<(Arc<dyn ObjectStore>, Path), DatasetError> {
    if let Some(place) = Place::parse(url_or_path)? {
        #[cfg(feature = "clouds")]
        let store = clouds::connect(&place)?;
        #[cfg(not(feature = "clouds"))]
        let store = not_built(&place)?;
        return Ok((store, place.prefix));
    }
    let path = local::local_path(url_or_path)?;
    let prefix = Path::from_absolute_path(&path).map_err(|e| DatasetError::UnsupportedStore {
        url: url_or_path.to_string(),
        what: format!("cannot be the prefix of object keys: {e}"),
    })?;
    Ok((Arc::new(LocalFileSystem::new().with_fsync(true)), prefix))
}

/// Checks that a location can be parsed. Does not check whether it can be reached.
///
/// # Errors
/// [`DatasetError::UnsupportedStore`].
pub fn check_location(url_or_path: &str) -> Result<(), DatasetError> {
    match Place::parse(url_or_path)? {
        Some(_) => Ok(()),
        None => local::local_path(url_or_path).map(drop),
    }
}

#[cfg(not(feature = "clouds"))]
fn not_built(place: &Place) -> Result<Arc<dyn ObjectStore>, DatasetError> {
    let scheme = place.service.scheme();
    Err(DatasetError::UnsupportedStore {
        url: format!("{scheme}://{}", place.bucket),
        what: "this picofarm was built without object stores; build it with `--features clouds`, or name a folder"
            .into(),
    })
}
