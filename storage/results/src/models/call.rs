//! Calls, through which processes that train a model together find one another:
//! `models/<name>/calls/<training key>/<number>.json`. Each is created once and never changes. They
//! are deleted with the training's checkpoints.

use bytes::Bytes;

use super::{Models, check_name};
use picofarm_store::StorageError;
use picofarm_store::objects;

/// The folder of the calls.
pub(super) const FOLDER: &str = "calls";

impl Models {
    /// Returns the number and the content of a training's newest call.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] for an invalid name; [`StorageError::Store`].
    pub async fn newest_call(
        &self,
        name: &str,
        training_key: &str,
    ) -> Result<Option<(u64, Bytes)>, StorageError> {
        check_name(name)?;
        let there = self.list(&self.path(name, &folder(training_key))).await?;
        let number = |file: &str| file.strip_suffix(".json")?.parse::<u64>().ok();
        let numbers = there.iter().filter_map(|o| number(o.location.filename()?));
        let Some(newest) = numbers.max() else {
            return Ok(None);
        };
        let path = self.path(name, &key(training_key, newest));
        // The training may have ended in the meantime.
        let found = objects::get(&*self.store, &path).await?;
        Ok(found.map(|content| (newest, content)))
    }

    /// Creates a call. Returns `false` if there already is one with this number.
    ///
    /// # Errors
    /// Those of [`Self::newest_call`].
    pub async fn make_call(
        &self,
        name: &str,
        training_key: &str,
        number: u64,
        content: Bytes,
    ) -> Result<bool, StorageError> {
        check_name(name)?;
        let path = self.path(name, &key(training_key, number));
        objects::create(&*self.store, &path, content).await
    }

    /// Deletes the calls of a training.
    ///
    /// # Errors
    /// Those of [`Self::newest_call`].
    pub async fn delete_calls(&self, name: &str, training_key: &str) -> Result<(), StorageError> {
        check_name(name)?;
        for object in self.list(&self.path(name, &folder(training_key))).await? {
            self.delete(&object.location).await?;
        }
        Ok(())
    }
}

fn folder(training_key: &str) -> String {
    format!("{FOLDER}/{training_key}")
}

fn key(training_key: &str, number: u64) -> String {
    format!("{FOLDER}/{training_key}/{number:06}.json")
}
