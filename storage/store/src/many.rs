//! Concurrent requests for several objects.

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;
use object_store::path::Path;

use crate::error::StorageError;
use crate::objects;

/// Number of concurrent requests for one scene.
pub const CONCURRENCY: usize = 8;

/// Puts objects create-only, some of them concurrently. Existing objects must have equal bytes.
pub async fn put_all(
    store: &dyn ObjectStore,
    objects: &[(Path, Bytes)],
) -> Result<(), StorageError> {
    let put = |(path, bytes): &(Path, Bytes)| {
        let (path, bytes) = (path.clone(), bytes.clone());
        async move { objects::create_or_match(store, &path, bytes).await }
    };
    all(objects.iter().map(put).collect()).await
}

/// Puts objects again that are missing after the manifest was written. A collector may have deleted
/// an object before the manifest protected it: one left by a killed worker and found equal, or one
/// that this process wrote before a long pause.
pub async fn put_again(
    store: &dyn ObjectStore,
    objects: &[(Path, Bytes)],
) -> Result<(), StorageError> {
    let again = |(path, bytes): &(Path, Bytes)| {
        let (path, bytes) = (path.clone(), bytes.clone());
        async move {
            match objects::size(store, &path).await? {
                Some(_) => Ok(()),
                None => objects::create_or_match(store, &path, bytes).await,
            }
        }
    };
    all(objects.iter().map(again).collect()).await
}

/// Awaits all requests, some of them concurrently. Returns the first error at once.
pub async fn all(
    requests: Vec<impl Future<Output = Result<(), StorageError>>>,
) -> Result<(), StorageError> {
    let mut results = stream::iter(requests).buffer_unordered(CONCURRENCY);
    while results.try_next().await?.is_some() {}
    Ok(())
}

/// Checks that an object exists and has the expected size.
pub async fn check_size(
    store: &dyn ObjectStore,
    path: Path,
    expected: u64,
) -> Result<(), StorageError> {
    let what = match objects::size(store, &path).await? {
        Some(size) if size == expected => return Ok(()),
        Some(size) => format!("expected {expected} bytes, found {size}"),
        None => "the object is missing".into(),
    };
    Err(StorageError::Damaged {
        object: objects::shown(store, &path),
        what,
    })
}
