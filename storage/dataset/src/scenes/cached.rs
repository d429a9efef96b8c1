//! Reads objects through a local cache. Manifests, metadata and splits are always read from the
//! store, so a scene that was replaced is never read from the cache.

use std::ops::Range;

use bytes::Bytes;
use object_store::{ObjectStoreExt, path::Path};
use picofarm_store::{
    Cache, StorageError,
    objects::{require, shown},
    sealed::ObjectEntry,
};

use crate::{Dataset, Manifest};

impl Dataset {
    /// Returns the data set with a cache for the objects of its arrays. Only readers of decoded
    /// values use it: verification, repair and export read the store.
    #[must_use]
    pub fn with_cache(self, cache: Cache) -> Self {
        let cache = Some(cache);
        Self { cache, ..self }
    }

    /// Returns the bytes of a scene's object.
    pub(crate) async fn object(
        &self,
        manifest: &Manifest,
        key: &str,
    ) -> Result<Bytes, StorageError> {
        let path = self.path(key);
        let Some((cache, entry)) = self.cache.as_ref().zip(manifest.object(key)) else {
            return require(&*self.store, &path).await;
        };
        if let Some(bytes) = cache.get(&entry.sha256, 0..entry.size).await {
            return Ok(bytes);
        }
        let bytes = require(&*self.store, &path).await?;
        let range = 0..bytes.len() as u64;
        cache.put(&entry.sha256, range, bytes.clone()).await;
        Ok(bytes)
    }

    /// Returns a range of an object's bytes.
    pub(crate) async fn object_range(
        &self,
        entry: &ObjectEntry,
        path: &Path,
        range: Range<u64>,
    ) -> object_store::Result<Bytes> {
        let Some(cache) = &self.cache else {
            return self.store.get_range(path, range).await;
        };
        if let Some(bytes) = cache.get(&entry.sha256, range.clone()).await {
            return Ok(bytes);
        }
        let bytes = self.store.get_range(path, range.clone()).await?;
        cache.put(&entry.sha256, range, bytes.clone()).await;
        Ok(bytes)
    }

    /// Returns the error for an object that cannot be decoded, and removes it from the cache, so
    /// that the next read gets it from the store.
    pub(crate) fn damaged(
        &self,
        error: StorageError,
        manifest: &Manifest,
        key: &str,
    ) -> StorageError {
        if let Some((cache, entry)) = self.cache.as_ref().zip(manifest.object(key)) {
            cache.forget(&entry.sha256);
        }
        error.in_object(|| shown(&*self.store, &self.path(key)))
    }
}
