//! Putting back what is missing or changed of a scene's predictions, from the same predicted again.

use bytes::Bytes;
use object_store::path::Path;

use super::{EncodedPredictions, PredictionManifest, Predictions};
use crate::error::DatasetError;
use crate::layout::manifest::{Manifest, sha256_hex};
use crate::repair::put_back::put_back;
use crate::store::objects;

impl Predictions {
    /// Puts back what is missing or changed of a scene's predictions, made again: the only path on which an object of theirs
    /// is overwritten. The standing manifest proves that they are what was there; where it is broken itself, the objects that
    /// are left do, each of which must be equal. Gives the objects that were written.
    ///
    /// # Errors
    /// [`DatasetError::Diverged`] where other predictions came out than the manifest says, and [`DatasetError::Damaged`] where
    /// nothing proves what was there; nothing was written then. [`DatasetError::Store`].
    pub async fn restore(&self, encoded: &EncodedPredictions) -> Result<Vec<String>, DatasetError> {
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
            return Err(DatasetError::Diverged {
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
