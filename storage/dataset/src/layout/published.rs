//! The published scenes: those with a manifest.

use futures::TryStreamExt;
use object_store::ObjectStore;
use object_store::path::Path;

use crate::error::DatasetError;
use crate::layout::manifest::Manifest;
use crate::store::objects;

/// Returns the scenes with a manifest in a folder, ascending.
pub(crate) async fn scenes_in(
    store: &dyn ObjectStore,
    folder: &Path,
) -> Result<Vec<u64>, DatasetError> {
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
        .map_err(|e| DatasetError::store("list", objects::shown(store, folder), e))?;
    scenes.sort_unstable();
    Ok(scenes)
}

/// Returns the scene of the manifest with this key.
pub(crate) fn manifest_scene(key: &str) -> Option<u64> {
    let scene = key
        .strip_prefix("manifests/")?
        .strip_suffix(".json")?
        .parse()
        .ok()?;
    (Manifest::key(scene) == key).then_some(scene)
}
