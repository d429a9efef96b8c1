//! Published results: those with a manifest.

use futures::TryStreamExt;
use object_store::ObjectStore;
use object_store::path::Path;

use crate::error::StorageError;
use crate::objects;

/// Returns the scenes with a manifest in a folder, ascending.
pub async fn scenes_in(store: &dyn ObjectStore, folder: &Path) -> Result<Vec<u64>, StorageError> {
    let mut scenes: Vec<u64> = store
        .list(Some(folder))
        .try_filter_map(|object| async move {
            let name = object
                .location
                .filename()
                .and_then(|n| n.strip_suffix(".json"));
            Ok(name.and_then(|n| n.parse::<u64>().ok()))
        })
        .try_collect()
        .await
        .map_err(|e| StorageError::store("list", objects::shown(store, folder), e))?;
    scenes.sort_unstable();
    Ok(scenes)
}
