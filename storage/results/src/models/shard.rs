//! Shards of evaluations, in transit to the worker that joins them:
//! `models/<name>/shards/<evaluation key>/<shard>-of-<shards>.zst`. They have no other use, and are
//! deleted when the evaluation is stored.

use bytes::Bytes;

use super::Models;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::packed::{pack, unpack};

/// The folder of the shards.
pub(super) const FOLDER: &str = "shards";
/// Maximum size of a shard in bytes. A scene takes some kilobytes.
const MOST: u64 = 1 << 30;

/// The name of a shard of an evaluation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ShardName {
    /// The model.
    pub model: String,
    /// Key of the evaluation.
    pub evaluation: String,
    /// The shard's index and the number of shards.
    pub shard: (u32, u32),
}

impl ShardName {
    fn key(&self) -> String {
        let (index, of) = self.shard;
        format!("{FOLDER}/{}/{index}-of-{of}.zst", self.evaluation)
    }
}

impl Models {
    /// Stores a shard, replacing a damaged one.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn put_shard(&self, name: &ShardName, bytes: &[u8]) -> Result<(), StorageError> {
        let packed = pack(bytes).map_err(|e| StorageError::codec("shard of an evaluation", e))?;
        let path = self.path(&name.model, &name.key());
        objects::overwrite(&*self.store, &path, packed.into()).await
    }

    /// Reads a shard. Returns `None` if it is missing or damaged.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn shard(&self, name: &ShardName) -> Result<Option<Bytes>, StorageError> {
        let path = self.path(&name.model, &name.key());
        let Some(packed) = objects::get(&*self.store, &path).await? else {
            return Ok(None);
        };
        match unpack(&packed, MOST) {
            Ok(bytes) => Ok(Some(bytes.into())),
            Err(error) => {
                tracing::warn!(object = %path, %error, "a shard of an evaluation is damaged; it is made again");
                Ok(None)
            }
        }
    }

    /// Deletes a shard, if it exists.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn delete_shard(&self, name: &ShardName) -> Result<(), StorageError> {
        self.delete(&self.path(&name.model, &name.key())).await
    }
}
