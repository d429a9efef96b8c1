//! Restores missing or changed objects of a scene's predictions from a repeated prediction.

use bytes::Bytes;
use object_store::path::Path;

use super::{EncodedPredictions, PredictionManifest, Predictions};
use picofarm_dataset::Manifest;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::put_back::put_back;
use picofarm_store::sealed::sha256_hex;

impl Predictions {
    /// Restores missing or changed objects of a scene's predictions from regenerated ones. Only
    /// this code overwrites them. The existing manifest proves that they equal the originals. If
    /// the manifest itself is broken, the remaining objects are the proof, and each must be equal.
    /// Returns the objects written.
    ///
    /// # Errors
    /// [`StorageError::Diverged`] if the predictions differ from the manifest, and
    /// [`StorageError::Damaged`] if nothing proves the original content; in both cases nothing was
    /// written. [`StorageError::Store`].
    pub async fn restore(&self, encoded: &EncodedPredictions) -> Result<Vec<String>, StorageError> {
        let ours = &encoded.manifest;
        let manifest_path = self.path(&Manifest::key(ours.scene));
        let stored = objects::get(&*self.store, &manifest_path).await?;
        let Some(stored) = stored else {
            self.publish(encoded).await?;
            return Ok(Vec::new());
        };
        let shown = self.shown(&manifest_path);
        let theirs = PredictionManifest::parse(&stored, ours.scene, &shown).ok();
        let readable = theirs.is_some();
        if let Some(theirs) = theirs {
            self.check_owner(&theirs, &ours.task_key)?;
        }
        if readable && stored != ours.to_bytes() {
            return Err(StorageError::Diverged {
                object: shown,
                expected: sha256_hex(&stored),
                ours: ours.sha256(),
            });
        }
        let paths = ours.objects.iter().map(|o| self.path(&o.key));
        let objects: Vec<(Path, Bytes)> = paths.zip(encoded.bytes.iter().cloned()).collect();
        let manifest = (manifest_path, Bytes::from(ours.to_bytes()));
        put_back(&*self.store, manifest, readable, &objects).await
    }
}
