//! Replaces a published scene with a false manifest: one that lists objects that are missing or
//! have other bytes.
//!
//! Without this, a worker with a made-up manifest would block its scene forever, because objects
//! are create-only. Equal scenes never reach this code, and a scene with objects that all match its
//! manifest is not touched.

use crate::layout::manifest::Manifest;
use crate::scenes::dataset::Dataset;
use crate::scenes::encode::EncodedScene;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::sha256_hex;

/// Maximum total size in bytes of a scene's objects that are checked by SHA-256.
pub const SMALL: u64 = 256 << 10;

impl Dataset {
    /// Replaces the stored scene by `scene`, if its manifest contradicts its objects. Returns the
    /// new manifest, or `None` if nothing was written.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn replace_unfounded(
        &self,
        scene: EncodedScene,
    ) -> Result<Option<Manifest>, StorageError> {
        let EncodedScene { manifest, bytes } = scene;
        let path = self.path(&Manifest::key(manifest.scene));
        let Some(stored) = objects::get(&*self.store, &path).await? else {
            return Ok(None);
        };
        let named = self.usable_manifest(&stored, manifest.scene, &self.shown(&path));
        if let Ok(named) = &named
            && self.is_founded(named).await?
        {
            return Ok(None);
        }
        tracing::error!(
            manifest = self.shown(&path),
            "the stored manifest does not describe the stored objects; the scene is replaced by the one made now"
        );
        for (object, bytes) in manifest.objects.iter().zip(bytes) {
            let path = self.path(&object.key);
            let there = objects::get(&*self.store, &path).await?;
            if there.as_ref() != Some(&bytes) {
                self.replace(&path, bytes).await?;
            }
        }
        self.replace(&path, manifest.to_bytes().into()).await?;
        Ok(Some(manifest))
    }

    /// Returns whether the objects of a scene match its manifest. Larger scenes are not read, and
    /// pass.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn agrees(&self, manifest: &Manifest) -> Result<bool, StorageError> {
        Ok(manifest.total_bytes() > SMALL || self.is_founded(manifest).await?)
    }

    /// Returns whether every object has the bytes listed in the manifest.
    async fn is_founded(&self, manifest: &Manifest) -> Result<bool, StorageError> {
        for object in &manifest.objects {
            let there = objects::get(&*self.store, &self.path(&object.key)).await?;
            if there.is_none_or(|bytes| sha256_hex(&bytes) != object.sha256) {
                return Ok(false);
            }
        }
        Ok(true)
    }
}
