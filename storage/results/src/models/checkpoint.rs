//! Checkpoints of trainings, in the folder of their model: `models/<name>/checkpoints/<training
//! key>/`.

use bytes::Bytes;

use super::{Models, check_name};
use crate::checkpoints::{Checkpoint, Checkpoints, FOLDER, Pieces, found};
use picofarm_store::StorageError;

impl Models {
    /// Returns the checkpoints of a training.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] for an invalid name.
    pub fn checkpoints_of(
        &self,
        name: &str,
        training_key: &str,
    ) -> Result<Checkpoints, StorageError> {
        check_name(name)?;
        let folder = self.folder.clone().join(name);
        Ok(Checkpoints::new(self.store.clone(), &folder, training_key))
    }

    /// Like [`Checkpoints::put`], for a training.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] for an invalid name; [`StorageError::Store`].
    pub async fn put_checkpoint(
        &self,
        name: &str,
        training_key: &str,
        step: u64,
        content: Pieces,
    ) -> Result<(), StorageError> {
        self.checkpoints_of(name, training_key)?
            .put(step, content)
            .await
    }

    /// Like [`Checkpoints::newest`], for a training.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] for an invalid name; [`StorageError::Store`].
    pub async fn newest_checkpoint(
        &self,
        name: &str,
        training_key: &str,
    ) -> Result<Option<(u64, Vec<Bytes>)>, StorageError> {
        self.checkpoints_of(name, training_key)?.newest().await
    }

    /// Like [`Checkpoints::delete`], for a training, and also deletes its calls.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] for an invalid name; [`StorageError::Store`].
    pub async fn delete_checkpoints(
        &self,
        name: &str,
        training_key: &str,
    ) -> Result<(), StorageError> {
        self.delete_calls(name, training_key).await?;
        self.checkpoints_of(name, training_key)?.delete().await
    }

    /// Returns the checkpoints of all trainings of a model, ascending by training and step.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn checkpoints(&self, name: &str) -> Result<Vec<Checkpoint>, StorageError> {
        Ok(found(self.list(&self.path(name, FOLDER)).await?))
    }
}
