//! Removes a published result: writes a note of the objects to delete, then deletes the manifest,
//! the objects and the note. An interrupted removal can be continued from the note. Only objects in
//! the note are deleted, and none that a manifest lists.

use bytes::Bytes;
use object_store::path::Path;
use serde::{Deserialize, Serialize};

use super::{Manifest, Published, ResultId};
use crate::error::StorageError;
use crate::objects;
use crate::sealed::sha256_hex;

/// The note of a removal in progress.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Removal {
    /// SHA-256 of the manifest, in hexadecimal; empty if there is none.
    pub manifest_sha256: String,
    /// Key of the task that made the result; empty if it is unknown.
    pub task_key: String,
    /// Keys of the objects to delete, as in the manifest.
    pub objects: Vec<String>,
}

impl Removal {
    /// Returns the removal of everything that a manifest lists.
    pub fn of_manifest(manifest: &impl Manifest) -> Self {
        let objects = manifest.objects().iter();
        Self {
            manifest_sha256: manifest.sha256(),
            task_key: manifest.task_key().to_owned(),
            objects: objects.map(|object| object.key.clone()).collect(),
        }
    }
}

impl<M: Manifest> Published<M> {
    /// Returns the removal in progress, if there is one.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn removal(&self, id: &M::Id) -> Result<Option<Removal>, StorageError> {
        let note = objects::get(&*self.store, &self.removal_path(id)).await?;
        // A torn note counts as none, because nothing is deleted before the note is complete.
        Ok(note.and_then(|bytes| serde_json::from_slice(&bytes).ok()))
    }

    /// Begins the removal of a result by writing its note. Nothing is deleted yet.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn begin_removal(&self, id: &M::Id, removal: &Removal) -> Result<(), StorageError> {
        let bytes = serde_json::to_vec_pretty(removal).expect("plain data");
        objects::overwrite(&*self.store, &self.removal_path(id), bytes.into()).await
    }

    /// Deletes the manifest and the objects of a removal. Returns the objects deleted, in order. An
    /// object that a manifest lists by now is not deleted, because the same task was run again. The
    /// note remains until [`Self::end_removal`], so that the caller can delete more.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn remove_objects(
        &self,
        id: &M::Id,
        removal: &Removal,
    ) -> Result<Vec<String>, StorageError> {
        let mut deleted = Vec::new();
        let manifest = self.manifest_path(id);
        if let Some(bytes) = objects::get(&*self.store, &manifest).await?
            && sha256_hex(&bytes) == removal.manifest_sha256
        {
            self.delete(&manifest).await?;
            deleted.push(self.shown(&manifest));
        }
        for key in &removal.objects {
            if self.delete_unlisted(id, key).await? {
                deleted.push(self.shown(&self.object_path(id, key)));
            }
        }
        Ok(deleted)
    }

    /// Ends a removal by deleting its note.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn end_removal(&self, id: &M::Id) -> Result<(), StorageError> {
        self.delete(&self.removal_path(id)).await
    }

    /// Removes a result, or continues an interrupted removal. Returns the objects deleted, in
    /// order: the manifest first.
    ///
    /// # Errors
    /// [`StorageError::Damaged`] if the manifest cannot be read, so that its objects are unknown;
    /// [`StorageError::Store`].
    pub async fn remove(&self, id: &M::Id) -> Result<Vec<String>, StorageError> {
        let removal = match self.removal(id).await? {
            Some(removal) => removal,
            None => {
                let Some(manifest) = self.manifest(id).await? else {
                    return Ok(Vec::new());
                };
                let removal = Removal::of_manifest(&manifest);
                self.begin_removal(id, &removal).await?;
                removal
            }
        };
        let deleted = self.remove_objects(id, &removal).await?;
        self.end_removal(id).await?;
        Ok(deleted)
    }

    /// Deletes an object that no manifest lists. Returns `false` if it is missing, or a manifest
    /// lists it: the manifest is looked up right before and right after the deletion, and the
    /// object is put back if it is listed by then.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn delete_unlisted(&self, id: &M::Id, key: &str) -> Result<bool, StorageError> {
        let path = self.object_path(id, key);
        let Some(bytes): Option<Bytes> = objects::get(&*self.store, &path).await? else {
            return Ok(false);
        };
        if self.lists(id, key).await? {
            return Ok(false);
        }
        self.delete(&path).await?;
        if self.lists(id, key).await? {
            objects::create_or_match(&*self.store, &path, bytes).await?;
            return Ok(false);
        }
        Ok(true)
    }

    /// Returns whether the result's manifest lists an object. An unreadable manifest may list any
    /// object.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn lists(&self, id: &M::Id, key: &str) -> Result<bool, StorageError> {
        match self.manifest(id).await {
            Ok(manifest) => Ok(manifest.is_some_and(|m| m.objects().iter().any(|o| o.key == key))),
            Err(StorageError::Damaged { .. }) => Ok(true),
            Err(error) => Err(error),
        }
    }

    fn removal_path(&self, id: &M::Id) -> Path {
        objects::path_of(&self.folder, &id.removal_key())
    }
}
