//! Publishes scenes: create-only objects first, then the manifest, which is the durable record of
//! completion.

use bytes::Bytes;
use object_store::path::Path;

use crate::layout::manifest::Manifest;
use crate::layout::record::{Provenance, SceneRecord};
use crate::scenes::dataset::Dataset;
use crate::scenes::encode::{EncodedScene, encode_scene};
use picofarm_store::StorageError;
use picofarm_store::VerifyMode;
use picofarm_store::concurrent::create_all;
use picofarm_store::objects;
use picofarm_store::published::Manifest as _;

impl Dataset {
    /// Encodes a scene on rayon threads. The function is pure and blocking: call it from async code
    /// through `spawn_blocking`, and pass the result to [`Self::publish_encoded`].
    ///
    /// # Errors
    /// [`StorageError::Invalid`] names the field and index of an unusable value;
    /// [`StorageError::SceneOutOfRange`].
    pub fn encode(
        &self,
        scene: u64,
        record: &SceneRecord<'_>,
        provenance: &Provenance,
    ) -> Result<EncodedScene, StorageError> {
        self.check_scene(scene)?;
        encode_scene(self, scene, record, provenance)
    }

    /// Publishes an encoded scene: objects first, the manifest last, all create-only. An existing
    /// object with equal bytes counts as written, so a scene left half-written by a killed worker
    /// is completed, and publishing twice succeeds. When the call returns, each object existed at a
    /// time when the manifest already protected it from [`Self::collect`]. An object left by a
    /// broken put is replaced in two cases: if the scene's manifest names exactly the new bytes, or
    /// if there is no manifest and the object fails its own checksums.
    ///
    /// # Errors
    /// [`StorageError::Conflict`] if an object exists with different bytes and nothing proves them
    /// wrong (nothing stored is changed); [`StorageError::Store`].
    pub async fn publish_encoded(&self, scene: EncodedScene) -> Result<Manifest, StorageError> {
        match self.publish_once(scene.clone()).await {
            Err(conflict @ StorageError::Conflict { .. }) => self.heal(scene, conflict).await,
            published => published,
        }
    }

    /// Replaces a scene's objects left by a broken put, and publishes it.
    async fn heal(
        &self,
        scene: EncodedScene,
        conflict: StorageError,
    ) -> Result<Manifest, StorageError> {
        let ours = scene.manifest.clone();
        let path = self.path(&Manifest::key(ours.scene));
        if let Some(stored) = objects::get(&*self.store, &path).await? {
            let stored = Manifest::parse(&stored, &ours.scene, &self.shown(&path));
            if stored.is_ok_and(|stored| !stored.same_as(&ours)) {
                return Err(conflict);
            }
            return match self.restore(scene, None).await {
                Ok(restored) => {
                    for object in restored.written {
                        tracing::warn!(%object, "an object that was stored wrongly is replaced");
                    }
                    self.manifest(ours.scene).await
                }
                Err(StorageError::Diverged { .. } | StorageError::Damaged { .. }) => Err(conflict),
                Err(error) => Err(error),
            };
        }
        let mut broken = Vec::new();
        for (object, bytes) in ours.objects.iter().zip(&scene.bytes) {
            let path = self.path(&object.key);
            match objects::get(&*self.store, &path).await? {
                Some(stored) if stored != *bytes => {
                    if self.is_whole(&ours, &object.key, &stored) {
                        return Err(conflict);
                    }
                    broken.push((path, bytes.clone()));
                }
                _ => {}
            }
        }
        for (path, bytes) in broken {
            self.replace(&path, bytes).await?;
            tracing::warn!(
                object = self.shown(&path),
                "an object that was stored wrongly is replaced"
            );
        }
        self.publish_once(scene).await
    }

    /// Returns whether an object passes its own checksums, so that it may be another result of the
    /// same task.
    fn is_whole(&self, manifest: &Manifest, key: &str, bytes: &Bytes) -> bool {
        let array = self
            .arrays
            .iter()
            .find(|a| a.layout.key(manifest.scene) == key);
        let Some(array) = array else { return true };
        if array.layout.quantity.is_transient() {
            return self.shard_is_whole(manifest, array, bytes);
        }
        array.codec.decode(bytes).is_ok()
    }

    async fn publish_once(&self, scene: EncodedScene) -> Result<Manifest, StorageError> {
        let EncodedScene { manifest, bytes } = scene;
        let (id, published) = (manifest.scene, self.published_scenes());
        let conflict = match published.publish_together(&id, &manifest, &bytes).await {
            Ok(()) => return Ok(manifest),
            Err(conflict @ StorageError::Conflict { .. }) => conflict,
            Err(error) => return Err(error),
        };
        // Older manifests have no checksum, but may be equal otherwise.
        let path = published.manifest_path(&id);
        let stored = objects::get(&*self.store, &path).await?;
        let stored = stored.and_then(|s| Manifest::parse(&s, &id, &self.shown(&path)).ok());
        let Some(stored) = stored.filter(|s| s.checksum.is_none() && s.same_as(&manifest)) else {
            return Err(conflict);
        };
        let paths = manifest.objects.iter().map(|object| self.path(&object.key));
        let objects: Vec<(Path, Bytes)> = paths.zip(bytes).collect();
        create_all(&*self.store, &objects).await?;
        Ok(stored)
    }

    /// Encodes and publishes a scene. Blocks its thread while encoding.
    ///
    /// # Errors
    /// Those of [`Self::encode`] and [`Self::publish_encoded`].
    pub async fn publish(
        &self,
        scene: u64,
        record: &SceneRecord<'_>,
        provenance: &Provenance,
    ) -> Result<Manifest, StorageError> {
        let encoded = self.encode(scene, record, provenance)?;
        self.publish_encoded(encoded).await
    }

    /// Returns the manifest of a published scene, after checking the existence and size of each
    /// object. Returns `None` if the scene is not published. This allows a worker to adopt work
    /// that was finished before a crash.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] if the manifest exists but an object is missing (publishing again
    /// restores it) or has another size; [`StorageError::Store`].
    pub async fn published(&self, scene: u64) -> Result<Option<Manifest>, StorageError> {
        self.check_scene(scene)?;
        let published = self.published_scenes();
        let Some(manifest) = published.manifest(&scene).await? else {
            return Ok(None);
        };
        let mode = VerifyMode::Fast;
        published.check_objects(&scene, &manifest, mode).await?;
        Ok(Some(manifest))
    }
}
