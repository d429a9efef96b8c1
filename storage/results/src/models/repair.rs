//! Restores broken objects of a model from bytes with the recorded SHA-256: from another model's
//! object, or from objects that can be recomputed. Objects that cannot be restored are reported and
//! not touched.

use bytes::Bytes;

use super::{MANIFEST, ModelManifest, Models};
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::{ObjectEntry, sha256_hex};
use picofarm_store::{Fault, Problem};

/// The result of repairing a model.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ModelRepair {
    /// Restored objects, each from bytes with the recorded SHA-256.
    pub written: Vec<String>,
    /// Deleted damaged records, which a job can regenerate: evaluations, checkpoints, speeds.
    pub deleted: Vec<String>,
    /// Remaining problems.
    pub left: Vec<Problem>,
}

impl Models {
    /// Restores objects of the manifest from `made` or from other models of the store, if their
    /// SHA-256 matches the manifest. Deletes damaged evaluations, checkpoints and speeds, which
    /// jobs can regenerate. With `dry`, it only reports this.
    ///
    /// # Errors
    /// Those of [`Self::verify`].
    pub async fn repair(
        &self,
        name: &str,
        made: &[Bytes],
        dry: bool,
    ) -> Result<ModelRepair, StorageError> {
        let check = self.verify(name).await?;
        let mut done = ModelRepair::default();
        for problem in check.problems {
            let object = check.manifest.as_ref().and_then(|manifest| {
                let shown =
                    |o: &&ObjectEntry| self.shown(&self.path(name, &o.key)) == problem.object;
                manifest.objects.iter().find(shown)
            });
            if let Some(object) = object {
                match self.find_bytes(name, object, made).await? {
                    Some(bytes) => {
                        if !dry {
                            self.replace(&self.path(name, &object.key), bytes).await?;
                        }
                        done.written.push(problem.object);
                    }
                    None => done.left.push(problem),
                }
                continue;
            }
            let key = problem
                .object
                .strip_prefix(&format!("{}/", self.place(name)));
            match (key, &problem.fault) {
                (Some(key), Fault::BadRecord(_)) if !key.starts_with("sweeps/") => {
                    if !dry {
                        self.delete(&self.path(name, key)).await?;
                    }
                    done.deleted.push(problem.object);
                }
                _ => done.left.push(problem),
            }
        }
        Ok(done)
    }

    /// Returns bytes with an object's SHA-256, from any source.
    async fn find_bytes(
        &self,
        name: &str,
        object: &ObjectEntry,
        made: &[Bytes],
    ) -> Result<Option<Bytes>, StorageError> {
        if let Some(bytes) = made.iter().find(|b| sha256_hex(b) == object.sha256) {
            return Ok(Some(bytes.clone()));
        }
        for other in self.names().await? {
            let manifest: Option<ModelManifest> = match self.look(&other).await {
                Err(StorageError::Damaged { .. }) => None,
                found => found?,
            };
            let same = |o: &&ObjectEntry| o.sha256 == object.sha256;
            let Some(same) = manifest.iter().flat_map(|m| &m.objects).find(same) else {
                continue;
            };
            if other == name {
                continue;
            }
            let bytes = objects::get(&*self.store, &self.path(&other, &same.key)).await?;
            if let Some(bytes) = bytes.filter(|b| sha256_hex(b) == object.sha256) {
                return Ok(Some(bytes));
            }
        }
        Ok(None)
    }

    /// Overwrites an object with one atomic put, and reads it back.
    pub(super) async fn replace(
        &self,
        path: &object_store::path::Path,
        bytes: Bytes,
    ) -> Result<(), StorageError> {
        objects::overwrite(&*self.store, path, bytes.clone()).await?;
        match objects::get(&*self.store, path).await? {
            Some(stored) if stored == bytes => Ok(()),
            _ => Err(StorageError::Damaged {
                object: self.shown(path),
                what: "it was written again, but does not read back as written; check the store"
                    .into(),
            }),
        }
    }

    /// Restores the broken objects of a model with an existing manifest equal to `ours`.
    pub(super) async fn restore(
        &self,
        ours: &ModelManifest,
        bytes: &[Bytes],
    ) -> Result<(), StorageError> {
        debug_assert!(ours.objects.iter().all(|o| o.key != MANIFEST));
        for (object, bytes) in ours.objects.iter().zip(bytes) {
            let path = self.path(&ours.name, &object.key);
            if objects::get(&*self.store, &path).await?.as_ref() != Some(bytes) {
                self.replace(&path, bytes.clone()).await?;
            }
        }
        Ok(())
    }
}
