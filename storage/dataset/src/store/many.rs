//! Several objects at a time.

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use object_store::ObjectStore;
use object_store::path::Path;

use crate::error::DatasetError;
use crate::store::objects;

/// Requests in flight for one scene.
pub(crate) const CONCURRENCY: usize = 8;

/// Puts objects create-only, some at a time; those that exist must have equal bytes.
pub(crate) async fn put_all(
    store: &dyn ObjectStore,
    objects: &[(Path, Bytes)],
) -> Result<(), DatasetError> {
    let put = |(path, bytes): &(Path, Bytes)| {
        let (path, bytes) = (path.clone(), bytes.clone());
        async move { objects::create_or_match(store, &path, bytes).await }
    };
    all(objects.iter().map(put).collect()).await
}

/// The same for those that are gone when the manifest stands. A collector may have taken an object before there was a
/// manifest to protect it: what a killed worker had left and was found equal, or what this process wrote before it stood
/// still for long.
pub(crate) async fn put_again(
    store: &dyn ObjectStore,
    objects: &[(Path, Bytes)],
) -> Result<(), DatasetError> {
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

/// Waits for all, some at a time; the first error ends it.
pub(crate) async fn all(
    requests: Vec<impl Future<Output = Result<(), DatasetError>>>,
) -> Result<(), DatasetError> {
    let mut results = stream::iter(requests).buffer_unordered(CONCURRENCY);
    while results.try_next().await?.is_some() {}
    Ok(())
}

/// Checks that an object is there and as large as expected.
pub(crate) async fn check_size(
    store: &dyn ObjectStore,
    path: Path,
    expected: u64,
) -> Result<(), DatasetError> {
    let what = match objects::size(store, &path).await? {
        Some(size) if size == expected => return Ok(()),
        Some(size) => format!("expected {expected} bytes, found {size}"),
        None => "the object is missing".into(),
    };
    Err(DatasetError::Damaged {
        object: objects::shown(store, &path),
        what,
    })
}
