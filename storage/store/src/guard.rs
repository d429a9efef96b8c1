//! A store that checks its identity during use.

use std::fmt;
use std::ops::Range;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures::stream::{self, BoxStream};
use futures::{StreamExt, TryStreamExt};
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, PutMultipartOptions, PutOptions, PutPayload, PutResult, RenameOptions, Result,
};
use uuid::Uuid;

use super::{identity, objects};

/// The store behind the check.
#[derive(Debug, Clone)]
pub(super) struct Guarded(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    store: Arc<dyn ObjectStore>,
    prefix: Path,
    identity: Uuid,
    /// Validity period of a check.
    fresh: Duration,
    seen: Mutex<Option<Instant>>,
}

impl Guarded {
    pub(super) fn new(store: Arc<dyn ObjectStore>, prefix: &Path, identity: Uuid) -> Self {
        let fresh = match objects::folder(&*store, prefix) {
            Some(_) => Duration::ZERO,
            None => identity::FRESH,
        };
        Self(Arc::new(Inner {
            store,
            prefix: prefix.clone(),
            identity,
            fresh,
            seen: Mutex::default(),
        }))
    }

    async fn check(&self) -> Result<()> {
        let inner = &*self.0;
        let seen = *inner.seen.lock().expect("no panic while locked");
        if seen.is_some_and(|at| at.elapsed() < inner.fresh) {
            return Ok(());
        }
        let checked = identity::check(&*inner.store, &inner.prefix, inner.identity).await;
        let now = checked.is_ok().then(Instant::now);
        *inner.seen.lock().expect("no panic while locked") = now;
        checked
    }

    /// Returns the answer. If an object is missing, checks first that the store is the expected
    /// one.
    async fn confirm_missing<T>(&self, answer: Result<T>) -> Result<T> {
        if let Err(Error::NotFound { .. }) = &answer {
            self.check().await?;
        }
        answer
    }

    /// Returns the list's items, after a check.
    fn checked<T: Send + 'static>(
        &self,
        list: BoxStream<'static, Result<T>>,
    ) -> BoxStream<'static, Result<T>> {
        let this = self.clone();
        stream::once(async move { this.check().await.map(|()| list) })
            .try_flatten()
            .boxed()
    }
}

impl fmt::Display for Guarded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "guarded {}", self.0.store)
    }
}

#[async_trait::async_trait]
impl ObjectStore for Guarded {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        options: PutOptions,
    ) -> Result<PutResult> {
        self.check().await?;
        self.0.store.put_opts(location, payload, options).await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        options: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.check().await?;
        self.0.store.put_multipart_opts(location, options).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        let answer = self.0.store.get_opts(location, options).await;
        self.confirm_missing(answer).await
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        let answer = self.0.store.get_ranges(location, ranges).await;
        self.confirm_missing(answer).await
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        let this = self.clone();
        stream::once(async move {
            this.check().await?;
            Ok::<_, Error>(this.0.store.delete_stream(locations))
        })
        .try_flatten()
        .boxed()
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.checked(self.0.store.list(prefix))
    }

    fn list_with_offset(
        &self,
        prefix: Option<&Path>,
        offset: &Path,
    ) -> BoxStream<'static, Result<ObjectMeta>> {
        self.checked(self.0.store.list_with_offset(prefix, offset))
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.check().await?;
        self.0.store.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.check().await?;
        self.0.store.copy_opts(from, to, options).await
    }

    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> Result<()> {
        self.check().await?;
        self.0.store.rename_opts(from, to, options).await
    }
}

#[cfg(test)]
mod tests {
    use object_store::ObjectStoreExt;

    use super::*;
    use crate::identity::{check_identity, expect_identity, identify_store};
    use crate::open_store;

    #[tokio::test]
    async fn a_folder_that_is_not_the_expected_store_is_neither_written_nor_made() {
        let (mounted, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let place = |folder: &std::path::Path| open_store(&folder.display().to_string()).unwrap();
        let (store, prefix) = place(mounted.path());
        let identity = identify_store(&*store, &prefix).await.unwrap();
        assert_eq!(identify_store(&*store, &prefix).await.unwrap(), identity);
        let guarded = expect_identity(store, &prefix, identity);
        let object = prefix.clone().join("set").join("object");
        objects::create(&*guarded, &object, "here".into())
            .await
            .unwrap();

        // Another empty folder, a missing folder, and another store.
        let gone = other.path().join("gone");
        let foreign = other.path().join("foreign");
        let (store, prefix) = place(&foreign);
        identify_store(&*store, &prefix).await.unwrap();
        for (folder, words) in [
            (other.path(), "has no store identity; expected"),
            (&*gone, "is it mounted?"),
            (&*foreign, "has the store identity"),
        ] {
            let (store, prefix) = place(folder);
            check_identity(&*store, &prefix, identity)
                .await
                .unwrap_err();
            let guarded = expect_identity(store, &prefix, identity);
            let object = prefix.clone().join("set").join("object");
            let put = objects::create(&*guarded, &object, "lost".into()).await;
            let read = objects::get(&*guarded, &object).await;
            let listed = guarded.list(Some(&prefix)).next().await;
            assert!(listed.is_some_and(|first| first.is_err()));
            for error in [put.unwrap_err(), read.unwrap_err()] {
                let text = error.to_string();
                let named = text.contains(&folder.display().to_string());
                assert!(
                    text.contains(words) && named && !text.contains("Generic"),
                    "{text}"
                );
            }
        }
        assert!(!gone.exists(), "the store's folder was made");

        // The store disappears during use.
        std::fs::rename(mounted.path(), other.path().join("moved")).unwrap();
        std::fs::create_dir(mounted.path()).unwrap();
        let error = objects::create(&*guarded, &object, "late".into()).await;
        assert!(error.unwrap_err().to_string().contains("no store identity"));
        assert_eq!(std::fs::read_dir(mounted.path()).unwrap().count(), 0);
        guarded.head(&object).await.unwrap_err();
    }
}
