//! Putting back what is missing or changed of a scene's predictions, from the same predicted again.

use bytes::Bytes;

use super::{EncodedPredictions, PredictionManifest, Predictions};
use crate::error::DatasetError;
use crate::layout::manifest::{Manifest, sha256_hex};
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
        let (mut broken, mut equal) = (Vec::new(), 0);
        for (object, bytes) in ours.objects.iter().zip(&encoded.bytes) {
            let path = self.path(&object.key);
            match objects::get(&*self.store, &path).await? {
                Some(there) if there == *bytes => equal += 1,
                there => broken.push((path, bytes.clone(), there.is_some())),
            }
        }
        if !readable && (equal == 0 || broken.iter().any(|(_, _, there)| *there)) {
            return Err(DatasetError::Damaged {
                object: shown,
                what: "it cannot be read, and the objects that are left are not all equal to what is predicted now, so that \
                       nothing proves what was there; nothing was written. Delete the scene's manifest and objects to have \
                       it predicted anew"
                    .into(),
            });
        }
        let manifest = (manifest_path, Bytes::from(ours.to_bytes()), true);
        broken.extend((!readable).then_some(manifest));
        let mut written = Vec::new();
        for (path, bytes, _) in broken {
            objects::overwrite(&*self.store, &path, bytes.clone()).await?;
            if objects::get(&*self.store, &path).await?.as_ref() != Some(&bytes) {
                return Err(DatasetError::Damaged {
                    object: self.shown(&path),
                    what:
                        "it was written again, but does not read back as written; check the store"
                            .into(),
                });
            }
            written.push(self.shown(&path));
        }
        Ok(written)
    }
}
