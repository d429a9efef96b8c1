//! Stores from a path or URL, the check that a store is safe for several writers, and what killed writers leave.

mod failure;
mod local;
mod probe;
mod s3;

use std::sync::Arc;

use object_store::ObjectStore;
use object_store::local::LocalFileSystem;
use object_store::path::Path;

use crate::error::DatasetError;

pub(crate) use failure::{Failure, io_hint, no_bucket};
pub(crate) use local::{leftovers, probe_leftovers};
pub(crate) use probe::PROBE;
pub use probe::probe;

/// The store and the prefix in it for a local path, a `file://` URL or `s3://bucket/prefix`. Neither folder, nor
/// prefix need exist. Nothing is asked of the store yet.
///
/// Local writes are flushed to the disk before they count, so that a manifest that exists after a power cut has its
/// objects. S3 is told where and who by the environment: `AWS_ENDPOINT_URL` (with `AWS_ALLOW_HTTP=true` for plain
/// HTTP), `AWS_REGION`, `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_SESSION_TOKEN`, the usual variables of
/// roles, and `AWS_TIMEOUT` (a request's time limit, e.g. `300s`). A store from here keeps its connections and the
/// limit of its requests in flight: open once, use for long.
///
/// # Errors
/// [`DatasetError::UnsupportedStore`] for other schemes and for paths that cannot be object keys;
/// [`DatasetError::StoreSettings`] names a missing or unusable variable.
pub fn open_store(url_or_path: &str) -> Result<(Arc<dyn ObjectStore>, Path), DatasetError> {
    if let Some(place) = s3::Place::parse(url_or_path)? {
        let variables = std::env::vars_os().filter_map(|(name, value)| {
            Some((name.into_string().ok()?, value.into_string().ok()?))
        });
        return Ok((s3::connect(&place, variables)?, place.prefix));
    }
    let path = local::local_path(url_or_path)?;
    let prefix = Path::from_absolute_path(&path).map_err(|e| DatasetError::UnsupportedStore {
        url: url_or_path.to_string(),
        what: format!("cannot be the prefix of object keys: {e}"),
    })?;
    Ok((Arc::new(LocalFileSystem::new().with_fsync(true)), prefix))
}

/// Whether a location can be understood; says nothing of whether it can be reached from here.
///
/// # Errors
/// [`DatasetError::UnsupportedStore`].
pub fn check_location(url_or_path: &str) -> Result<(), DatasetError> {
    match s3::Place::parse(url_or_path)? {
        Some(_) => Ok(()),
        None => local::local_path(url_or_path).map(drop),
    }
}
