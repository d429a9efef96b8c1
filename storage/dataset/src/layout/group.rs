//! Metadata of groups whose arrays have a leading scene axis: created array by array, the root last, and grown.

use object_store::ObjectStore;
use object_store::path::Path;
use serde_json::{Value, json};

use crate::error::DatasetError;
use crate::scenes::dataset::pretty;
use crate::store::objects;

/// Writes an array's metadata while its group has no root; `metadata` says what they are for a number of scenes. What an
/// interrupted creation left is adopted if it differs at most in that number.
pub(crate) async fn create_metadata(
    store: &dyn ObjectStore,
    path: &Path,
    scenes: u64,
    metadata: impl Fn(u64) -> Value,
) -> Result<(), DatasetError> {
    let ours = metadata(scenes);
    if objects::create(store, path, pretty(&ours)).await? {
        return Ok(());
    }
    let stored = objects::require(store, path).await?;
    let mut stored: Value = serde_json::from_slice(&stored).unwrap_or(Value::Null);
    let there = stored["shape"][0].as_u64().unwrap_or(0);
    if there > 0 {
        stored["shape"][0] = json!(scenes);
    }
    if stored != ours {
        return Err(DatasetError::Damaged {
            object: objects::shown(store, path),
            what: "left by the interrupted creation of another data set; remove it, or use an empty location"
                .into(),
        });
    }
    if there < scenes {
        objects::overwrite(store, path, pretty(&ours)).await?;
    }
    Ok(())
}
