//! Putting back what is broken of a model, from bytes that have the recorded SHA-256: another model's object, or what can be
//! computed again. What cannot be put back is left alone and named.

use bytes::Bytes;

use super::{MANIFEST, ModelManifest, Models};
use crate::error::DatasetError;
use crate::layout::manifest::{ObjectEntry, sha256_hex};
use crate::store::objects;
use crate::verify::report::{Fault, Problem};

/// What was done to a model.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ModelRepair {
    /// Objects that were written again, each from bytes of the recorded SHA-256.
    pub written: Vec<String>,
    /// Damaged records that were deleted, because a job makes them again: evaluations, checkpoints, speeds.
    pub deleted: Vec<String>,
    /// What stays broken.
    pub left: Vec<Problem>,
}

impl Models {
    /// Puts back what can be: objects of the manifest from `made` or from other models of the store, if their SHA-256 is the
    /// manifest's. Deletes damaged evaluations, checkpoints and speeds: jobs make them again. With `dry`, it only says so.
    ///
    /// # Errors
    /// Those of [`Self::verify`].
    pub async fn repair(
        &self,
        name: &str,
        made: &[Bytes],
        dry: bool,
    ) -> Result<ModelRepair, DatasetError> {
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

    /// Bytes with an object's SHA-256, wherever they are.
    async fn find_bytes(
        &self,
        name: &str,
        object: &ObjectEntry,
        made: &[Bytes],
    ) -> Result<Option<Bytes>, DatasetError> {
        if let Some(bytes) = made.iter().find(|b| sha256_hex(b) == object.sha256) {
            return Ok(Some(bytes.clone()));
        }
        for other in self.names().await? {
            let manifest: Option<ModelManifest> = match self.look(&other).await {
                Err(DatasetError::Damaged { .. }) => None,
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

    /// One atomic put over whatever is there, read back.
    pub(super) async fn replace(
        &self,
        path: &object_store::path::Path,
        bytes: Bytes,
    ) -> Result<(), DatasetError> {
        objects::overwrite(&*self.store, path, bytes.clone()).await?;
        match objects::get(&*self.store, path).await? {
            Some(stored) if stored == bytes => Ok(()),
            _ => Err(DatasetError::Damaged {
                object: self.shown(path),
                what: "it was written again, but does not read back as written; check the store"
                    .into(),
            }),
        }
    }

    /// Puts back what is broken of a model whose manifest stands and says what `ours` does.
    pub(super) async fn restore(
        &self,
        ours: &ModelManifest,
        bytes: &[Bytes],
    ) -> Result<(), DatasetError> {
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
