//! Garbage collection in a store's models: checkpoints of abandoned trainings, shards of
//! evaluations that were never joined, and objects that no manifest lists.
//!
//! A checkpoint is never a result: if one is missing, the training resumes from the previous one or
//! from the beginning. Objects are protected like a scene's: the manifest is looked up right before
//! and right after an object is deleted, and the publisher checks its objects after writing the
//! manifest.

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use object_store::ObjectMeta;
use object_store::path::Path;

use super::{Models, key_below, object_folder};
use picofarm_dataset::{Orphan, OrphanCause};
use picofarm_store::StorageError;
use picofarm_store::leftovers;
use picofarm_store::objects;

impl Models {
    /// Finds unneeded objects that were last written at `limit` or earlier, which is `grace` before
    /// now: checkpoints of trainings with no newer checkpoint, shards of evaluations, calls of
    /// processes, objects that no manifest lists, and unfinished files of killed writes. Deletes
    /// them if `delete` is set.
    pub(crate) async fn collect(
        &self,
        limit: SystemTime,
        grace: Duration,
        delete: bool,
    ) -> Result<Vec<Orphan>, StorageError> {
        let mut found = Vec::new();
        let old = |object: &ObjectMeta| SystemTime::from(object.last_modified) <= limit;
        for name in self.names().await? {
            let mut trainings: BTreeMap<String, Vec<ObjectMeta>> = BTreeMap::new();
            for checkpoint in self.checkpoints(&name).await? {
                let training = trainings.entry(checkpoint.training_key).or_default();
                training.extend(checkpoint.objects);
            }
            for objects in trainings.into_values().filter(|all| all.iter().all(old)) {
                for object in objects {
                    if delete {
                        self.delete(&object.location).await?;
                    }
                    found.push(self.orphan(&object, OrphanCause::Checkpoint));
                }
            }
            // The task that joins an evaluation regenerates missing shards.
            let shards = self.list(&self.path(&name, super::shard::FOLDER)).await?;
            let shards = shards.into_iter().map(|o| (o, OrphanCause::Shard));
            // A training process that finds no call creates one.
            let calls = self.list(&self.path(&name, super::call::FOLDER)).await?;
            let calls = calls.into_iter().map(|o| (o, OrphanCause::Call));
            for (object, cause) in shards.chain(calls).filter(|(object, _)| old(object)) {
                if delete {
                    self.delete(&object.location).await?;
                }
                found.push(self.orphan(&object, cause));
            }
            let folder = self.folder.clone().join(&*name);
            for object in self.list(&folder).await? {
                let Some(key) = key_below(&folder, &object.location) else {
                    continue;
                };
                if object_folder(&key).is_some()
                    && old(&object)
                    && !self.names_object(&name, &key).await?
                    && (!delete || self.delete_object(&name, &key, &object.location).await?)
                {
                    found.push(self.orphan(&object, OrphanCause::Model));
                }
            }
        }
        let here = objects::folder(&*self.store, &self.folder);
        if let Some(here) = here.filter(|here| here.is_dir()) {
            for (path, bytes) in leftovers(&here, grace)? {
                if delete {
                    match std::fs::remove_file(&path) {
                        Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                            return Err(StorageError::io("delete", &path, e));
                        }
                        _ => {}
                    }
                }
                found.push(Orphan {
                    object: path.display().to_string(),
                    bytes,
                    scene: None,
                    cause: OrphanCause::Write,
                });
            }
        }
        Ok(found)
    }

    /// Deletes an object. Returns `false` if a manifest lists it in the meantime.
    pub(super) async fn delete_object(
        &self,
        name: &str,
        key: &str,
        path: &Path,
    ) -> Result<bool, StorageError> {
        let Some(bytes): Option<Bytes> = objects::get(&*self.store, path).await? else {
            return Ok(false);
        };
        if self.names_object(name, key).await? {
            return Ok(false);
        }
        self.delete(path).await?;
        if self.names_object(name, key).await? {
            objects::create_or_match(&*self.store, path, bytes).await?;
            return Ok(false);
        }
        Ok(true)
    }

    /// Returns whether the model's manifest lists an object. An unreadable manifest may list any
    /// object.
    async fn names_object(&self, name: &str, key: &str) -> Result<bool, StorageError> {
        let manifest = self.look(name).await?;
        Ok(manifest.is_some_and(|m| m.objects.iter().any(|object| object.key == key)))
    }

    fn orphan(&self, object: &ObjectMeta, cause: OrphanCause) -> Orphan {
        Orphan {
            object: self.shown(&object.location),
            bytes: object.size,
            scene: None,
            cause,
        }
    }
}
