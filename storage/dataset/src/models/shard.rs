//! Shards of evaluations, on their way to who joins them: `models/<name>/shards/<evaluation key>/<shard>-of-<shards>.zst`.
//! Nobody else needs them; they are deleted when the evaluation is stored.

use bytes::Bytes;

use super::Models;
use crate::error::DatasetError;
use crate::scenes::parts::{pack, unpack};
use crate::store::objects;

/// The folder of the shards.
pub(super) const FOLDER: &str = "shards";
/// Bytes that a shard has at most: some kilobytes a scene.
const MOST: u64 = 1 << 30;

/// Names a shard of an evaluation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ShardName {
    /// The model.
    pub model: String,
    /// Key of the evaluation.
    pub evaluation: String,
    /// Which shard, and of how many.
    pub shard: (u32, u32),
}

impl ShardName {
    fn key(&self) -> String {
        let (index, of) = self.shard;
        format!("{FOLDER}/{}/{index}-of-{of}.zst", self.evaluation)
    }
}

impl Models {
    /// Puts a shard, over a damaged one if need be.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn put_shard(&self, name: &ShardName, bytes: &[u8]) -> Result<(), DatasetError> {
        let packed = pack(bytes).map_err(|e| DatasetError::codec("shard of an evaluation", e))?;
        let path = self.path(&name.model, &name.key());
        objects::overwrite(&*self.store, &path, packed.into()).await
    }

    /// A shard; `None` where there is none, or a damaged one.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn shard(&self, name: &ShardName) -> Result<Option<Bytes>, DatasetError> {
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

    /// Deletes a shard, if it is there.
    ///
    /// # Errors
    /// [`DatasetError::Store`].
    pub async fn delete_shard(&self, name: &ShardName) -> Result<(), DatasetError> {
        self.delete(&self.path(&name.model, &name.key())).await
    }
}
