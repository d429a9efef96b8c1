//! Identifiers of results, and the keys that follow from them.

use futures::TryStreamExt;
use object_store::ObjectStore;
use object_store::path::Path;

use crate::error::StorageError;
use crate::objects;

/// Identifies a result among those of its kind: a scene's index ([`u64`]) or a name ([`String`]).
///
/// ```
/// use picofarm_store::published::ResultId;
///
/// assert_eq!(7u64.manifest_key(), "manifests/7.json");
/// assert_eq!("tof".to_string().manifest_key(), "tof/manifest.json");
/// ```
pub trait ResultId: Clone + Ord + Send + Sync {
    /// Returns the key of the manifest, relative to the folder of all results.
    fn manifest_key(&self) -> String;

    /// Returns the key of the note that a removal is in progress, relative to the folder of all
    /// results.
    fn removal_key(&self) -> String;

    /// Returns the folder to which keys in the manifest are relative, itself relative to the folder
    /// of all results.
    fn folder(&self) -> &str;

    /// Returns the scene, if the result is one scene's.
    fn scene(&self) -> Option<u64>;

    /// Lists the results with a manifest.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    fn list(
        store: &dyn ObjectStore,
        folder: &Path,
    ) -> impl Future<Output = Result<Vec<Self>, StorageError>> + Send;
}

/// Folder of the manifests of numbered results.
const MANIFESTS: &str = "manifests";

/// Scenes: `manifests/<scene>.json`, with keys of objects relative to the folder of all scenes.
impl ResultId for u64 {
    fn manifest_key(&self) -> String {
        format!("{MANIFESTS}/{self}.json")
    }

    fn removal_key(&self) -> String {
        format!("removing/{self}.json")
    }

    fn folder(&self) -> &str {
        ""
    }

    fn scene(&self) -> Option<u64> {
        Some(*self)
    }

    async fn list(store: &dyn ObjectStore, folder: &Path) -> Result<Vec<Self>, StorageError> {
        let folder = objects::path_of(folder, MANIFESTS);
        let objects: Vec<_> = store
            .list(Some(&folder))
            .try_collect()
            .await
            .map_err(|e| StorageError::store("list", objects::shown(store, &folder), e))?;
        let scene = |object: &object_store::ObjectMeta| {
            let name = object.location.filename()?;
            let scene: u64 = name.strip_suffix(".json")?.parse().ok()?;
            (name == format!("{scene}.json")).then_some(scene)
        };
        Ok(objects.iter().filter_map(scene).collect())
    }
}

/// Names: `<name>/manifest.json`, with keys of objects relative to `<name>`.
impl ResultId for String {
    fn manifest_key(&self) -> String {
        format!("{self}/manifest.json")
    }

    fn removal_key(&self) -> String {
        format!("{self}/removing.json")
    }

    fn folder(&self) -> &str {
        self
    }

    fn scene(&self) -> Option<u64> {
        None
    }

    async fn list(store: &dyn ObjectStore, folder: &Path) -> Result<Vec<Self>, StorageError> {
        let listed = store.list_with_delimiter(Some(folder)).await;
        let listed =
            listed.map_err(|e| StorageError::store("list", objects::shown(store, folder), e))?;
        let mut names = Vec::new();
        for path in listed.common_prefixes {
            let manifest = path.clone().join("manifest.json");
            if objects::size(store, &manifest).await?.is_some() {
                names.extend(path.filename().map(str::to_owned));
            }
        }
        Ok(names)
    }
}
