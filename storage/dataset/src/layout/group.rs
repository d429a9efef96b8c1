//! Metadata of groups with arrays that have a leading scene axis: creation array by array with the
//! root last, growth, and detection of a group's kind from its root.

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;
use serde_json::{Value, json};

use picofarm_store::StorageError;
use picofarm_store::objects;

/// Name of the metadata objects.
pub const METADATA: &str = "zarr.json";

/// Formats metadata for storage.
pub fn pretty(value: &Value) -> Bytes {
    let mut text = serde_json::to_vec_pretty(value).expect("a JSON value can be written");
    text.push(b'\n');
    text.into()
}

/// Returns whether a group's root belongs to predictions.
pub fn is_predictions(root: &Value) -> bool {
    root["attributes"]["picofarm"]["predictions"].is_u64()
}

/// Returns whether a group's root belongs to reconstructions.
pub(crate) fn is_reconstructions(root: &Value) -> bool {
    root["attributes"]["picofarm"]["reconstructions"].is_u64()
}

/// Returns whether an array's metadata count fewer scenes.
pub(crate) fn counts_fewer(stored: &[u8], scenes: u64) -> bool {
    let stored: Value = serde_json::from_slice(stored).unwrap_or(Value::Null);
    stored["shape"][0]
        .as_u64()
        .is_none_or(|there| there < scenes)
}

/// Writes an array's metadata while its group has no root; `metadata` returns them for a number of
/// scenes. Metadata that an interrupted creation left are adopted if they differ at most in that
/// number.
pub async fn create_metadata(
    store: &dyn ObjectStore,
    path: &Path,
    scenes: u64,
    metadata: impl Fn(u64) -> Value,
) -> Result<(), StorageError> {
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
        return Err(StorageError::Damaged {
            object: objects::shown(store, path),
            what: "left by the interrupted creation of another data set; remove it, or use an empty location"
                .into(),
        });
    }
    objects::grow(store, path, pretty(&ours), |stored| {
        counts_fewer(stored, scenes)
    })
    .await
}
